"""What the noise of points is, where samples are none that are independent of each other.

Samples of a pixel that are points of one net (``data_gen.paths.streams``) keep apart from each other: the sample
variance, which takes them for independent, overstates the noise of their mean. How much is seen in the render itself.
The later part of a pixel's samples, from the last number on that is a power of two, is held against those before. With
n1 and n2 samples and means a and b,

    E (a - b)² n1 n2 / n² = variance of the mean

where both parts are independent, as rounds of points are; for two halves it is (Va + Vb) / 4, whatever these are. Where
all samples are of one net its halves are not independent, and a law for how the variance falls has to help. One square
says little of a pixel, but pixels of about the same noise say together by which factor their sample variances are to be
taken: where little light is found by luck, points help much, and where all is, not at all.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.ndimage import uniform_filter

# Pixels of about the same noise: so many groups at most, of so many pixels at least
_GROUPS, _LEAST = 64, 64
# Side of the square of pixels that tells how much noise there is around the one in its middle
_AROUND = 5
# So many pixels of a group are taken for those of independent samples, lest few pixels say it by chance.
_PRIOR = 4.0


def factors(seen: np.ndarray, variance: np.ndarray, of_one_net: int) -> np.ndarray:
    """By how much the sample ``variance`` of the mean is to be multiplied, (H, W, 1).

    ``seen`` is the later samples against the earlier ones, as above, without the square; both (H, W, C). Pixels where
    one of them is NaN say nothing. ``of_one_net`` is the number of samples where all of a pixel are of one net, else 0.
    """
    squares, variances = np.square(seen).sum(axis=-1), variance.sum(axis=-1)
    good = np.isfinite(squares) & np.isfinite(variances)
    # Without the pixel itself: its own variance is large where a rare sample is among its own, and such samples are
    # the ones that are independent of the others. Groups by a pixel's own variance would have them all in one.
    filled = np.where(good, variances, 0)
    around = np.where(good, np.maximum(_AROUND**2 * uniform_filter(filled, _AROUND) - filled, 0), np.inf).ravel()
    found = np.ones(around.shape)
    order = np.argsort(around, kind="stable")
    order = order[: np.count_nonzero(good)]
    for group in np.array_split(order, max(1, min(_GROUPS, len(order) // _LEAST))):
        total = variances.ravel()[group].sum()
        if total > 0:
            prior = _PRIOR / len(group) * total
            ratio = float((squares.ravel()[group].sum() + prior) / (total + prior))
            found[group] = _of_one_net(ratio, of_one_net) if of_one_net else ratio
    return found.reshape(*good.shape, 1)


def _of_one_net(ratio: float, n: int) -> float:
    """The factor where both halves are of one net of ``n``, and the ``ratio`` is that of halves which are not
    independent.

    Were the variance of n points c / n^a, halves of a net would differ by 4 c (2^a - 1) / n^a in the mean square. The
    ratio would be (2^a - 1)(n - 1) / (n^a - 1), and the factor n^(1 - a): a power of the ratio, whose exponent hardly
    depends on a. It is taken at a = 3/2, the rate of steps.
    """
    if n < 3:
        return ratio
    rate = 1.5
    exponent = math.log(n ** (1 - rate)) / math.log((2**rate - 1) * (n - 1) / (n**rate - 1))
    return ratio**exponent
