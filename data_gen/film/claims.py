"""What the noise of points is, where samples are not independent of each other.

Samples of a pixel that are points of one net (``data_gen.paths.streams``) keep apart from each other: the sample
variance, which takes them for independent, overstates the noise of their mean. How much is seen in the render itself.
The samples of a pixel are split into two parts of similar size (``data_gen.film.nets.split``), n1 and n2 of n samples
with means a and b, and held against each other by their *contrast*

    (b - a) sqrt(n1 n2) / n,

whose expected square is the variance of the pixel's mean where samples are independent. What it is where they are
points of nets, and what the variance of the mean is then, ``data_gen.film.nets.law`` says for each way in which noise
may fall. One square says little of a pixel, but pixels of about the same noise together show which: where little light
is found by luck, points help much, and where all is, not at all.

The fewer pixels have most of the noise, the less they show. So the factor is a mean over all laws, weighted by how
likely they are; a geometric one, since factors are wrong by ratios. All laws expect the same contrast of two samples:
there, only how usual each law is counts.
"""

from __future__ import annotations

import numpy as np

from data_gen.film.nets import USUAL, law
from ngpt.shared import box_means

# Groups of pixels of about the same noise: the most groups, and the least pixels of a group
_GROUPS, _LEAST = 64, 64
# Side of the square of pixels around a pixel that its noise is estimated from
_AROUND = 5


def factors(contrast: np.ndarray, variance: np.ndarray, samples: np.ndarray, net: int) -> np.ndarray:
    """By how much the sample ``variance`` of the mean is to be multiplied, (H, W, 1).

    ``contrast``, as defined above, and ``variance`` are (H, W, C). Pixels where one of them is NaN say nothing.
    ``samples`` (H, W) is the number of samples of each pixel, and ``net`` the number of points in the first round.
    """
    squares, variances = np.square(contrast).sum(axis=-1), variance.sum(axis=-1)
    good = np.isfinite(squares) & np.isfinite(variances)
    # Without the pixel itself: its own variance is large where a rare sample is among its own, and such samples are
    # the ones that are independent of the others. Groups by a pixel's own variance would have them all in one.
    filled = np.where(good, variances, 0)
    sums = _AROUND**2 * box_means(filled, _AROUND)
    around = np.where(good, np.maximum(sums - filled, 0), np.inf).ravel()
    order = np.argsort(around, kind="stable")
    order = order[: np.count_nonzero(good)]
    found = _found(squares.ravel(), variances.ravel(), samples.ravel(), net, order, _GROUPS)
    return found.reshape(*good.shape, 1)


def factor(contrast: np.ndarray, variance: np.ndarray, samples: np.ndarray, net: int) -> np.ndarray:
    """As ``factors``, (N, 1), for pixels (N, C) that form one group, however much noise each of them has."""
    squares, variances = np.square(contrast).sum(axis=-1), variance.sum(axis=-1)
    good = np.flatnonzero(np.isfinite(squares) & np.isfinite(variances))
    return _found(squares, variances, samples, net, good, 1)[:, None]


def _found(
    squares: np.ndarray, variances: np.ndarray, samples: np.ndarray, net: int, order: np.ndarray, groups: int
) -> np.ndarray:
    """The factors of pixels, which are put into at most ``groups`` groups in this ``order``, all (N). Pixels that are
    not in ``order`` have the factor 1."""
    found = np.ones(len(squares))
    if not len(order):
        return found
    numbers, kind = np.unique(samples, return_inverse=True)
    laws = [law(max(int(n), 2), net) for n in numbers]
    seen, truth = (np.array(each) for each in zip(*laws, strict=True))
    for group in np.array_split(order, max(1, min(groups, len(order) // _LEAST))):
        total = variances[group].sum()
        if total > 0:
            each = variances[group] / total
            share = np.bincount(kind[group], each, len(numbers))
            ratio, contrasts, pixels = squares[group].sum() / total, share @ (numbers - 1), 1 / np.square(each).sum()
            found[group] = np.exp(np.log(truth) @ _likely(ratio, share @ seen, contrasts, pixels))[kind[group]]
    return found


def _likely(ratio: float, expected: np.ndarray, contrasts: float, pixels: float) -> np.ndarray:
    """How likely each law is, (laws), by the ``ratio`` of squared contrasts to variances, and what laws ``expected``.

    A sample variance is a mean over so many orthogonal ``contrasts``. The one that is seen is held against all others:
    over what a law expects, the ratio of both has an F distribution. Its degrees of freedom are one and the number of
    the others, for each of so many ``pixels`` of equal noise.
    """
    others = contrasts - 1
    if others < 1e-6:
        return USUAL
    part, by_law = min(ratio / contrasts, 1 - 1e-12), expected / contrasts
    odds = part / (1 - part) * (1 - by_law) / by_law
    likelihood = pixels / 2 * (np.log((1 - by_law) / by_law) - contrasts * np.log1p(odds / others))
    weights = USUAL * np.exp(likelihood - likelihood.max())
    return weights / weights.sum()
