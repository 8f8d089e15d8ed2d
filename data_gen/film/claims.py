"""The variance of pixels whose samples are points of low-discrepancy nets, and so not independent.

Samples of a pixel that are points of one net (``data_gen.paths.streams``) are spread more evenly than independent
samples. The sample variance assumes independent samples, so it overstates the noise of the mean. The render itself
shows by how much. The n samples of a pixel are split into two parts of similar size (``data_gen.film.nets.split``): n1
samples with mean a and n2 samples with mean b. The parts are compared by their *contrast*

    (b - a) sqrt(n1 n2) / n,

whose expected square is the variance of the pixel's mean if samples are independent. Points of nets help much where the
integrand is mostly smooth, and not at all where all light comes from rare random hits. So there is a family of laws for
how fast the noise falls with the number of samples, and ``data_gen.film.nets.law`` gives the expected square and the
variance of the mean for each law. One square says little about a pixel, but pixels of about the same noise together
show which law holds. A group in which few pixels have most of the noise shows this less clearly. So the factor for the
variance is a mean over all laws, weighted by their probabilities. It is a geometric mean, since errors of factors are
ratios. For pixels with two samples, all laws expect the same contrast, so only the prior of each law counts.
"""

from __future__ import annotations

import numpy as np

from data_gen.film.nets import USUAL, law
from ngpt.shared import box_means

# The most groups of pixels of similar noise, and the least pixels of a group
_GROUPS, _LEAST = 64, 64
# Side of the square of pixels from which the noise of its middle pixel is estimated
_AROUND = 5


def factors(contrast: np.ndarray, variance: np.ndarray, samples: np.ndarray, net: int) -> np.ndarray:
    """The factor (H, W, 1) by which the sample ``variance`` of the mean must be multiplied.

    ``contrast``, as defined above, and ``variance`` are (H, W, C). Pixels where one of them is NaN are not used.
    ``samples`` (H, W) is the number of samples of each pixel, and ``net`` the number of points in its first net.
    """
    squares, variances = np.square(contrast).sum(axis=-1), variance.sum(axis=-1)
    good = np.isfinite(squares) & np.isfinite(variances)
    # The pixel itself is left out. A rare bright sample makes the pixel's own variance large, and light from rare
    # samples gains nothing from nets. Groups by a pixel's own variance would put all such pixels into one group.
    filled = np.where(good, variances, 0)
    sums = _AROUND**2 * box_means(filled, _AROUND)
    around = np.where(good, np.maximum(sums - filled, 0), np.inf).ravel()
    order = np.argsort(around, kind="stable")
    order = order[: np.count_nonzero(good)]
    found = _found(squares.ravel(), variances.ravel(), samples.ravel(), net, order, _GROUPS)
    return found.reshape(*good.shape, 1)


def factor(contrast: np.ndarray, variance: np.ndarray, samples: np.ndarray, net: int) -> np.ndarray:
    """As ``factors``, (N, 1), for pixels (N, C) that all count as one group."""
    squares, variances = np.square(contrast).sum(axis=-1), variance.sum(axis=-1)
    good = np.flatnonzero(np.isfinite(squares) & np.isfinite(variances))
    return _found(squares, variances, samples, net, good, 1)[:, None]


def _found(
    squares: np.ndarray, variances: np.ndarray, samples: np.ndarray, net: int, order: np.ndarray, groups: int
) -> np.ndarray:
    """The factors (N) of pixels. ``order`` is the list of pixels that is cut into at most ``groups`` groups. Pixels
    that are not in ``order`` have the factor 1."""
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
    """The probability of each law, (laws), given the observed ``ratio`` of squared contrasts to variances; ``expected``
    are the ratios that the laws predict.

    A sample variance is a mean over ``contrasts`` orthogonal contrasts, and the observed contrast is one of them.
    Let q be the squared observed contrast over the mean square of the other contrasts. Under a law, q divided by the
    value that the law expects has an F distribution with 1 and ``contrasts`` - 1 degrees of freedom. There are
    ``pixels`` such values: the effective number of pixels, as if all had equal noise.
    """
    others = contrasts - 1
    if others < 1e-6:
        return USUAL
    part, by_law = min(ratio / contrasts, 1 - 1e-12), expected / contrasts
    odds = part / (1 - part) * (1 - by_law) / by_law
    likelihood = pixels / 2 * (np.log((1 - by_law) / by_law) - contrasts * np.log1p(odds / others))
    weights = USUAL * np.exp(likelihood - likelihood.max())
    return weights / weights.sum()
