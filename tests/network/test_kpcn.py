"""KPCN: kernels for two parts of the light, each in its own space; training, tiles, files and refusals."""

import numpy as np
import pytest
import torch
from full_stack import full_stack
from torch.nn.functional import avg_pool2d

from ngpt.errors import NgptError
from ngpt.network.kpcn import EPSILON, SplitKernels
from ngpt.network.model import ModelConfig, Reconstructor
from ngpt.network.transfer import signed_exp, signed_log
from ngpt.network.weights import load_weights, save_weights
from ngpt.stack import GradientStack
from ngpt.training.settings import from_dict, read_settings

INPUTS = ("primal", "diffuse", "specular", "diffuse_se", "specular_se", "albedo", "normal")


def small(**changes):
    config = {"channels": (6,), "units": (2,), "inputs": INPUTS, "kernel": 5}
    return ModelConfig("kpcn", **config | changes)


def random_layers(height=24, width=30, batch=1, scale=1.0):
    layers = {name: torch.rand(batch, 3, height, width) for name in INPUTS}
    layers |= {name: scale * layers[name] for name in ("diffuse", "specular", "diffuse_se", "specular_se")}
    return layers | {"primal": layers["diffuse"] + layers["specular"]}


def random_kernels(model):
    """Weights under which kernels differ from pixel to pixel."""
    for head in model.network.heads.values():
        torch.nn.init.normal_(head.convolution.weight, std=1.0)
    return model


def test_equal_kernels_average_each_part_in_its_own_space():
    head = SplitKernels(size=5)
    diffuse, specular, albedo = (torch.rand(1, 3, 12, 13) for _ in range(3))
    result = signed_exp(head.forward(torch.zeros(1, head.outputs, 8, 9), [diffuse, specular, albedo]))
    inside = albedo[..., 2:-2, 2:-2] + EPSILON
    light = avg_pool2d(diffuse / (albedo + EPSILON), 5, 1) * inside
    assert torch.allclose(result, light + torch.expm1(avg_pool2d(torch.log1p(specular), 5, 1)), rtol=1e-4)


def test_a_kernel_picks_the_pixel_it_points_to():
    """The first half of the prediction is of diffuse light."""
    head = SplitKernels(size=3)
    diffuse, specular = torch.rand(2, 1, 3, 9, 10)
    albedo = torch.ones(1, 3, 9, 10)
    for tap, other in ((0, 8), (5, 1)):
        prediction = torch.zeros(1, head.outputs, 7, 8)
        prediction[:, tap] = prediction[:, 9 + other] = 200
        (y, x), (v, u) = divmod(tap, 3), divmod(other, 3)
        expected = diffuse[..., y : y + 7, x : x + 8] + specular[..., v : v + 7, u : u + 8]
        assert torch.allclose(signed_exp(head.forward(prediction, [diffuse, specular, albedo])), expected, rtol=1e-4)


@pytest.mark.parametrize(("part", "other"), [("diffuse", "specular"), ("specular", "diffuse")])
def test_a_network_reads_its_own_part_alone(part, other):
    torch.manual_seed(0)
    model = random_kernels(Reconstructor(small()))
    channels = torch.rand(2, 17, 16, 16)
    channels[1] = channels[0]
    place = 3 + 3 * INPUTS[1:3].index(other)
    channels[1, place : place + 3] += 1
    channels[1, 9 + INPUTS[3:5].index(f"{other}_se")] += 1
    channels[1, :3] += 1
    with torch.no_grad():
        halves = model.network(channels).chunk(2, 1)
    own = halves[("diffuse", "specular").index(part)]
    assert torch.equal(own[0], own[1]) and halves[0].shape[1] == halves[1].shape[1] == 25


def test_it_learns(tmp_path):
    """Noise on a diffuse wall with paint and a highlight: far below the input, and below equal kernels."""
    torch.manual_seed(0)
    model = Reconstructor(small())
    albedo = 0.05 + 0.9 * torch.rand(1, 3, 32, 32)
    light = torch.ones(1, 3, 32, 32)
    light[..., 13:] = 6
    gloss = torch.zeros(1, 3, 32, 32)
    gloss[..., 20:, :] = 9
    clean = albedo * light + gloss
    layers = random_layers(32, 32)
    layers |= {
        "albedo": albedo,
        "diffuse": albedo * light * (1 + 0.5 * torch.randn(light.shape)).clamp(min=0.1),
        "specular": gloss * (1 + 0.5 * torch.randn(light.shape)).clamp(min=0.1),
    }
    layers["primal"] = layers["diffuse"] + layers["specular"]

    def loss():
        return (signed_log(model(layers)) - signed_log(clean)).square().mean()

    first = loss().item()
    noise = (signed_log(layers["primal"]) - signed_log(clean)).square().mean().item()
    optimizer = torch.optim.Adam(model.parameters(), 2e-2)
    for _ in range(60):
        optimizer.zero_grad()
        loss().backward()
        optimizer.step()
    assert loss().item() < 0.35 * min(first, noise)
    save_weights(tmp_path / "w.safetensors", model, {})
    again, _ = load_weights(tmp_path / "w.safetensors")
    with torch.no_grad():
        assert again.config == model.config and torch.equal(again(layers), model(layers))


def split_stack(height=20, width=26):
    """A stack without gradients that is split, with a lamp in it."""
    stack = full_stack(height, width)
    rng = np.random.default_rng(5)
    parts = {name: rng.random((height, width, 3), np.float32) for name in ("diffuse", "specular")}
    direct = np.zeros((height, width, 3), np.float32)
    direct[2:4, 3:6] = 30
    layers = {name: stack[name] for name in ("albedo", "normal", "depth")} | parts | {"direct": direct}
    layers |= {f"{name}_var": 0.01 * part for name, part in parts.items()}
    return GradientStack(layers | {"primal": direct + parts["diffuse"] + parts["specular"]})


def test_a_stack_is_reconstructed_by_its_weights(tmp_path):
    """The lamp is added back, and pixels that are not finite come from their neighbours."""
    import ngpt

    torch.manual_seed(0)
    save_weights(tmp_path / "w.safetensors", Reconstructor(small()), {})
    stack = split_stack()
    image = ngpt.denoise(stack, "ngpt", weights=str(tmp_path / "w.safetensors"))
    assert image.shape == stack["primal"].shape and 30 < image[2:4, 3:6].mean() < 32
    broken = stack.replace(**{name: stack[name].copy() for name in ("primal", "specular")})
    broken["primal"][7, 7] = broken["specular"][7, 7] = np.nan
    repaired = ngpt.denoise(broken, "ngpt", weights=str(tmp_path / "w.safetensors"))
    assert np.isfinite(repaired).all() and np.abs(repaired - image).max() < 1
    with pytest.raises(NgptError, match="need layers diffuse, specular, diffuse_var, specular_var, which"):
        ngpt.denoise(full_stack(20, 26), "ngpt", weights=str(tmp_path / "w.safetensors"))


@pytest.mark.parametrize("made", ["quieter", "rarer"])
def test_inputs_that_are_made_up_have_no_parts(made):
    tables = {"model": small().to_dict(), "augmentation": {made: [1.0, 1.0]}}
    with pytest.raises(NgptError, match=f"augmentation.{made}: makes no diffuse and specular light"):
        from_dict(tables, "a.toml")


def test_the_papers_size():
    from ngpt.network.model import parameters
    from ngpt.system.configs import TRAINING, find_config

    model = Reconstructor(read_settings(find_config("kpcn", TRAINING)).model)
    # Nine layers of 100 channels: seven hidden ones of 250,000 weights in each network.
    assert 3.5e6 < parameters(model) < 4e6 and model.config.head.outputs == 2 * 441


def test_there_is_no_graph(tmp_path):
    pytest.importorskip("onnxscript")
    from ngpt.export.network import network_model

    for i, config in enumerate([small(), ModelConfig("dense", (4,), (1,), ("primal", "diffuse_se"))]):
        save_weights(tmp_path / f"{i}.safetensors", Reconstructor(config), {})
        with pytest.raises(NgptError, match="for which there is no ONNX graph; run its weights in PyTorch"):
            network_model(tmp_path / f"{i}.safetensors", "mine")
