"""Heads: what they make of a prediction, and that networks learn by them; KPCN, whose head is of two parts of light."""

import numpy as np
import pytest
import torch
from full_stack import full_stack
from networks import PYRAMID, SPLIT, plain
from torch.nn.functional import avg_pool2d

import ngpt
from ngpt.errors import NgptError
from ngpt.network.heads import Mixture, Pyramid, Residual
from ngpt.network.kpcn import EPSILON, SplitKernels
from ngpt.network.model import ModelConfig, Reconstructor
from ngpt.network.safetensors import save_weights
from ngpt.network.transfer import signed_exp, signed_log
from ngpt.stack import GradientStack

KPCN = ModelConfig("kpcn", (6,), (2,), SPLIT, kernel=5)
BOTH = ("primal", "base")


def images(head, height=9, width=11):
    """Images that a head reads, of radiance from 0 to 1 but one pixel of 1e12."""
    made = [torch.rand(1, 3, height + 2 * head.radius, width + 2 * head.radius) for _ in head.start]
    for image in made:
        image[0, 0, 4, 5] = 1e12
    return made


def image_of(prediction, given, head):
    return signed_exp(head.forward(prediction, given))


def close(one, other):
    return torch.allclose(one, other, rtol=1e-4)


@pytest.mark.parametrize("head", [Residual(("base",)), Mixture(BOTH)], ids=lambda head: type(head).__name__)
def test_a_prediction_of_nothing_is_the_mean_of_what_the_head_reads(head):
    given = images(head)
    mean = sum(avg_pool2d(image, 2 * head.radius + 1, 1) for image in given) / len(given)
    assert close(image_of(torch.zeros(1, head.outputs, 9, 11), given, head), mean)


def pyramid(image, trust=0.0, share=0.0, reflectance=None, **changes):
    """The result of flat kernels with the same trust (or one for each pixel) and shares everywhere."""
    head = Pyramid(("primal",), **{"size": 3, "scales": 3, "demodulate": reflectance is not None} | changes)
    prediction = torch.zeros(1, head.outputs, *image.shape[-2:])
    for scale in range(head.scales - 1):
        prediction[:, (scale + 1) * (head.size**2 + 1)] = share
    prediction[:, 0] = trust
    return image_of(prediction, [image] if reflectance is None else [image, reflectance], head)


@pytest.mark.parametrize("trust", [-50.0, 0.0, 50.0])
def test_a_pyramid_leaves_a_plain_image_as_it_is(trust):
    """To the border, beyond which there is nothing to average."""
    image = torch.full((1, 3, 16, 24), 7.0)
    assert close(pyramid(image, trust), image)


@pytest.mark.parametrize(("scales", "least", "most"), [(2, 0.6, 0.8), (4, 0.3, 0.65)])
def test_coarse_pixels_replace_what_fine_ones_average_to(scales, least, most):
    """Shares of 0 leave the mean over the finest kernel; with 1 its low frequencies come from the coarsest."""
    torch.manual_seed(0)
    image = torch.rand(1, 3, 32, 32)
    fine, coarse = (pyramid(image, share=share, scales=scales) for share in (-50, 50))
    # Trust is over 1 + brightness.
    weight = 1 / (1 + image.mean(1, keepdim=True))
    assert close(fine[..., 1:-1, 1:-1], avg_pool2d(image * weight, 3, 1) / avg_pool2d(weight, 3, 1))
    assert least < coarse.std() / fine.std() < most


def test_a_pixel_that_is_not_trusted_lights_no_other():
    image, trust = torch.ones(1, 3, 16, 24), torch.full((16, 24), 50.0)
    image[..., 8, 9] = 1e6
    assert pyramid(image, trust, size=5).max() > 1.01
    trust[8, 9] = -50
    assert (pyramid(image, trust, size=5) - 1).abs().max() < 2e-3


def test_texture_of_the_albedo_is_not_averaged():
    torch.manual_seed(0)
    albedo = 0.05 + 0.9 * torch.rand(1, 3, 16, 24)
    assert Pyramid(("primal",), 3, 3, True).reads == ("primal", "reflectance")
    assert close(pyramid(3 * albedo, reflectance=albedo), 3 * albedo)
    assert (pyramid(3 * albedo) - 3 * albedo).abs().mean() > 0.3


def wall(light, gloss, noise):
    """Layers of a wall with paint in light and a highlight, with noise, and what they are without."""
    torch.manual_seed(0)
    albedo = 0.05 + 0.9 * torch.rand(1, 3, 32, 32)
    layers = {name: torch.rand(1, 3, 32, 32) for name in SPLIT} | {"albedo": albedo}
    for name, part in (("diffuse", albedo * light), ("specular", gloss)):
        layers[name] = part * (1 + noise * torch.randn(part.shape)).clamp(min=0.1)
    return layers | {"primal": layers["diffuse"] + layers["specular"]}, albedo * light + gloss


STEP, SPOT = torch.ones(1, 3, 32, 32), torch.zeros(1, 3, 32, 32)
STEP[..., 13:], SPOT[..., 20:, :] = 6, 9


@pytest.mark.parametrize(
    ("config", "scene", "bound"),
    [
        (plain(("primal", "albedo"), channels=(6, 6, 6), **PYRAMID), wall(torch.tensor(4.0), 0 * SPOT, 0.6), 0.1),
        (KPCN, wall(STEP, SPOT, 0.5), 0.35),
    ],
    ids=["pyramid", "kpcn"],
)
def test_it_learns(config, scene, bound):
    """Far below the noise of the input, and below equal kernels."""
    torch.manual_seed(0)
    model, (layers, clean) = Reconstructor(config), scene
    optimizer = torch.optim.Adam(model.parameters(), 1.5e-2)

    def loss(image):
        return (signed_log(image) - signed_log(clean)).square().mean()

    first = loss(model(layers)).item()
    for _ in range(60):
        optimizer.zero_grad()
        loss(model(layers)).backward()
        optimizer.step()
    assert loss(model(layers)).item() < min(0.35 * first, bound * loss(layers["primal"]).item())


def test_equal_kernels_average_each_part_in_its_own_space():
    head = SplitKernels(size=5)
    diffuse, specular, albedo = (torch.rand(1, 3, 12, 13) for _ in range(3))
    result = image_of(torch.zeros(1, head.outputs, 8, 9), [diffuse, specular, albedo], head)
    inside = albedo[..., 2:-2, 2:-2] + EPSILON
    light = avg_pool2d(diffuse / (albedo + EPSILON), 5, 1) * inside
    assert close(result, light + torch.expm1(avg_pool2d(torch.log1p(specular), 5, 1)))


@pytest.mark.parametrize(("tap", "other"), [(0, 8), (5, 1)])
def test_kernels_of_two_parts_pick_the_pixels_they_point_to(tap, other):
    """The first half of the prediction is of diffuse light."""
    head = SplitKernels(size=3)
    diffuse, specular = torch.rand(2, 1, 3, 9, 10)
    prediction = torch.zeros(1, head.outputs, 7, 8)
    prediction[:, tap] = prediction[:, 9 + other] = 200
    (y, x), (v, u) = divmod(tap, 3), divmod(other, 3)
    expected = diffuse[..., y : y + 7, x : x + 8] + specular[..., v : v + 7, u : u + 8]
    assert close(image_of(prediction, [diffuse, specular, torch.ones(1, 3, 9, 10)], head), expected)


@pytest.mark.parametrize(("part", "other"), [("diffuse", "specular"), ("specular", "diffuse")])
def test_a_network_reads_only_its_own_part(part, other):
    torch.manual_seed(0)
    model = Reconstructor(KPCN)
    for head in model.network.heads.values():
        torch.nn.init.normal_(head.convolution.weight)
    channels = torch.rand(2, 17, 16, 16)
    channels[1] = channels[0]
    first = 3 + 3 * SPLIT[1:3].index(other)
    for changed in (slice(0, 3), slice(first, first + 3), 9 + SPLIT[3:5].index(f"{other}_se")):
        channels[1, changed] += 1
    with torch.no_grad():
        own = model.network(channels).chunk(2, 1)[("diffuse", "specular").index(part)]
    assert torch.equal(own[0], own[1]) and own.shape[1] == 25


def test_a_stack_is_reconstructed_from_its_two_parts(tmp_path):
    """The lamp is added back, and pixels that are not finite come from their neighbours."""
    torch.manual_seed(0)
    path = str(tmp_path / "w.safetensors")
    save_weights(path, Reconstructor(KPCN), {})
    whole, rng = full_stack(20, 26), np.random.default_rng(5)
    parts = {name: rng.random((20, 26, 3), np.float32) for name in ("diffuse", "specular")}
    direct = np.zeros((20, 26, 3), np.float32)
    direct[2:4, 3:6] = 30
    layers = {name: whole[name] for name in ("albedo", "normal", "depth")} | parts | {"direct": direct}
    layers |= {f"{name}_var": 0.01 * part for name, part in parts.items()}
    stack = GradientStack(layers | {"primal": direct + parts["diffuse"] + parts["specular"]})
    image = ngpt.denoise(stack, "ngpt", weights=path)
    assert image.shape == direct.shape and 30 < image[2:4, 3:6].mean() < 32
    broken = stack.replace(**{name: stack[name].copy() for name in ("primal", "specular")})
    broken["primal"][7, 7] = broken["specular"][7, 7] = np.nan
    repaired = ngpt.denoise(broken, "ngpt", weights=path)
    assert np.isfinite(repaired).all() and np.abs(repaired - image).max() < 1
    with pytest.raises(NgptError, match="need layers diffuse, specular, diffuse_var, specular_var, which"):
        ngpt.denoise(whole, "ngpt", weights=path)


@pytest.mark.parametrize("config", [KPCN, ModelConfig("dense", (4,), (1,), ("primal", "diffuse_se"))])
def test_light_of_two_parts_has_no_graph(tmp_path, config):
    pytest.importorskip("onnxscript")
    from ngpt.export.network import network_model

    save_weights(tmp_path / "w.safetensors", Reconstructor(config), {})
    with pytest.raises(NgptError, match="for which there is no ONNX graph; run its weights in PyTorch"):
        network_model(tmp_path / "w.safetensors", "mine")
