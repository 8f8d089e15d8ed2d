"""KPCN: what its head makes of a prediction, that it learns by it, and configurations that cannot be."""

import numpy as np
import pytest
import torch
from full_stack import full_stack
from networks import SPLIT, close, image_of, no_graph
from torch.nn.functional import avg_pool2d

import ngpt
from ngpt.errors import NgptError
from ngpt.network.model import ModelConfig, Reconstructor, parameters
from ngpt.network.safetensors import save_weights
from ngpt.stack import GradientStack
from ngpt.system import configs
from ngpt.training.settings import read_settings
from ngpt_studies.kpcn import EPSILON, SplitKernels

KPCN = ModelConfig("kpcn", (6,), (2,), SPLIT, kernel=5)
RIGHT = {"network": "kpcn", "channels": (6,), "units": (2,), "inputs": SPLIT, "kernel": 5}
WRONG = [
    ({"inputs": ("primal", "diffuse", "albedo")}, "network 'kpcn' needs the inputs .*; lacks specular"),
    ({"kernel": 0}, "must be an odd number from 3 to 21"),
    ({"kernel": 23}, "must be an odd number from 3 to 21"),
    ({"channels": (4, 4), "units": (1, 1)}, "'kpcn' has one level"),
    ({"units": ()}, "give a positive number, up to 32, for each of 1 levels"),
    ({"start": ("primal",)}, "network 'kpcn' cannot be combined with start"),
    ({"sweeps": 2, "quiet": 1.0}, "network 'kpcn' cannot be combined with quiet, sweeps"),
    ({"network": "kpcm"}, r"unknown network 'kpcm'; did you mean 'kpcn'\?"),
]


@pytest.mark.parametrize(("change", "message"), WRONG)
def test_configurations_that_cannot_be(change, message):
    with pytest.raises(NgptError, match=message):
        ModelConfig(**RIGHT | change)


def test_it_has_no_graph(tmp_path):
    assert no_graph(tmp_path, KPCN)


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


def test_it_has_the_papers_size():
    model = Reconstructor(read_settings(configs.find_config("kpcn", configs.TRAINING)).model)
    # Nine layers of 100 channels: seven hidden ones of 250,000 weights in each network.
    assert 3.5e6 < parameters(model) < 4e6 and model.config.head.outputs == 2 * 441
