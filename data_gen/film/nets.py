"""How the noise of a pixel's mean falls with the number of its samples, if these are points of scrambled nets.

Let V(m) be the variance of the mean of an aligned block of m = 2^j points of one net, with V(1) = 1. Scrambling is
nested [Owen 1995, "Randomly permuted (t,m,s)-nets and (t,s)-sequences"], so any two points whose smallest common block
has 2m points have the same covariance. A block of 2m points is two blocks of m points, which gives that covariance:

    V(2m) = (V(m) + C(m)) / 2,    C(m) = 2 V(2m) - V(m).

Points of different rounds (``data_gen.paths.streams``) are independent. So V gives the variance of a mean of *any*
number of points, and of the difference between the means of any two parts of them. The one assumption is that V belongs
to a family of laws. The render itself shows which law holds.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np

# The family: V(m) = share / m + (1 - share) fall(m). With share 1, the noise falls as for independent samples. Most
# light is between 1 and 0: steps or smooth light, mixed with light that is found by chance.
# - Steps of the integrand: fall(m) = m^-3/2, and up to m^-2 for steps along an axis, as at edges of lamps. Such a step
#   may also look smooth, if it cuts a row of pixels at the same place and the number of samples suits that place.
# - Smooth integrands: fall(m) = m^-2, and 3/2 times that if m is an odd power of two. Points are nets in pairs of
#   dimensions: 4^k points lie one in each of 4^k squares, while 2 4^k points halve these squares along one axis only.
# - Worse than independent samples, as a few pixels may seem to be by chance: fall(m) = m^-rate with rates below 1.
_MIXED = np.linspace(1.0, 0.0, 21)
SHARES = np.concatenate([np.zeros(10), _MIXED, np.zeros(10), _MIXED[1:]])
RATES = np.concatenate([np.linspace(0.5, 0.95, 10), np.full(21, 1.5), np.linspace(1.55, 2.0, 10), np.full(20, 2.0)])
ODD = np.concatenate([np.ones(41), np.full(20, 1.5)])  # factor at odd powers of two
# The prior of each law: largest for independent samples, smallest at both ends of the rates. The priors were chosen on
# renders of five scenes by seven samplers, at 2 to 40 samples, and revised for smooth integrands on ``gpt`` at 8 to 128
# samples.
USUAL = np.concatenate([np.full(10, 0.6), [40.0], np.ones(20), np.full(10, 0.5), np.ones(20)])
USUAL /= USUAL.sum()


class Law(NamedTuple):
    """The contrast that a pixel shows, and the true variance of its mean, for each law of the family; both (laws).

    Both are divided by the sample variance of the mean, which assumes that samples are independent.
    """

    seen: np.ndarray  # the expected square of the contrast that data_gen.film.claims defines
    truth: np.ndarray


def split(n: int) -> int:
    """How many of ``n`` > 1 samples form the first part, which is compared with the rest. Each part has at least a
    third.

    It is the largest power of two below n, or half of it.
    """
    last = 1 << ((n - 1).bit_length() - 1)
    return last if 2 * (n - last) >= last else last // 2


@cache
def law(n: int, net: int) -> Law:
    """The law of ``n`` > 1 samples whose first round is a net of ``net`` points, a power of two."""
    first = split(n)
    second = n - first
    within, behind, total = _covariances(0, first, net), _covariances(first, n, net), _covariances(0, n, net)
    across = (total - within - behind) / 2
    variance = total / n**2
    # The expected square of a contrast whose square is the variance of the mean where samples are independent
    contrast = within / first**2 + behind / second**2 - 2 * across / (first * second)
    claimed = (1 - variance) / (n - 1)
    return Law(contrast * first * second / n**2 / claimed, variance / claimed)


def _covariances(begin: int, end: int, net: int) -> np.ndarray:
    """The sum of the covariances of all pairs of samples from ``begin`` to before ``end``."""
    total, start, size = np.zeros(len(RATES)), 0, net
    while start < end:
        total += _in_block(begin, end, start, size)
        # A round is as large as all earlier rounds together.
        start += size
        size = start
    return total


def _in_block(begin: int, end: int, start: int, size: int) -> np.ndarray:
    """The sum of the covariances of those pairs that lie in the aligned block of ``size`` samples from ``start`` on."""
    begin, end = max(begin, start), min(end, start + size)
    if begin >= end:
        return np.zeros(len(RATES))
    if end - begin == size:
        return size**2 * _variance(size)
    half = size // 2
    middle = start + half
    apart = max(middle - begin, 0) * max(end - middle, 0)
    covariance = 2 * _variance(size) - _variance(half)
    left, right = _in_block(begin, end, start, half), _in_block(begin, end, middle, half)
    return left + right + 2 * apart * covariance


def _variance(m: int) -> np.ndarray:
    odd = ODD if m.bit_length() % 2 == 0 else 1.0
    return SHARES / m + (1 - SHARES) * odd * float(m) ** -RATES
