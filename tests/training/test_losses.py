"""The losses: distances that are 0 for equal images, with gradients that are finite everywhere."""

import hashlib

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from scipy.stats import chisquare
from skimage.metrics import structural_similarity

from ngpt.errors import NgptError
from ngpt.measure.distances import backbones, elpips, ensemble
from ngpt.measure.distances.structural import ms_ssim, ssim_parts, structural_distance
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
    "logarithmic": lambda: pixelwise.logarithmic,
}
every_distance = pytest.mark.parametrize("name", DISTANCES)


@every_distance
def test_a_distance_is_zero_for_equal_images_positive_else_and_symmetric(name):
    distance = DISTANCES[name]()
    a, b = images(2, 3, 48, 40), images(2, 3, 48, 40, seed=1)
    assert distance(a, a).item() == pytest.approx(0, abs=1e-6)
    assert distance(a, b).item() > 1e-3
    assert distance(a, b).item() == pytest.approx(distance(b, a).item(), rel=1e-4)
    assert distance(a, a + 0.1 * (b - a)).item() < distance(a, b).item()


@every_distance
@pytest.mark.parametrize("value", [0.0, 0.5, 1.0])
def test_gradients_are_finite_on_flat_images(name, value):
    distance = DISTANCES[name]()
    for other in (torch.full((1, 3, 40, 40), value), images(1, 3, 40, 40)):
        flat = torch.full((1, 3, 40, 40), value, requires_grad=True)
        distance(flat, other).backward()
        assert torch.isfinite(flat.grad).all()


@every_distance
def test_gradients_are_those_of_the_value(name):
    distance = DISTANCES[name]()
    a, b = images(1, 3, 36, 36).requires_grad_(), images(1, 3, 36, 36, seed=1)
    distance(a, b).backward()
    direction = images(1, 3, 36, 36, seed=2) - 0.5
    step = 1e-3
    with torch.no_grad():
        numeric = (distance(a + step * direction, b) - distance(a - step * direction, b)).item() / (2 * step)
    # The reference's own rounding decides: single precision, piecewise linear networks.
    assert (a.grad * direction).sum().item() == pytest.approx(numeric, rel=0.06, abs=1e-4)


@pytest.mark.parametrize("size", [(1, 1), (2, 3), (5, 40), (17, 9), (200, 180)])
def test_the_structural_distance_takes_every_size(size):
    a, b = images(1, 3, *size), images(1, 3, *size, seed=1)
    assert 0 < structural_distance(a, b) <= 2 and structural_distance(a, a).abs() < 1e-6


def test_ssim_is_that_of_scikit_image():
    a, b = images(1, 1, 40, 50), images(1, 1, 40, 50, seed=1)
    b = 0.6 * a + 0.4 * b
    luminance, structure = ssim_parts(a, b, stride=1)
    _, expected = structural_similarity(
        a[0, 0].double().numpy(), b[0, 0].double().numpy(), data_range=1, full=True, use_sample_covariance=False
    )
    assert np.allclose((luminance * structure)[0, 0], expected[3:-3, 3:-3], atol=1e-5)


# The ensemble


def draws(count, batch=4, size=600, **options):
    g = generator(7)
    return [ensemble.draw(batch, size, size, g, **options) for _ in range(count)]


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


def test_a_transform_moves_pixels_and_scales_colours():
    image = images(1, 3, 20, 24)
    one = torch.ones(1, 3)
    same = ensemble.Transform(
        1, (0, 0), torch.zeros(1, 2, dtype=int), torch.zeros(1, dtype=int), False, torch.tensor([[0, 1, 2]]), one
    )
    assert torch.equal(same(image), image[..., :13, :17])
    other = ensemble.Transform(
        2, (1, 0), torch.tensor([[1, 0]]), torch.tensor([1]), True, torch.tensor([[2, 0, 1]]), 0.5 * one
    )
    boxes = torch.nn.functional.avg_pool2d(image[..., 1:, :], 2)[..., 1:3, 0:5]
    assert torch.allclose(other(image), 0.5 * boxes[:, [2, 0, 1]].flip(-1).transpose(-1, -2))


# The composite


@pytest.mark.parametrize("value", [0.0, 1.0, 1e6])
def test_the_loss_is_finite_at_the_extremes(value):
    loss = make_loss({"relative": 1.0, "logarithmic": 1.0})
    for target in (torch.full((2, 3, 40, 40), value), images(2, 3, 40, 40)):
        prediction = torch.full((2, 3, 40, 40), value, requires_grad=True)
        total, parts = loss(prediction, target, generator())
        total.backward()
        assert torch.isfinite(total) and torch.isfinite(prediction.grad).all()
        assert set(parts) == {"perceptual", "l1", "gradient", "relative", "logarithmic"}


def test_the_loss_is_the_weighted_sum_of_its_parts():
    loss = make_loss({"l1": 0.5, "gradient": 0.25, "relative": 2.0})
    total, parts = loss(images(1, 3, 40, 40), images(1, 3, 40, 40, seed=1), generator())
    expected = parts["perceptual"] + 0.5 * parts["l1"] + 0.25 * parts["gradient"] + 2 * parts["relative"]
    assert torch.allclose(total, expected)
    total, parts = make_loss({"kind": "l1"})(images(1, 3, 40, 40), images(1, 3, 40, 40, seed=1), generator())
    assert torch.allclose(total, parts["l1"] + 0.01 * parts["gradient"])


# Backbones and their files

# Index of each fire module, its channels in, squeezed and expanded (each of two); of each convolution, in and out.
_FIRES = {3: (64, 16, 64), 4: (128, 16, 64), 6: (128, 32, 128), 7: (256, 32, 128), 9: (256, 48, 192)}
_FIRES |= {10: (384, 48, 192), 11: (384, 64, 256), 12: (512, 64, 256)}
SQUEEZENET = {"features.0.weight": [64, 3, 3, 3], "features.0.bias": [64]}
for _i, (_in, _squeezed, _out) in _FIRES.items():
    for _name, _shape in {
        "squeeze": [_squeezed, _in, 1, 1],
        "expand1x1": [_out, _squeezed, 1, 1],
        "expand3x3": [_out, _squeezed, 3, 3],
    }.items():
        SQUEEZENET |= {f"features.{_i}.{_name}.weight": _shape, f"features.{_i}.{_name}.bias": _shape[:1]}
VGG16 = {}
for _i, _in, _out in [
    (0, 3, 64), (2, 64, 64), (5, 64, 128), (7, 128, 128), (10, 128, 256), (12, 256, 256), (14, 256, 256),
    (17, 256, 512), (19, 512, 512), (21, 512, 512), (24, 512, 512), (26, 512, 512), (28, 512, 512),
]:  # fmt: skip
    VGG16 |= {f"features.{_i}.weight": [_out, _in, 3, 3], f"features.{_i}.bias": [_out]}


@pytest.mark.parametrize(
    ("kind", "shapes", "parameters", "sizes"),
    [
        (backbones.SqueezeNet, SQUEEZENET, 722_496, [64, 31, 15, 15, 7, 7, 3, 3, 3, 3]),
        (backbones.Vgg16, VGG16, 14_714_688, [64, 64, 64, 32, 32, 16, 16, 16, 8, 8, 8, 4, 4, 4]),
    ],
)
def test_backbones_are_those_of_torchvision(kind, shapes, parameters, sizes):
    network = kind()
    state = network.state_dict()
    assert sum(t.numel() for t in state.values()) == parameters
    assert {name: list(tensor.shape) for name, tensor in state.items()} == shapes
    features = list(network(images(1, 3, 64, 64), lambda x: x))
    assert tuple(f.shape[1] for f in features) == kind.CHANNELS
    assert [f.shape[2] for f in features] == sizes


def weight_files(folder, kind=backbones.SqueezeNet):
    network = kind()
    # As torchvision's files, with the classifier's tensors beside the features'.
    save_file(network.state_dict() | {"classifier.1.weight": torch.zeros(1)}, folder / "backbone.safetensors")
    save_file({f"lin{i}": torch.rand(1, c, 1, 1) for i, c in enumerate(kind.CHANNELS)}, folder / "lin.safetensors")
    return {"backbone": str(folder / "backbone.safetensors"), "weights": str(folder / "lin.safetensors")}


def test_elpips_trains_when_its_files_are_there(tmp_path):
    loss = make_loss({"kind": "elpips-squeeze", **weight_files(tmp_path)})
    prediction = images(2, 3, 48, 48).requires_grad_()
    total, parts = loss(prediction, images(2, 3, 48, 48, seed=1), generator())
    total.backward()
    assert parts["perceptual"] > 0 and torch.isfinite(prediction.grad).all() and prediction.grad.abs().max() > 0


def test_missing_and_damaged_files_are_explained(tmp_path, monkeypatch):
    files = weight_files(tmp_path)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "cache"))
    pickled, empty, damaged = str(tmp_path / "a.pth"), *(str(tmp_path / f"{n}.safetensors") for n in ("b", "c"))
    torch.save(backbones.SqueezeNet().state_dict(), pickled)
    save_file({"x": torch.zeros(3)}, empty)
    state = backbones.SqueezeNet().state_dict()
    state["features.0.bias"][5] = torch.nan
    save_file(state, damaged)
    cases = [
        ({"backbone": ""}, r"squeezenet1_1-b8a52dc0\.pth: no such file; get .* \"structural\" needs no weights"),
        ({"weights": ""}, "loss.weights is not set"),
        ({"weights": "nowhere"}, "nowhere: no such file"),
        ({"weights": pickled}, "not a readable safetensors file"),
        ({"backbone": __file__}, r"checksum is not b8a52dc0.*convert other weights to \.safetensors"),
        ({"backbone": pickled}, r"checksum is not b8a52dc0"),
        ({"backbone": empty}, r"'features.0.weight' should be \[64, 3, 3, 3\], is missing"),
        ({"backbone": damaged}, "'features.0.bias' holds values that are not finite"),
        ({"backbone": files["weights"]}, r"'features.0.weight' should be \[64, 3, 3, 3\], is missing"),
        ({"kind": "elpips-vgg"}, r"vector 'lin2' is of 128 numbers; it should have 64|'lin1[0-3]' is missing"),
    ]
    for change, complaint in cases:
        with pytest.raises(NgptError, match=complaint):
            make_loss({"kind": "elpips-squeeze", **files, **change})
    cache = tmp_path / "cache" / "hub" / "checkpoints"
    cache.mkdir(parents=True)
    (cache / backbones.SqueezeNet.FILE).write_bytes((tmp_path / "a.pth").read_bytes())
    with pytest.raises(NgptError, match=r"checksum is not b8a52dc0"):
        make_loss({"kind": "elpips-squeeze", **files, "backbone": ""})
    save_file({f"lin{i}": -torch.ones(c) for i, c in enumerate(backbones.SqueezeNet.CHANNELS)}, files["weights"])
    with pytest.raises(NgptError, match="'lin0' holds numbers that are negative"):
        make_loss({"kind": "elpips-squeeze", **files})


class Payload:
    def __reduce__(self):
        return (print, ("code was run",))


def pose_as_torchvision(monkeypatch, path):
    monkeypatch.setattr(backbones.SqueezeNet, "SHA256", hashlib.sha256(path.read_bytes()).hexdigest())


def test_torchvisions_own_file_is_read(tmp_path, monkeypatch):
    files, path = weight_files(tmp_path), tmp_path / "any.pth"
    state = backbones.SqueezeNet().state_dict()
    torch.save(state, path)
    pose_as_torchvision(monkeypatch, path)
    network = backbones.load(backbones.SqueezeNet, str(path))
    assert all(torch.equal(tensor, state[name]) for name, tensor in network.state_dict().items())
    make_loss({"kind": "elpips-squeeze", **files, "backbone": str(path)})


def test_no_code_is_run_from_weight_files(tmp_path, capsys, monkeypatch):
    """Not even from one that has the checksum."""
    files, path = weight_files(tmp_path), tmp_path / "any.pth"
    torch.save({"features.0.weight": Payload()}, path)
    pose_as_torchvision(monkeypatch, path)
    with pytest.raises(NgptError, match="cannot be read as PyTorch weights"):
        make_loss({"kind": "elpips-squeeze", **files, "backbone": str(path)})
    assert "code was run" not in capsys.readouterr().out


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


def test_noise_of_the_target_does_not_move_the_least_of_huber():
    """Skewed noise, of which the median lies below the mean: an absolute error has its least at the median."""
    target = 2 * torch.from_numpy(np.random.default_rng(0).gamma(20, 1 / 20, (1, 3, 200, 200))).float()
    best = {}
    for name, loss in (("huber", pixelwise.huber), ("l1", pixelwise.l1)):
        values = torch.linspace(1.9, 2.1, 41)
        # The slope, as training sees it, changes its sign at the least.
        slopes = []
        for value in values:
            prediction = torch.full_like(target, value.item(), requires_grad=True)
            loss(prediction, target).backward()
            slopes.append(prediction.grad.sum().item())
        best[name] = values[int(np.argmax(np.array(slopes) > 0))].item()
    assert best["huber"] == pytest.approx(2, abs=0.011)
    assert best["l1"] < 1.98


def test_a_firefly_of_the_target_counts_once_whatever_its_brightness():
    prediction, target = torch.ones(1, 3, 8, 8, requires_grad=True), torch.ones(1, 3, 8, 8)
    gradients = []
    for firefly in (10.0, 1e6):
        target[0, :, 3, 3] = firefly
        gradients.append(torch.autograd.grad(pixelwise.huber(prediction, target), prediction)[0])
    assert torch.allclose(*gradients)


def windows_of_7(image):
    """Windows of 7x7 pixels, every third, (N, 49)."""
    starts = range(0, image.shape[0] - 6, 3)
    return np.array([image[y : y + 7, x : x + 7].ravel() for y in starts for x in starts])


def test_ms_ssim_is_the_product_over_the_scales_by_brute_force():
    rng = np.random.default_rng(4)
    a = rng.random((14, 14))
    b = np.clip(a + 0.1 * rng.standard_normal(a.shape), 0, 1)
    images_at = [(a, b), tuple(image.reshape(7, 2, 7, 2).mean((1, 3)) for image in (a, b))]
    expected, weights = 1.0, np.array([0.0448, 0.2856]) / (0.0448 + 0.2856)
    for scale, weight in enumerate(weights):
        x, y = (windows_of_7(image) for image in images_at[scale])
        covariance = (x * y).mean(1) - x.mean(1) * y.mean(1)
        similarity = (2 * covariance + 0.03**2) / (x.var(1) + y.var(1) + 0.03**2)
        if scale == 1:
            mx, my = x.mean(1), y.mean(1)
            similarity *= (2 * mx * my + 0.01**2) / (mx**2 + my**2 + 0.01**2)
        expected *= similarity.mean() ** weight
    value = ms_ssim(*(torch.tensor(image)[None, None] for image in (a, b)))
    assert value.shape == (1, 1) and value.item() == pytest.approx(expected, rel=1e-5)


def test_the_loss_of_oidn_is_zero_for_equal_images_and_looks_at_them_at_their_own_exposure():
    a, b = 8 * images(2, 3, 48, 40), 8 * images(2, 3, 48, 40, seed=1)
    loss = make_loss({"kind": "pu", "l1": 0.0, "gradient": 0.0})
    assert loss(a, a, generator())[0].item() == pytest.approx(0, abs=1e-5)
    value = loss(a, b, generator())[0].item()
    assert 0.1 < value < 1
    # The exposure is that of the target: an image a hundred times as bright looks the same.
    assert loss(100 * a, 100 * b, generator())[0].item() == pytest.approx(value, rel=1e-4)


def test_tone_mapping_is_that_of_ngpt():
    grey, red = torch.full((1, 3, 1, 1), 1e9), torch.zeros(1, 3, 1, 1)
    red[:, 0] = 1e9
    assert pixelwise.tone_mapped(grey).flatten().tolist() == pytest.approx([1, 1, 1])
    assert pixelwise.tone_mapped(red).flatten().tolist() == pytest.approx([3, 0, 0])


def test_autocast_does_not_reach_the_features():
    distance = random_elpips(backbones.SqueezeNet)
    a, b = images(1, 3, 64, 64), images(1, 3, 64, 64, seed=1)
    near = a + 1e-3 * (b - a)
    with torch.autocast("cpu", torch.bfloat16):
        inside = distance(a, near)
    assert inside == distance(a, near)


def test_draws_are_stratified_over_the_batch():
    for transform in draws(50, batch=12):
        assert np.bincount(transform.flip, minlength=4).tolist() == [3, 3, 3, 3]
        assert all(
            sorted(((column - 0.2) / 0.8 * 12).int().tolist()) == list(range(12)) for column in transform.factor.T
        )
        counts = np.unique(transform.order.numpy(), axis=0, return_counts=True)[1]
        assert counts.tolist() == [2] * 6


def test_of_errors_of_one_size_the_pyramid_sees_the_wide_ones():
    """A patch that is off counts as much at every resolution; a checkerboard of the same error only at the finest."""
    target = torch.full((1, 3, 64, 64), 0.2)
    y, x = torch.meshgrid(torch.arange(64), torch.arange(64), indexing="ij")
    sign = 1 - 2.0 * ((x + y) % 2)
    fine, wide = (pixelwise.pyramid(target + 0.01 * s, target).item() for s in (sign, torch.ones_like(sign)))
    assert pixelwise.pyramid(target, target).item() == 0
    assert fine == pytest.approx(wide / 4, rel=0.1)
    assert pixelwise.l1(target + 0.01 * sign, target).item() == pytest.approx(
        pixelwise.l1(target + 0.01, target).item(), rel=0.1
    )
