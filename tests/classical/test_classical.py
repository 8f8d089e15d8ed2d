"""Classical reconstructions, each against an independent solver; α, memory and refusals."""

import tracemalloc

import numpy as np
import pytest
from solvers import METHODS, energy, l1_by_irls, noisy_stack, solve_sparse

from ngpt.classical.controlvariates import cv, wcv
from ngpt.classical.leastsquares import Equations
from ngpt.classical.poisson import l1, l2, least_norms
from ngpt.classical.variances import auto_alpha, smooth_variances
from ngpt.classical.weighted import wl2
from ngpt.errors import NgptError

SIZES = [(1, 1), (1, 9), (9, 1), (2, 2), (2, 3), (7, 11), (13, 8), (31, 37)]
every_method = pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)


def close(a, b, tolerance):
    """Within ``tolerance`` of the largest value of b."""
    return np.abs(np.asarray(a, np.float64) - b).max() <= tolerance * np.abs(b).max()


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("alpha", [0.01, 0.2, 3.0])
def test_l2_is_the_solution_of_the_sparse_system(size, alpha):
    _, primal, dx, dy, _ = noisy_stack(*size, dtype=np.float64)
    assert close(l2(primal, dx, dy, alpha), solve_sparse(primal, dx, dy, alpha), 1e-9)
    single = [a.astype(np.float32) for a in (primal, dx, dy)]
    result = l2(*single, alpha)
    assert result.dtype == np.float32
    # At a small α float32 rounding of the gradients adds up over the image.
    assert close(result, solve_sparse(*single, alpha), 5e-6 if alpha > 0.1 else 5e-5)


def test_l2_without_some_differences_is_the_solution_of_the_remaining_system():
    _, primal, dx, dy, _ = noisy_stack(14, 19, dtype=np.float64)
    trusted = np.random.default_rng(2).random((2, 14, 19)) > 0.2
    weights = np.concatenate([np.ones(14 * 19), trusted[0][:, :-1].ravel(), trusted[1][:-1].ravel()])
    assert close(l2(primal, dx, dy, 0.2, tuple(trusted)), solve_sparse(primal, dx, dy, 0.2, weights), 1e-5)


@pytest.mark.parametrize(
    ("alpha", "outliers"),
    [
        (0.2, 0),
        (0.2, 1e3),
        *(pytest.param(*each, marks=pytest.mark.slow) for each in ((0.05, 0), (1.0, 0), (0.2, 10.0), (0.2, 1e5))),
    ],
)
def test_l1_is_within_half_a_percent_of_reweighted_least_squares(alpha, outliers):
    """And takes few iterations, where one gradient in a hundred is off by up to 100 000 times the image."""
    _, primal, dx, dy, _ = noisy_stack(32, 36)
    random = np.random.default_rng(5)
    for layer in (dx, dy):
        hit = random.random(layer.shape[:2]) < 0.01
        layer[hit] += outliers * random.standard_normal((np.count_nonzero(hit), 1))
    data = [a.astype(np.float64) for a in (primal, dx, dy)]
    lowest = energy(l1_by_irls(*data, alpha, steps=100 if outliers else 60), *data, alpha)
    assert energy(l1(primal, dx, dy, alpha), *data, alpha) < 1.005 * lowest
    r, _ = Equations(*data).scaled_residual()
    assert len(least_norms(r, alpha, None, 7e-4, 300)[1]) < 40  # after as many as the strides take to get short


def test_wl2_is_the_solution_of_the_weighted_system(monkeypatch):
    monkeypatch.setattr("ngpt.classical.weighted.TOLERANCE", 1e-8)
    _, *data, variances = noisy_stack(32, 25, dtype=np.float64)
    p, (x, y) = smooth_variances(*variances)
    weights = 1 / np.concatenate([p.ravel(), x[0, :, :-1].ravel(), y[0, :-1].ravel()])
    expected = solve_sparse(*data, 1.0, weights)
    assert close(wl2(*data, *variances), expected, 1e-6)
    assert close(wl2(*(a.astype(np.float32) for a in (*data, *variances))), expected, 1e-4)


@pytest.mark.parametrize(("y", "x"), [(4, 5), (0, 0), (8, 3)])
def test_a_sweep_of_cv_gives_the_mean_of_what_neighbours_say(y, x):
    """Survey eq. 14."""
    _, primal, dx, dy, _ = noisy_stack(9, 9, dtype=np.float64)
    said = [primal[y, x]]
    said += [primal[y, x + 1] - dx[y, x]] if x < 8 else []
    said += [primal[y, x - 1] + dx[y, x - 1]] if x > 0 else []
    said += [primal[y + 1, x] - dy[y, x]] if y < 8 else []
    said += [primal[y - 1, x] + dy[y - 1, x]] if y > 0 else []
    assert np.allclose(cv(primal, dx, dy, sweeps=1)[y, x], np.mean(said, axis=0))


# α


@pytest.mark.parametrize(
    ("noise", "norm", "expected"),
    [
        # Variances of primal, dx and dy
        ((4.0, 1.0, 1.0), 2, 0.5),
        ((4.0, 1.0, 1.0), 1, 0.5),
        (("half", 1.0, 1.0), 2, 2**0.5),
        (("half", 1.0, 1.0), 1, 2),
        (("half unknown", 1.0, 1.0), 2, 1),
        ((1e30, 1e30, 1e30), 2, 1),
        ((0.0, 0.0, 0.0), 2, 1),
        ((0.0, 1.0, 1.0), 2, 1e3),
        ((1.0, 0.0, 0.0), 2, 1e-3),
    ],
)
def test_auto_alpha_is_the_ratio_of_the_noise_within_bounds(noise, norm, expected):
    layers = [np.full((8, 9, 3), 1.0 if isinstance(value, str) else value) for value in noise]
    if isinstance(noise[0], str):
        layers[0][::2] = 0 if noise[0] == "half" else np.nan
    assert auto_alpha(*layers, norm=norm) == pytest.approx(expected, rel=0.03)
    assert auto_alpha(np.ones((1, 1, 3)), *np.zeros((2, 1, 1, 3))) == 1e-3  # one pixel has no gradients


# Memory and refusals


# Bytes per pixel, the height of the image and a call. The first iterations have all the memory.
SHORT = {
    "l2": (35, 1000, l2),
    "l1": (175, 600, lambda *data: l1(*data, max_iterations=26)),
    "cv": (100, 1000, lambda *data: cv(*data, sweeps=6)),
    "wcv": (100, 1000, lambda *data: wcv(*data, *data, sweeps=6)),
    "wl2": (180, 1000, lambda *data: wl2(*data, *data)),
}


@pytest.mark.parametrize(("bound", "height", "method"), SHORT.values(), ids=SHORT)
def test_memory_per_pixel_is_as_stated(monkeypatch, bound, height, method):
    monkeypatch.setattr("ngpt.classical.weighted.TOLERANCE", 0.3)
    data = np.random.default_rng(0).random((3, height, height + 100, 3), np.float32)
    tracemalloc.start()
    try:
        method(*data)
        assert tracemalloc.get_traced_memory()[1] < bound * height * (height + 100)
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("alpha", [0, -1, np.nan, np.inf, 1e16, 1e-16, "much"])
@pytest.mark.parametrize("method", [l2, l1])
def test_alpha_out_of_range_is_refused(method, alpha):
    _, *data, _ = noisy_stack(4, 4)
    with pytest.raises(NgptError, match="alpha"):
        method(*data, alpha)


def test_shapes_that_differ_are_refused():
    _, primal, dx, dy, _ = noisy_stack(4, 5)
    with pytest.raises(NgptError, match=r"\(4, 4, 3\)"):
        l2(primal, dx[:, :-1], dy)


@every_method
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("layer", range(3))
def test_values_that_are_not_finite_are_refused(method, value, layer):
    _, *data, variances = noisy_stack(6, 5)
    data[layer][2, 2, 1] = value
    with pytest.raises(NgptError, match="not finite"):
        method(*data, variances)
