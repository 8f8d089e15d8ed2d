"""The sweeps in strips that stay in the cache are those over the whole image, wherever strips and rows are cut."""

import numpy as np
import pytest
from solvers import noisy_stack

from ngpt.classical import jacobi
from ngpt.classical.controlvariates import schedule, wcv
from ngpt.classical.leastsquares import Equations
from ngpt.classical.variances import smooth_variances


def one_sweep(u, r, own, difference_var, step):
    """By the formula, one neighbour after the other."""
    change, weight = np.zeros_like(u), np.ones_like(own)
    vx, vy = difference_var
    for axis, variance, residual in ((2, vx, r[0]), (1, vy, r[1])):
        here, there = [slice(None)] * 3, [slice(None)] * 3
        here[axis], there[axis] = slice(None, -1), slice(1, None)
        here, there = tuple(here), tuple(there)
        said = u[there] - u[here] - residual[here]
        forth, back = own[here] / (own[here] + variance[here]), own[there] / (own[there] + variance[here])
        change[here] += forth * said
        change[there] -= back * said
        weight[here] += forth
        weight[there] += back
    return u + step * change / weight


def by_the_formula(primal, dx, dy, variances, trusted, schedule):
    equations = Equations(primal, dx, dy, trusted)
    r, scale = equations.scaled_residual()
    v, differences = smooth_variances(*variances, trusted)
    u = np.zeros_like(r[0])
    for factor, step in schedule:
        u = one_sweep(u, r, factor * v, differences, step)
    return equations.image(u, scale)


SIZES = [(1, 1), (1, 40), (40, 1), (5, 7), (61, 16), (130, 33), (257, 20)]


@pytest.mark.parametrize(
    ("size", "sweeps"), [*((size, len(schedule())) for size in SIZES), *(((90, 24), n) for n in (0, 1, 5, 6, 7, 13))]
)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_wcv_is_the_formula(monkeypatch, size, sweeps, dtype):
    """Strips of about 30 rows, of which some are worked on at a time."""
    monkeypatch.setattr(jacobi, "_STRIP", 30)
    monkeypatch.setattr(jacobi, "_PIXELS", 100)
    _, primal, dx, dy, variances = noisy_stack(*size, dtype=dtype)
    random = np.random.default_rng(1)
    trusted = tuple(random.random(size) < 0.95 for _ in range(2))
    expected = by_the_formula(primal, dx, dy, variances, trusted, schedule()[:sweeps])
    result = wcv(primal, dx, dy, *variances, trusted, sweeps)
    # Between a long step and the short ones after it, rounding is larger.
    tolerance = 1e-5 if dtype is np.float32 else 1e-12
    assert result.dtype == dtype
    assert np.abs(result - expected).max() <= tolerance * np.abs(expected).max()
