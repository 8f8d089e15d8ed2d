"""Outliers of gradients: what they may do to their neighbours, and what weights may do to the energy."""

import numpy as np
import pytest

from ngpt.classical.bases import BASES, CLASSICAL
from ngpt.classical.gradients import forward_differences
from ngpt.classical.variances import SHARED, TYPICAL, smooth_variances
from ngpt.measure.metrics import relmse
from ngpt.repair import repair
from ngpt.stack import GradientStack

WEIGHTED = ("wcv", "wl2")


def stack_of(primal, dx, dy, variances):
    names = ("primal_var", "dx_var", "dy_var")
    return GradientStack.from_arrays(primal=primal, dx=dx, dy=dy).replace(**dict(zip(names, variances, strict=True)))


def solved(name, *layers):
    return CLASSICAL[name](repair(stack_of(*layers)))


def even(height, width, noise=0.05, seed=0):
    """(truth, primal, dx, dy, variances) with the same noise everywhere, a tenth of it in the differences."""
    random = np.random.default_rng(seed)
    truth = (1 + 0.2 * np.sin(np.arange(width) / 9)[None, :, None] + np.zeros((height, 1, 3))).astype(np.float32)
    layers, variances = [], []
    for clean, share in ((truth, 1.0), *((d, 0.1) for d in forward_differences(truth))):
        deviation = share * noise
        layers.append((clean + deviation * random.standard_normal(truth.shape)).astype(np.float32))
        variances.append((deviation**2 * random.gamma(4, 0.25, truth.shape)).astype(np.float32))
    return truth, *layers, tuple(variances)


@pytest.mark.parametrize("name", WEIGHTED)
def test_outliers_that_their_variances_tell_of_are_nearly_left_out(name):
    """One difference in fifty, one in nearly every block of 7x7, has a hundred times the noise."""
    truth, primal, *gradients, variances = even(48, 64)
    random = np.random.default_rng(3)
    wrong, noisy, without = [], [variances[0]], []
    for gradient, variance in zip(gradients, variances[1:], strict=True):
        out = random.random((48, 64, 1)) < 0.02
        wrong.append(np.where(out, gradient + 0.5 * random.standard_normal(out.shape), gradient).astype(np.float32))
        noisy.append(np.where(out, np.float32(0.25), variance))
        without.append(np.where(out, np.float32(np.nan), gradient))
    error = relmse(solved(name, primal, *wrong, noisy), truth)
    assert error < 1.5 * relmse(solved(name, primal, *without, variances), truth)
    assert error < 0.05 * relmse(primal, truth)


@pytest.mark.parametrize("name", WEIGHTED)
def test_energy_is_kept_where_few_samples_carry_the_light(name):
    """Pixels that a bright sample hit have a large variance: their weights lose what they found."""
    random = np.random.default_rng(0)
    n, size = 8, (64, 96, 1)
    hits = random.binomial(n, 0.04, size)
    value = 20.0
    primal = np.repeat(0.2 + value * hits / n, 3, -1).astype(np.float32)
    share = hits / n
    variance = np.repeat(value**2 * share * (1 - share) / (n - 1), 3, -1).astype(np.float32) + 1e-4
    gradients = [(0.3 * random.standard_normal((*size[:2], 1)) * np.ones(3)).astype(np.float32) for _ in range(2)]
    noise = np.full_like(primal, 0.09)
    data = repair(stack_of(primal, *gradients, (variance, noise, noise)))
    assert CLASSICAL[name](data).mean() == pytest.approx(primal.mean(), rel=0.01)
    if name == "wcv":
        assert BASES[name](data).mean() < 0.99 * primal.mean(), "the test has nothing to give back"


def test_no_difference_is_believed_for_its_luck():
    """One whose samples all missed the light has the variance of those around it."""
    variances = [np.ones((9, 11, 3)) for _ in range(3)]
    variances[1][4, 5] = 0
    _, (x, _) = smooth_variances(*variances)
    assert x[0, 4, 5] > 0.5 * x[0, 0, 0]
    assert x[0, 0, 0] == pytest.approx(TYPICAL * SHARED * smooth_variances(*variances)[0][0, 0, 0], rel=0.01)


def test_what_is_repaired_is_without_direct_light_and_distrusts_both_differences_of_a_lost_pixel():
    primal, zero = np.ones((5, 6, 3), np.float32), np.zeros((5, 6, 3), np.float32)
    direct = zero.copy()
    direct[2, 2] = 0.25
    primal[2, 3] = np.nan
    found = repair(stack_of(primal, zero, zero, (primal, zero, zero)).replace(direct=direct))
    assert np.allclose(found.image[2, 2], 0.75) and np.allclose(found.direct[2, 2], 0.25) and found.pixels == 1
    lost = [{tuple(map(int, place)) for place in np.argwhere(~trusted)} for trusted in found.trusted]
    assert lost == [{(2, 2), (2, 3)}, {(1, 3), (2, 3)}] and found.gradients == 4
    # The variance of light that the camera sees directly is none of the image's.
    assert {tuple(map(int, place)) for place in np.argwhere(np.isnan(found.noise[..., 0]))} == {(2, 2), (2, 3)}
