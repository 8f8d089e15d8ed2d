"""Classical reconstructions where the input is extreme, degenerate or mirrored."""

import numpy as np
import pytest
from solvers import METHODS, noisy_stack

import ngpt
from ngpt.classical.gradients import forward_differences
from ngpt.classical.poisson import l1, l2

SIZES = [(1, 1), (1, 2), (2, 1), (2, 2), (1, 17), (23, 1), (3, 3), (13, 31), (37, 16)]
every_method = pytest.mark.parametrize("name", METHODS)
every_alpha = pytest.mark.parametrize("alpha", [1e-6, 1e-3, 0.2, 1e3, 1e6])


def run(name, primal, dx, dy, variances):
    result = METHODS[name](primal, dx, dy, variances)
    assert result.shape == primal.shape and result.dtype == primal.dtype
    assert np.isfinite(result).all()
    return result


def exact_stack(height, width, seed=0):
    truth = noisy_stack(height, width, seed)[0]
    return (truth, *forward_differences(truth)), tuple(np.full_like(truth, v) for v in (0.1, 0.01, 0.01))


# Sizes and trivial images


@every_method
@pytest.mark.parametrize("size", SIZES)
def test_exact_gradients_return_the_image(name, size):
    data, variances = exact_stack(*size)
    assert np.array_equal(run(name, *data, variances), data[0])


@every_method
@pytest.mark.parametrize("value", [0.0, 1e-30, 1.0, 1e12])
def test_constant_images(name, value):
    image = np.full((11, 14, 3), value, np.float32)
    none = np.zeros_like(image)
    for variance in (0.0, 1.0):
        result = run(name, image, none, none, (none + np.float32(variance),) * 3)
        assert np.array_equal(result, image)


@pytest.mark.parametrize("channels", [1, 4])
def test_any_number_of_channels(channels):
    _, *data, variances = noisy_stack(12, 15, channels=channels)
    for name in METHODS:
        run(name, *data, variances)


def curl(height, width):
    """Gradients (rotated differences of a potential) whose divergence is zero: no image has anything in common."""
    potential = np.random.default_rng(0).standard_normal((height + 1, width + 1, 3))
    potential[[0, -1]] = potential[:, [0, -1]] = 0
    dx, dy = np.zeros((2, height, width, 3))
    # Every difference is a flux through the edge between two pixels; the potential lives on the corners.
    dx[:, :-1] = potential[1:, 1:-1] - potential[:-1, 1:-1]
    dy[:-1] = -(potential[1:-1, 1:] - potential[1:-1, :-1])
    return dx, dy


@every_alpha
def test_gradients_of_pure_curl_change_nothing_in_l2(alpha):
    _, primal, *_ = noisy_stack(21, 18, dtype=np.float64)
    dx, dy = forward_differences(primal)
    swirl = curl(21, 18)
    assert np.abs(l2(primal, dx + swirl[0], dy + swirl[1], alpha) - primal).max() < 1e-9


# alpha


@every_alpha
def test_l2_keeps_the_mean_for_every_alpha(alpha):
    _, *data, _ = noisy_stack(45, 61)
    result = l2(*data, alpha)
    assert np.isfinite(result).all()
    assert np.allclose(result.mean((0, 1), np.float64), data[0].mean((0, 1), np.float64), rtol=1e-6)


@pytest.mark.parametrize("method", [l2, l1])
def test_alpha_between_its_ends(method):
    """Small: differences are the projected gradients, whatever α is; large: the primal."""
    _, *data, _ = noisy_stack(31, 26, dtype=np.float64)
    assert np.allclose(method(*data, 1e6), data[0], atol=1e-4)
    small, smaller = (method(*data, alpha) for alpha in (1e-5, 1e-6))
    assert np.isfinite(small).all() and np.isfinite(smaller).all()
    if method is l2:
        assert np.allclose(small, smaller, atol=1e-6)


# Exposure


@every_method
@pytest.mark.parametrize("exponent", [-60, -10, 1, 10, 60])
def test_powers_of_two_scale_the_result_exactly(name, exponent):
    _, primal, dx, dy, variances = noisy_stack(33, 29)
    k = 2.0**exponent
    scaled = [a * np.float32(k) for a in (primal, dx, dy)]
    # 2^-120 times a variance is near the end of float32: given in double precision.
    expected = run(name, primal, dx, dy, [v.astype(np.float64) for v in variances])
    result = run(name, *scaled, [v.astype(np.float64) * k * k for v in variances])
    assert np.array_equal(result, expected * np.float32(k))


# Outliers and missing values


@pytest.mark.parametrize(("name", "tolerance"), [("l2", 1e-4), ("cv", 1e-5), ("wcv", 1e-2)])
def test_one_pixel_of_1e12_leaves_the_far_image_alone(name, tolerance):
    """Its influence ends where the method's does, not where the rounding of 1e12 in float32 transforms would."""
    _, primal, dx, dy, variances = noisy_stack(24, 400)
    hot = primal.copy()
    hot[12, 3] = 1e12
    hot_variances = [v.copy() for v in variances]
    hot_variances[0][12, 3] = 1e24
    before = run(name, primal, dx, dy, variances)
    after = run(name, hot, dx, dy, hot_variances)
    # exp(-0.2 d) takes 1e12 below 1e-5 of the image in 230 pixels.
    assert np.abs(after - before)[:, 260:].max() < tolerance * before.max()


@every_method
def test_the_largest_and_smallest_floats_are_survived(name):
    _, primal, dx, dy, _ = noisy_stack(12, 13)
    for value in (1e30, 1e-30, -1e20):
        broken = [a.copy() for a in (primal, dx, dy)]
        for layer in broken:
            layer[3, 4] = value
        run(name, *broken, [np.zeros_like(primal)] * 3)


@every_method
def test_zero_variance_is_stable(name):
    truth, primal, dx, dy, variances = noisy_stack(24, 30)
    none = [np.zeros_like(v) for v in variances]
    run(name, primal, dx, dy, none)
    for layer in range(3):
        some = list(variances)
        some[layer] = none[layer]
        run(name, primal, dx, dy, some)
    half = [v.copy() for v in variances]
    for v in half:
        v[:, :15] = 0
    result = run(name, primal, dx, dy, half)
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


@pytest.mark.parametrize("name", [name for name in ngpt.METHODS if name in ("primal", *METHODS)])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_pixels_and_gradients_that_are_not_finite_are_repaired(name, value):
    _, primal, dx, dy, variances = noisy_stack(24, 30)
    layers = dict(zip(("primal", "dx", "dy"), (primal, dx, dy), strict=True))
    layers |= dict(zip(("primal_var", "dx_var", "dy_var"), variances, strict=True))
    good = ngpt.reconstruct(ngpt.GradientStack.from_arrays(**layers), name)
    for layer in layers.values():
        layer[10:12, 11] = value
    result = ngpt.reconstruct(ngpt.GradientStack.from_arrays(**layers), name)
    assert result.repaired == 2 and np.isfinite(result.image).all()
    far = np.abs(result.image - good.image)[:, 22:].max()
    assert far < 0.1 * good.image.max()


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


# The registry


def test_alpha_may_be_derived():
    _, primal, dx, dy, variances = noisy_stack(20, 19)
    bare = ngpt.GradientStack.from_arrays(primal=primal, dx=dx, dy=dy)
    full = bare.replace(primal_var=variances[0], dx_var=variances[1], dy_var=variances[2])
    for method in ("l2", "l1"):
        derived, fixed = (ngpt.denoise(full, method, alpha=a) for a in ("auto", 0.2))
        assert not np.allclose(derived, fixed, atol=1e-4)
        # Without variances there is nothing to derive it from.
        assert np.array_equal(ngpt.denoise(bare, method, alpha="auto"), fixed)
        with pytest.raises(ngpt.NgptError, match="alpha"):
            ngpt.denoise(full, method, alpha="little")


def test_weights_ignore_the_variance_of_emitters_the_camera_sees():
    _, primal, dx, dy, variances = noisy_stack(20, 19)
    lamp = np.zeros_like(primal)
    lamp[4:7, 5:9] = 50
    layers = {"dx": dx, "dy": dy, "dx_var": variances[1], "dy_var": variances[2]}
    results = []
    for spread in (0, 1e4):
        noisy = variances[0] + np.float32(spread) * (lamp > 0)
        stack = ngpt.GradientStack.from_arrays(primal=primal + lamp, direct=lamp, primal_var=noisy, **layers)
        results.append(ngpt.denoise(stack, "wcv"))
    assert np.array_equal(*results)
