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
"""

from __future__ import annotations

import numpy as np

from data_gen.film.nets import law

# Pixels of about the same noise: so many groups at most, of so many pixels at least
_GROUPS, _LEAST = 64, 64
# Side of the square of pixels that tells how much noise there is around the one in its middle
_AROUND = 5
# As many pixels with independent samples are added to each group, so that few pixels do not decide by chance.
_PRIOR = 4.0


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
    """The factors of pixels by the ``order`` in which they are put into so many ``groups`` at most, all (N); 1 of those
    that are not there."""
    found = np.ones(len(squares))
    if not len(order):
        return found
    numbers, kind = np.unique(samples, return_inverse=True)
    laws = [law(max(int(n), 2), net) for n in numbers]
    seen, truth = (np.array(each) for each in zip(*laws, strict=True))
    for group in np.array_split(order, max(1, min(groups, len(order) // _LEAST))):
        claimed = np.bincount(kind[group], variances[group], len(numbers))
        total = claimed.sum()
        if total > 0:
            prior = _PRIOR / len(group) * total
            ratio = (squares[group].sum() + prior) / (total + prior)
            # What is seen falls from law to law, and np.interp wants it to rise.
            which = np.interp(-ratio, -(claimed @ seen) / total, np.arange(seen.shape[1]))
            found[group] = (truth @ _hat(which, seen.shape[1]))[kind[group]]
    return found


def _hat(place: float, n: int) -> np.ndarray:
    """Weights that interpolate linearly between ``n`` values at a ``place`` from 0 to n - 1."""
    return np.maximum(1 - np.abs(np.arange(n) - place), 0)


def box_means(image: np.ndarray, size: int) -> np.ndarray:
    """Means over ``size`` x ``size`` pixels around each of (H, W), mirrored at the edges: SciPy's ``uniform_filter``.

    To the bit; but SciPy takes longer to import than the rest of a small render takes for all of its variances.
    """
    if not image.size:  # the differences within a single row or column of pixels
        return image
    before = size // 2
    for axis in (0, 1):
        lines = np.moveaxis(image, axis, 0).astype(np.float64)
        lines = np.pad(lines, ((before, size - 1 - before), (0, 0)), mode="symmetric")
        total = np.zeros(lines.shape[1])
        for line in lines[:size]:
            total += line
        means = np.empty(np.moveaxis(image, axis, 0).shape, image.dtype)
        means[0] = total / size
        for i in range(1, len(means)):
            total += lines[i + size - 1] - lines[i - 1]
            means[i] = total / size
        image = np.moveaxis(means, 0, axis)
    return image
