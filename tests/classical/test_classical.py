"""Classical reconstructions: each against an independent solver, and the laws that hold for all of them."""

import subprocess
import sys
import tracemalloc

import numpy as np
import pytest
from solvers import METHODS, energy, l1_by_irls, noisy_stack, solve_sparse

from ngpt.classical.controlvariates import cv, wcv
from ngpt.classical.leastsquares import Equations, solve_weighted
from ngpt.classical.poisson import l1, l2, least_norms
from ngpt.classical.variances import auto_alpha, smooth_variances
from ngpt.classical.weighted import wl2
from ngpt.errors import NgptError
from ngpt.measure.metrics import relmse

SIZES = [(1, 1), (1, 9), (9, 1), (2, 2), (2, 3), (7, 11), (13, 8), (31, 37)]
every_method = pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)


def close(a, b, tolerance):
    """Within ``tolerance`` of the largest value of b."""
    return np.abs(np.asarray(a, np.float64) - b).max() <= tolerance * np.abs(b).max()


# Against independent solvers


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


def test_bands_of_rows_make_no_difference(monkeypatch):
    _, *data, variances = noisy_stack(61, 40)
    expected = {name: method(*data, variances) for name, method in METHODS.items()}
    monkeypatch.setattr("ngpt.classical.arrays.BAND", 40)  # one row
    for name, method in METHODS.items():
        # The sums that steer the iterations are rounded differently.
        assert close(method(*data, variances), expected[name], 1e-3 if name == "wl2" else 1e-5), name


def test_the_same_input_gives_the_same_bits():
    _, *data, variances = noisy_stack(200, 300)
    for name, method in METHODS.items():
        assert np.array_equal(method(*data, variances), method(*data, variances)), name


@pytest.mark.parametrize("alpha", [0.05, 0.2, 1.0])
def test_l1_is_within_half_a_percent_of_reweighted_least_squares(alpha):
    _, *data, _ = noisy_stack(32, 28)
    lowest = energy(l1_by_irls(*data, alpha), *data, alpha)
    assert energy(l1(*data, alpha), *data, alpha) < 1.005 * lowest
    # The reference is no straw man: many more iterations of ours gain next to nothing on it.
    r, scale = Equations(*(a.astype(np.float64) for a in data)).scaled_residual()
    u, energies = least_norms(r, alpha, None, 0.0, 2000)
    assert min(energies) * scale > 0.9995 * lowest
    assert energy(data[0] + scale * np.moveaxis(u, 0, -1), *data, alpha) == pytest.approx(min(energies) * scale)


@pytest.mark.parametrize("size", [10.0, 1e3, 1e5])
def test_outliers_do_not_hold_l1_up(size):
    """Gradients of which one in a hundred is off by up to 100 000 times the image."""
    _, primal, dx, dy, _ = noisy_stack(40, 48)
    random = np.random.default_rng(5)
    for layer in (dx, dy):
        hit = random.random(layer.shape[:2]) < 0.01
        layer[hit] += size * random.standard_normal((np.count_nonzero(hit), 1))
    data = [a.astype(np.float64) for a in (primal, dx, dy)]
    r, scale = Equations(*data).scaled_residual()
    u, energies = least_norms(r, 0.2, None, 7e-4, 300)
    assert len(energies) < 40  # after as many as the strides take to get short
    reached = energy(primal + scale * np.moveaxis(u, 0, -1), *data, 0.2)
    assert reached < 1.005 * energy(l1_by_irls(*data, 0.2, steps=100), *data, 0.2)


@pytest.fixture
def tight_wl2(monkeypatch):
    monkeypatch.setattr("ngpt.classical.weighted.TOLERANCE", 1e-8)


def test_wl2_is_the_solution_of_the_weighted_system(tight_wl2):
    _, *data, variances = noisy_stack(32, 25, dtype=np.float64)
    p, (x, y) = smooth_variances(*variances)
    weights = 1 / np.concatenate([p.ravel(), x[0, :, :-1].ravel(), y[0, :-1].ravel()])
    expected = solve_sparse(*data, 1.0, weights)
    assert close(wl2(*data, *variances), expected, 1e-6)
    single = [a.astype(np.float32) for a in (*data, *variances)]
    assert close(wl2(*single), expected, 1e-4)


def test_the_preconditioner_pays():
    """Weights over five decades: a fraction of the iterations that scaling by the diagonal alone takes."""
    _, *data, variances = noisy_stack(96, 96, dtype=np.float64)
    p, d = smooth_variances(*variances)
    r, _ = Equations(*data).scaled_residual()
    _, iterations = solve_weighted(r, 1 / p, 1 / d, 1e-4)
    assert iterations < 60


def test_cv_is_the_mean_of_what_neighbours_say():
    """Survey eq. 14, as printed, in the inside of the image and for one sweep."""
    _, primal, dx, dy, _ = noisy_stack(9, 9, dtype=np.float64)
    y, x = 4, 5
    said = [
        primal[y, x],
        primal[y, x + 1] - dx[y, x],
        primal[y, x - 1] + dx[y, x - 1],
        primal[y + 1, x] - dy[y, x],
        primal[y - 1, x] + dy[y - 1, x],
    ]
    assert np.allclose(cv(primal, dx, dy, sweeps=1)[y, x], np.mean(said, axis=0))
    corner = [primal[0, 0], primal[0, 1] - dx[0, 0], primal[1, 0] - dy[0, 0]]
    assert np.allclose(cv(primal, dx, dy, sweeps=1)[0, 0], np.mean(corner, axis=0))


def test_wcv_weights_follow_the_survey():
    """Survey eq. 21 and 22 for one sweep, with the variance factor 1 / 5.01 of the first."""
    _, primal, dx, dy, variances = noisy_stack(9, 9, dtype=np.float64)
    p, (vx, vy) = smooth_variances(*variances)
    y, x = 4, 5
    own = p[0, y, x] / 5.01
    said = [
        (primal[y, x], own),
        (primal[y, x + 1] - dx[y, x], own + vx[0, y, x]),
        (primal[y, x - 1] + dx[y, x - 1], own + vx[0, y, x - 1]),
        (primal[y + 1, x] - dy[y, x], own + vy[0, y, x]),
        (primal[y - 1, x] + dy[y - 1, x], own + vy[0, y - 1, x]),
    ]
    expected = sum(value / v for value, v in said) / sum(1 / v for _, v in said)
    assert np.allclose(wcv(primal, dx, dy, *variances, sweeps=1)[y, x], expected)


# Laws


@every_method
def test_the_error_falls_well_below_that_of_the_primal(method):
    truth, *data, variances = noisy_stack(64, 96)
    assert relmse(method(*data, variances), truth) < 0.25 * relmse(data[0], truth)


@pytest.mark.parametrize("name", ["l2", "cv"])
def test_linear_methods_add_up_over_light_groups(name):
    groups = [noisy_stack(40, 33, seed)[1:4] for seed in range(3)]
    together = METHODS[name](*map(sum, zip(*groups, strict=True)), None)
    apart = sum(METHODS[name](*group, None) for group in groups)
    assert close(apart, together, 2e-6)


@every_method
def test_untrusted_differences_have_no_influence(method):
    _, primal, dx, dy, variances = noisy_stack(21, 17)
    trusted = np.random.default_rng(1).random((2, 21, 17)) > 0.1
    results = []
    for garbage in (0.0, 1e3):
        layers = [np.where(t[..., None], d, np.float32(garbage)) for t, d in zip(trusted, (dx, dy), strict=True)]
        call = {"l2": l2, "l1": l1, "cv": cv}
        name = next(n for n, m in METHODS.items() if m is method)
        if name in call:
            results.append(call[name](primal, *layers, trusted=tuple(trusted)))
        else:
            results.append({"wcv": wcv, "wl2": wl2}[name](primal, *layers, *variances, trusted=tuple(trusted)))
    assert close(results[0], results[1], 1e-5)


def test_l2_without_some_differences_is_the_solution_of_the_remaining_system():
    _, primal, dx, dy, _ = noisy_stack(14, 19, dtype=np.float64)
    trusted = np.random.default_rng(2).random((2, 14, 19)) > 0.2
    weights = np.concatenate([np.ones(14 * 19), trusted[0][:, :-1].ravel(), trusted[1][:-1].ravel()])
    assert close(l2(primal, dx, dy, 0.2, tuple(trusted)), solve_sparse(primal, dx, dy, 0.2, weights), 1e-5)


# Energy, alpha, memory


@pytest.mark.parametrize("name", ["l2", "cv"])
def test_unbiased_methods_keep_the_mean(name):
    _, *data, _ = noisy_stack(50, 70)
    assert METHODS[name](*data, None).mean(dtype=np.float64) == pytest.approx(
        data[0].mean(dtype=np.float64), rel=1e-6 if name == "l2" else 0.02
    )


def test_l1_loses_the_energy_of_rare_bright_samples_and_l2_does_not():
    """Primal: one pixel in 50 is 50, the rest 0, mean 1; the gradients say the image is flat."""
    random = np.random.default_rng(0)
    primal = np.where(random.random((60, 60, 1)) < 0.02, np.float32(50), np.float32(0)).repeat(3, -1)
    flat = np.zeros_like(primal)
    assert l2(primal, flat, flat).mean() == pytest.approx(primal.mean(), rel=1e-5)
    assert l1(primal, flat, flat).mean() < 0.1 * primal.mean()


def test_auto_alpha_is_the_ratio_of_the_noise():
    shape = (8, 9, 3)
    assert auto_alpha(np.full(shape, 4.0), np.full(shape, 1.0), np.full(shape, 1.0)) == pytest.approx(0.5)
    assert auto_alpha(np.full(shape, 4.0), np.full(shape, 1.0), np.full(shape, 1.0), norm=1) == pytest.approx(0.5)
    primal = np.ones(shape)
    primal[::2] = 0
    ones = np.ones(shape)
    assert auto_alpha(primal, ones, ones) == pytest.approx(2**0.5, rel=0.02)
    assert auto_alpha(primal, ones, ones, norm=1) == pytest.approx(2, rel=0.03)
    assert auto_alpha(np.where(primal == 0, np.nan, primal), ones, ones) == pytest.approx(1)


def test_auto_alpha_at_the_ends():
    none, some = np.zeros((5, 4, 3)), np.ones((5, 4, 3))
    assert auto_alpha(none, none, none) == 1
    assert auto_alpha(none, some, some) == 1e3
    assert auto_alpha(some, none, none) == 1e-3
    assert auto_alpha(some[:1, :1], none[:1, :1], none[:1, :1]) == 1e-3  # one pixel has no gradients
    assert auto_alpha(1e30 * some, 1e30 * some, 1e30 * some) == pytest.approx(1)


def peak_bytes(function):
    tracemalloc.start()
    try:
        function()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(("name", "bound"), [("l2", 35), ("l1", 175), ("cv", 100), ("wcv", 100), ("wl2", 180)])
def test_memory_per_pixel_is_as_stated(name, bound):
    height, width = 1000, 1100
    _, *data, variances = noisy_stack(height, width)
    assert peak_bytes(lambda: METHODS[name](*data, variances)) < bound * height * width


# Refusals


@pytest.mark.parametrize("alpha", [0, -1, np.nan, np.inf, 1e16, 1e-16, "much"])
def test_alpha_out_of_range_is_refused(alpha):
    _, *data, _ = noisy_stack(4, 4)
    for method in (l2, l1):
        with pytest.raises(NgptError, match="alpha"):
            method(*data, alpha)


def test_shapes_that_differ_are_refused():
    _, primal, dx, dy, _ = noisy_stack(4, 5)
    with pytest.raises(NgptError, match=r"\(4, 4, 3\)"):
        l2(primal, dx[:, :-1], dy)


@every_method
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_values_that_are_not_finite_are_refused(method, value):
    _, *data, variances = noisy_stack(6, 5)
    for layer in range(3):
        broken = [a.copy() for a in data]
        broken[layer][2, 2, 1] = value
        with pytest.raises(NgptError, match="not finite"):
            method(*broken, variances)


def test_importing_and_running_ngpt_does_not_import_torch():
    program = (
        "import sys, numpy as np, ngpt; a = np.ones((5, 4, 3), 'f');"
        "s = ngpt.GradientStack.from_arrays(primal=a, dx=a, dy=a, primal_var=a, dx_var=a, dy_var=a);"
        "[ngpt.denoise(s, m) for m in ('primal', 'l2', 'l1', 'cv', 'wcv', 'wl2')];"
        "assert 'torch' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", program], check=True)
