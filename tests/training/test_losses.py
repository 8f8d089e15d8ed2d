"""The losses: distances that are 0 for equal images, with gradients that are finite everywhere."""

import hashlib
import json

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from scipy.stats import chisquare

from ngpt.errors import NgptError
from ngpt.measure.distances import backbones, elpips, ensemble
from ngpt.measure.distances.structural import structural_distance
from ngpt.training import pixelwise
from ngpt.training.loss import make_loss


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def images(*shape, seed=0):
    return torch.rand(*shape, generator=generator(seed))


def random_elpips(kind):
    """The metric with weights of nobody: its graph is all that can be tested without the fitted ones."""
    torch.manual_seed(3)
    backbone = kind()
    for parameter in backbone.parameters():
        if parameter.ndim > 1:
            torch.nn.init.kaiming_normal_(parameter)
    return elpips.FeatureDistance(backbone, [torch.rand(c) for c in kind.CHANNELS])


DISTANCES = {
    "structural": lambda: structural_distance,
    "squeeze": lambda: random_elpips(backbones.SqueezeNet),
    "vgg": lambda: random_elpips(backbones.Vgg16),
    "l1": lambda: pixelwise.l1,
    "gradient": lambda: pixelwise.gradient_l1,
    "relative": lambda: pixelwise.relative,
}


@pytest.fixture(scope="module", params=DISTANCES)
def distance(request):
    return DISTANCES[request.param]()


def test_a_distance_is_zero_for_equal_images_positive_else_and_symmetric(distance):
    a, b = images(2, 3, 48, 40), images(2, 3, 48, 40, seed=1)
    assert distance(a, a).item() == pytest.approx(0, abs=1e-6)
    assert distance(a, b).item() > 1e-3
    assert distance(a, b).item() == pytest.approx(distance(b, a).item(), rel=1e-4)
    assert distance(a, a + 0.1 * (b - a)).item() < distance(a, b).item()


@pytest.mark.parametrize("value", [0.0, 1.0, 1e6])
def test_slopes_are_finite_on_flat_images(distance, value):
    for other in (torch.full((1, 3, 40, 40), value), images(1, 3, 40, 40)):
        flat = torch.full((1, 3, 40, 40), value, requires_grad=True)
        distance(flat, other).backward()
        assert torch.isfinite(flat.grad).all()


@pytest.mark.parametrize("size", [(1, 1), (5, 40), (200, 180)])
def test_the_structural_distance_takes_every_size(size):
    a, b = images(1, 3, *size), images(1, 3, *size, seed=1)
    assert 0 < structural_distance(a, b) <= 2 and structural_distance(a, a).abs() < 1e-6


# The ensemble


def draws(count, batch=4, size=600):
    g = generator(7)
    return [ensemble.draw(batch, size, size, g) for _ in range(count)]


def agrees(counts, expected):
    """Whether counts come from a distribution, at the level of one in ten thousand."""
    return chisquare(counts, np.array(expected) / np.sum(expected) * np.sum(counts)).pvalue > 1e-4


def test_transforms_have_the_published_distributions():
    every = draws(4000)
    assert agrees(np.bincount([t.scale for t in every], minlength=9)[1:], [1 / k**2 for k in range(1, 9)])
    assert agrees(np.bincount(torch.cat([t.offset.flatten() for t in every]).numpy()), np.ones(8))
    assert agrees(np.bincount(torch.cat([t.flip for t in every]).numpy()), np.ones(4))
    assert agrees(np.bincount([t.transpose for t in every]), np.ones(2))
    orders = torch.cat([t.order for t in every])
    assert agrees(np.bincount((orders[:, 0] * 2 + (orders[:, 1] > orders[:, 2])).numpy()), np.ones(6))
    factors = torch.cat([t.factor for t in every]).flatten()
    assert agrees(np.histogram(factors, 16, (0.2, 1))[0], np.ones(16))
    phases = [t.phase for t in every if t.scale == 2]
    assert agrees(np.bincount([2 * y + x for y, x in phases]), np.ones(4))
    # Draws are stratified over a batch.
    for transform in draws(50, batch=12):
        assert np.bincount(transform.flip, minlength=4).tolist() == [3, 3, 3, 3]
        strata = ((transform.factor - 0.2) / 0.8 * 12).int().sort(0).values
        assert torch.equal(strata, torch.arange(12, dtype=torch.int32)[:, None].expand(12, 3))
        counts = np.unique(transform.order.numpy(), axis=0, return_counts=True)[1]
        assert counts.tolist() == [2] * 6


def test_a_transform_moves_pixels_and_scales_colours():
    image, one, none = images(1, 3, 20, 24), torch.ones(1, 3), torch.zeros(1, 2, dtype=int)
    same = ensemble.Transform(1, (0, 0), none, none[0, :1], False, torch.tensor([[0, 1, 2]]), one)
    assert torch.equal(same(image), image[..., :13, :17])
    order = torch.tensor([[2, 0, 1]])
    other = ensemble.Transform(2, (1, 0), torch.tensor([[1, 0]]), torch.tensor([1]), True, order, 0.5 * one)
    boxes = torch.nn.functional.avg_pool2d(image[..., 1:, :], 2)[..., 1:3, 0:5]
    assert torch.allclose(other(image), 0.5 * boxes[:, [2, 0, 1]].flip(-1).transpose(-1, -2))


# The composite


@pytest.mark.parametrize("value", [0.0, 1.0, 1e6])
def test_the_loss_is_finite_at_the_extremes(value):
    loss = make_loss({"relative": 1.0})
    for target in (torch.full((2, 3, 40, 40), value), images(2, 3, 40, 40)):
        prediction = torch.full((2, 3, 40, 40), value, requires_grad=True)
        total, parts = loss(prediction, target, generator())
        total.backward()
        assert torch.isfinite(total) and torch.isfinite(prediction.grad).all()
        assert set(parts) == {"perceptual", "l1", "gradient", "relative"}


@pytest.mark.parametrize(
    ("settings", "weights"),
    [
        ({"l1": 0.5, "gradient": 0.25, "relative": 2.0}, {"perceptual": 1, "l1": 0.5, "gradient": 0.25, "relative": 2}),
        ({"kind": "l1"}, {"l1": 1, "gradient": 0.01}),
    ],
)
def test_the_loss_is_the_weighted_sum_of_its_parts(settings, weights):
    total, parts = make_loss(settings)(images(1, 3, 40, 40), images(1, 3, 40, 40, seed=1), generator())
    assert parts.keys() == weights.keys()
    assert torch.allclose(total, sum(weight * parts[name] for name, weight in weights.items()))


@pytest.mark.parametrize(
    ("settings", "complaint"),
    [
        ({"kind": "perceptive"}, "choose one of"),
        ({"kinds": "l1"}, "unknown key 'kinds'"),
        ({"l1": -1.0}, "not negative"),
        ({"l1": float("nan")}, "must be finite"),
        ({"l1": "much"}, "must be a number, like 0.01"),
        ({"evaluations": 0}, "at least 1"),
    ],
)
def test_settings_are_checked(settings, complaint):
    with pytest.raises(NgptError, match=complaint):
        make_loss(settings)


# Backbones and their files


@pytest.mark.parametrize(
    ("kind", "digest", "parameters", "sizes"),
    [
        (backbones.SqueezeNet, "5b060b3adcad5f2d", 722_496, [64, 31, 15, 15, 7, 7, 3, 3, 3, 3]),
        (backbones.Vgg16, "18e7486b4273ddb0", 14_714_688, [64, 64, 64, 32, 32, 16, 16, 16, 8, 8, 8, 4, 4, 4]),
    ],
)
def test_backbones_are_those_of_torchvision(kind, digest, parameters, sizes):
    """By the names and shapes of all tensors in torchvision's files, their number, and the sizes of features."""
    network = kind()
    shapes = {name: list(tensor.shape) for name, tensor in network.state_dict().items()}
    assert hashlib.sha256(json.dumps(shapes, sort_keys=True).encode()).hexdigest().startswith(digest)
    assert sum(tensor.numel() for tensor in network.state_dict().values()) == parameters
    features = list(network(images(1, 3, 64, 64), lambda x: x))
    assert tuple(f.shape[1] for f in features) == kind.CHANNELS
    assert [f.shape[2] for f in features] == sizes


@pytest.fixture
def files(tmp_path):
    """Settings of E-LPIPS with files as torchvision's, with the classifier's tensors beside the features'."""
    network = backbones.SqueezeNet()
    save_file(network.state_dict() | {"classifier.1.weight": torch.zeros(1)}, tmp_path / "backbone.safetensors")
    save_file({f"lin{i}": torch.rand(1, c, 1, 1) for i, c in enumerate(network.CHANNELS)}, tmp_path / "lin.safetensors")
    torch.save(network.state_dict(), tmp_path / "a.pth")
    damaged = {n: t * torch.nan for n, t in network.state_dict().items()}
    save_file(damaged, tmp_path / "damaged.safetensors")
    save_file({f"lin{i}": -torch.ones(c) for i, c in enumerate(network.CHANNELS)}, tmp_path / "negative.safetensors")
    named = {"backbone": "backbone.safetensors", "weights": "lin.safetensors"}
    return {"kind": "elpips-squeeze"} | {name: str(tmp_path / file) for name, file in named.items()}


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"backbone": ""}, r"squeezenet1_1-b8a52dc0\.pth: no such file; get .* \"structural\" needs no weights"),
        ({"weights": ""}, "loss.weights is not set"),
        ({"weights": "nowhere"}, "nowhere: no such file"),
        ({"weights": "a.pth"}, "not a readable safetensors file"),
        ({"weights": "negative.safetensors"}, "'lin0' holds numbers that are negative"),
        ({"backbone": "a.pth"}, r"checksum is not b8a52dc0.*convert other weights to \.safetensors"),
        ({"backbone": "lin.safetensors"}, r"'features.0.weight' should be \[64, 3, 3, 3\], is missing"),
        ({"backbone": "damaged.safetensors"}, "'features.0.(bias|weight)' holds values that are not finite"),
        ({"kind": "elpips-vgg"}, r"vector 'lin2' is of 128 numbers; it should have 64|'lin1[0-3]' is missing"),
    ],
)
def test_missing_and_damaged_files_are_explained(files, tmp_path, monkeypatch, change, complaint):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)
    with pytest.raises(NgptError, match=complaint):
        make_loss(files | change)


class Payload:
    def __reduce__(self):
        return (print, ("code was run",))


@pytest.mark.parametrize("safe", [True, False])
def test_torchvisions_own_file_is_read_and_no_code_is_run_from_it(files, tmp_path, capsys, monkeypatch, safe):
    """Not even from one that has the checksum."""
    state = backbones.SqueezeNet().state_dict()
    torch.save(state if safe else {"features.0.weight": Payload()}, tmp_path / "a.pth")
    digest = hashlib.sha256((tmp_path / "a.pth").read_bytes()).hexdigest()
    monkeypatch.setattr(backbones.SqueezeNet, "SHA256", digest)
    chosen = files | {"backbone": str(tmp_path / "a.pth")}
    if safe:
        _, parts = make_loss(chosen)(images(2, 3, 48, 48), images(2, 3, 48, 48, seed=1), generator())
        assert parts["perceptual"] > 0
        network = backbones.load(backbones.SqueezeNet, chosen["backbone"])
        assert all(torch.equal(tensor, state[name]) for name, tensor in network.state_dict().items())
        return
    with pytest.raises(NgptError, match="cannot be read as PyTorch weights"):
        make_loss(chosen)
    assert "code was run" not in capsys.readouterr().out


def test_autocast_does_not_reach_the_features():
    distance = random_elpips(backbones.SqueezeNet)
    a, b = images(1, 3, 64, 64), images(1, 3, 64, 64, seed=1)
    near = a + 1e-3 * (b - a)
    with torch.autocast("cpu", torch.bfloat16):
        inside = distance(a, near)
    assert inside == distance(a, near)


# What terms are for


def slope(loss, prediction, target):
    return torch.autograd.grad(loss(prediction, target), prediction)[0]


def test_noise_of_the_target_does_not_move_the_least_of_huber():
    """Skewed noise, of which the median lies below the mean: an absolute error has its least at the median."""
    target = 2 * torch.from_numpy(np.random.default_rng(0).gamma(20, 1 / 20, (1, 3, 200, 200))).float()

    def rises(loss, value):
        return slope(loss, torch.full_like(target, value, requires_grad=True), target).sum() > 0

    assert rises(pixelwise.huber, 2.011) and not rises(pixelwise.huber, 1.989) and rises(pixelwise.l1, 1.98)


def test_of_errors_of_one_size_the_pyramid_sees_the_wide_ones():
    """A patch that is off counts as much at every resolution; a checkerboard of the same error only at the finest."""
    target = torch.full((1, 3, 64, 64), 0.2)
    y, x = torch.meshgrid(torch.arange(64), torch.arange(64), indexing="ij")
    sign = 1 - 2.0 * ((x + y) % 2)
    assert pixelwise.pyramid(target, target).item() == 0
    for loss, share in ((pixelwise.pyramid, 1 / 4), (pixelwise.l1, 1)):
        fine, wide = (loss(target + 0.01 * s, target).item() for s in (sign, torch.ones_like(sign)))
        assert fine == pytest.approx(share * wide, rel=0.1)
