"""Reservoirs: weights sum to one, and W is unbiased, in NumPy over paths that can be counted."""

import mitsuba as mi
import numpy as np
import pytest

from ngpt_studies.restir.reservoir import choose, difference, weigh, weight_of

# Of five paths: light in two pixels, of which the second does not have the last; densities of either's candidates.
LIGHT = np.array([[0.2, 1.5, 0.7, 0.05, 2.0], [0.4, 1.0, 0.1, 0.6, 0.0]])
FOUND = np.array([[0.1, 0.3, 0.2, 0.1, 0.3], [0.25, 0.25, 0.2, 0.3, 0.0]])
# |J| of the shift from the first pixel to the second
JACOBIAN = np.array([0.5, 2.0, 1.0, 1.25, 1.0])
DRAWS = 400


@pytest.mark.parametrize("both", [False, True])
@pytest.mark.parametrize("M", [(1, 1), (1, 7), (5, 0.5)])
def test_what_is_kept_of_all_that_is_offered_is_unbiased(renderer, M, both):
    """E[value W] is the integral, here the sum over the first pixel's paths.

    Every candidate of the first pixel with every one of the second, of all random numbers. The paths of the second
    pixel are J(x) shorter than the first's: what has density p there has p / |J|. With ``both``, there is a third
    reservoir, like the second.
    """
    numbers = np.arange(5), np.arange(4), np.arange(4 if both else 1), (np.arange(DRAWS) + 0.5) / DRAWS
    a, b, c, u = (n.ravel() for n in np.meshgrid(*numbers))
    (here, there), (p, q) = LIGHT, FOUND
    offers = [[M[0] * here[a], (1 + both) * M[1] * there[a] * JACOBIAN[a], here[a], 1 / p[a]]]
    for x in (b, c) if both else (b,):
        # In the measure of the second pixel, |J| of the way back is 1 / J.
        J = JACOBIAN[x]
        offers.append([M[1] * there[x], (M[0] * here[x] + both * M[1] * there[x] * J) / J, here[x] / J, J / q[x]])
    chosen, total = choose([weigh(*(mi.Float(v) for v in offer))[1] for offer in offers], mi.Float(u))
    kept = here[np.choose(np.array(chosen), [a, b, c])]
    estimate = kept * np.array(weight_of(total, mi.Spectrum(mi.Float(kept))))
    probability = p[a] * q[b] * (q[c] if both else 1) / DRAWS
    assert np.sum(probability) == pytest.approx(1)
    assert np.sum(probability * estimate) == pytest.approx(here.sum(), rel=3e-3)


def test_of_nothing_comes_nothing(renderer):
    """Paths without light, or with weights that are not finite, add nothing."""
    for W in (0.0, np.inf, np.nan):
        nothing = weigh(mi.Float(9), mi.Float(0), mi.Float(2), mi.Float(W))[1]
        chosen, total = choose([nothing, mi.Float(3)], mi.Float(0.0))
        assert (np.array(chosen), np.array(total)) == (1, 3)
    assert np.array(weight_of(mi.Float(1), mi.Spectrum(0))) == 0


def test_a_difference_counts_each_path_once(renderer, rng):
    """From both sides of a pair, a path's weights add up to "second - first"."""
    a, b = (rng.exponential(size=(3, 40)).astype(np.float32) for _ in range(2))
    b[:, :10] = 0
    a[:, 10:15] = 0
    first, second = mi.Spectrum(a), mi.Spectrum(b)
    sides = [difference(first, second, mi.UInt32(side)) for side in (0, 1)]
    assert np.allclose(np.array(sides[0] + sides[1]), b - a, atol=1e-5)
    # What only the first pixel can see, only the first can sample.
    assert np.allclose(np.array(sides[0])[:, :10], -a[:, :10])
