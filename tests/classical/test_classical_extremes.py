"""Laws of all classical reconstructions, and input that is extreme, degenerate or mirrored."""

import numpy as np
import pytest
from solvers import METHODS, noisy_stack

import ngpt
from ngpt.classical.gradients import forward_differences
from ngpt.classical.poisson import l1, l2
from ngpt.measure.metrics import relmse

SIZES = [(1, 1), (2, 2), (1, 17), (23, 1), (13, 31)]
every_method = pytest.mark.parametrize("name", METHODS)


def run(name, primal, dx, dy, variances, trusted=None):
    result = METHODS[name](primal, dx, dy, variances, trusted)
    assert result.shape == primal.shape and result.dtype == primal.dtype
    assert np.isfinite(result).all()
    return result


# Noise, sums, bits


@every_method
def test_the_error_falls_well_below_that_of_the_primal(name):
    truth, *data, variances = noisy_stack(64, 96)
    assert relmse(run(name, *data, variances), truth) < 0.25 * relmse(data[0], truth)


@pytest.mark.parametrize("name", ["l2", "cv"])
def test_linear_methods_add_up_over_light_groups_and_keep_the_mean(name):
    groups = [noisy_stack(40, 33, seed)[1:4] for seed in range(3)]
    data = [sum(layers) for layers in zip(*groups, strict=True)]
    together, apart = run(name, *data, None), sum(run(name, *group, None) for group in groups)
    assert np.abs(apart - together).max() <= 2e-6 * np.abs(together).max()
    assert together.mean() == pytest.approx(data[0].mean(), rel=0.02)


@every_method
def test_untrusted_differences_have_no_influence(name):
    _, primal, *gradients, variances = noisy_stack(21, 17)
    trusted = tuple(np.random.default_rng(1).random((2, 21, 17)) > 0.1)
    results = []
    for garbage in (0.0, 1e3):
        layers = [np.where(t[..., None], d, np.float32(garbage)) for t, d in zip(trusted, gradients, strict=True)]
        results.append(run(name, primal, *layers, variances, trusted))
    assert np.abs(results[0] - results[1]).max() <= 1e-5 * np.abs(results[1]).max()


@every_method
def test_bands_of_rows_make_no_difference(monkeypatch, name):
    _, *data, variances = noisy_stack(61, 40)
    expected = run(name, *data, variances)
    monkeypatch.setattr("ngpt.classical.arrays.BAND", 40)  # one row
    # The sums that steer the iterations are rounded differently.
    off = np.abs(run(name, *data, variances) - expected).max()
    assert off <= (1e-3 if name == "wl2" else 1e-5) * np.abs(expected).max()


# Trivial images, α


def shaded(size):
    return noisy_stack(*size)[0]


EXACT = {f"{h}x{w}": shaded((h, w)) for h, w in SIZES}
EXACT |= {str(value): np.full((11, 14, 3), value, np.float32) for value in (0.0, 1e-30, 1.0, 1e12)}


@every_method
@pytest.mark.parametrize("variance", [(0.1, 0.01, 0.01), (0.0, 0.0, 0.0)])
@pytest.mark.parametrize("image", EXACT.values(), ids=EXACT)
def test_exact_gradients_return_the_image(name, image, variance):
    variances = [np.full_like(image, v) for v in variance]
    assert np.array_equal(run(name, image, *forward_differences(image), variances), image)


@pytest.mark.parametrize("alpha", [1e-6, 1e-3, 0.2, 1e3, 1e6])
def test_every_alpha_keeps_the_mean_of_l2_and_the_largest_the_primal(alpha):
    _, *data, _ = noisy_stack(45, 61)
    results = [method(*data, alpha) for method in (l2, l1)]
    assert np.isfinite(results).all()
    assert np.allclose(results[0].mean((0, 1), np.float64), data[0].mean((0, 1), np.float64), rtol=1e-6)
    if alpha == 1e6:
        assert np.allclose(results, data[0], atol=1e-4)
    if alpha == 1e-6:  # differences are the projected gradients, whatever α is
        double = [layer.astype(np.float64) for layer in data]
        assert np.allclose(l2(*double, alpha), l2(*double, 1e-5), atol=1e-6)


def test_alpha_may_be_derived():
    _, primal, dx, dy, variances = noisy_stack(20, 19)
    bare = ngpt.GradientStack.from_arrays(primal=primal, dx=dx, dy=dy)
    full = bare.replace(primal_var=variances[0], dx_var=variances[1], dy_var=variances[2])
    for method in ("l2", "l1"):
        derived, fixed = (ngpt.denoise(full, method, alpha=a) for a in ("auto", 0.2))
        assert not np.allclose(derived, fixed, atol=1e-4)
        # Without variances there is nothing to derive it from.
        assert np.array_equal(ngpt.denoise(bare, method, alpha="auto"), fixed)


# Exposure, outliers, missing values


@pytest.mark.parametrize(("name", "tolerance"), [("l2", 1e-4), ("cv", 1e-5), ("wcv", 1e-2)])
def test_one_pixel_of_1e12_leaves_the_far_image_alone(name, tolerance):
    """Its influence ends where the method's does, not where the rounding of 1e12 in float32 transforms would."""
    _, primal, dx, dy, variances = noisy_stack(24, 400)
    before = run(name, primal, dx, dy, variances)
    primal[12, 3], variances[0][12, 3] = 1e12, 1e24
    # exp(-0.2 d) takes 1e12 below 1e-5 of the image in 230 pixels.
    assert np.abs(run(name, primal, dx, dy, variances) - before)[:, 260:].max() < tolerance * before.max()


@every_method
@pytest.mark.parametrize("layers", [(0,), (1,), (2,), (0, 1, 2)])
def test_zero_variance_is_stable(name, layers):
    truth, primal, dx, dy, variances = noisy_stack(24, 30)
    run(name, primal, dx, dy, [0 * v if i in layers else v for i, v in enumerate(variances)])
    for i in layers:
        variances[i][:, :15] = 0
    result = run(name, primal, dx, dy, variances)
    assert np.abs(result - truth).mean() < np.abs(primal - truth).mean()


@every_method
@pytest.mark.parametrize("value", [np.nan, np.inf, -1.0])
def test_missing_variances_are_filled_from_their_neighbours(name, value):
    _, *data, variances = noisy_stack(24, 30)
    holes = np.random.default_rng(1).random((24, 30)) < 0.2
    broken = [np.where(holes[..., None], np.float32(value), v) for v in variances]
    whole, result = run(name, *data, variances), run(name, *data, broken)
    assert np.sqrt(np.mean((whole - result) ** 2)) < 0.25 * whole.std()
    run(name, *data, [np.full_like(v, value) for v in variances])


# Symmetry


def mirrored(primal, dx, dy, variances):
    """The same stack seen from the left to the right: dx changes sign and belongs to the pixel on its other side."""

    def shifted(a):
        return np.concatenate([a[:, -2::-1], a[:, -1:]], 1)

    p, x, y = variances
    return primal[:, ::-1], -shifted(dx), dy[:, ::-1], (p[:, ::-1], shifted(x), y[:, ::-1])


def transposed(primal, dx, dy, variances):
    p, x, y = variances
    swap = (1, 0, 2)
    return primal.transpose(swap), dy.transpose(swap), dx.transpose(swap), [a.transpose(swap) for a in (p, y, x)]


@every_method
@pytest.mark.parametrize("size", [(30, 41), (16, 16), (1, 9), (7, 1)])
def test_mirrored_and_transposed_inputs_give_mirrored_and_transposed_results(name, size):
    _, *data, variances = noisy_stack(*size, dtype=np.float64)
    expected = run(name, *data, variances)
    assert np.abs(run(name, *mirrored(*data, variances))[:, ::-1] - expected).max() < 1e-6
    assert np.abs(run(name, *transposed(*data, variances)).transpose(1, 0, 2) - expected).max() < 1e-6
