"""Prepares the variances of a stack as weights, and computes the α that follows from them.

The input is sample variances of pixel means, from as few as two samples. They are too noisy to be used pixel by pixel.
They are zero where all samples missed the light, and large where a sample hit it. Weights computed directly from them
would trust the pixels that found no light.

For the primal, such weights darken the image. So its variances are averaged over a neighbourhood.

For differences, such weights only smooth. But a few differences have most of the variance, because no shift mapping can
follow their light. An average over neighbours would give their variance to clean differences, and too little variance
to the noisy ones. So a difference keeps its own variance if this is large. Otherwise it gets a typical variance of its
neighbourhood: the fourth power of the mean of fourth roots, which outliers do not dominate.

All variances are summed over colours, because a colour is weighted as one vector. They have a lower bound in proportion
to their mean. If the image is multiplied by k and its variances by k², the weights are divided by k².
"""

import math
from typing import Any

import numpy as np

from ngpt.classical.arrays import by_rows, empty
from ngpt.classical.leastsquares import robust_mean, sum_of

# This share of the mean over primal and differences is added to every variance.
FLOOR = 3e-3

# A difference has at least this many times the typical variance around it, because the typical variance is below the
# mean. Of 2, 3 and 4, wcv has the least error with 2, by 1 %, and wl2 with 3.
TYPICAL = 3

# A factor on the variances of differences, relative to those of the primal. Neighbouring pixels share paths, so errors
# of differences partly cancel in the sums of a reconstruction. Means of differences over blocks of 8x8 pixels have .56
# to .92 of the variance that independent differences would have (96x64, eight scenes), and means of the primal .8 to 1.
# Of 1, .7, .5 and .35, wcv and wl2 have the least error with .7 at 4 samples and with .35 to .5 from 16 samples on
# (docs/lab/log).
SHARED = 0.6

# The least number that sums are divided by in place of a count of 0.
FEW = 1e-9

# For α, this share of the variances is left out: the largest ones.
OUTLIERS = 1e-4


def auto_alpha(primal_var: np.ndarray, dx_var: np.ndarray, dy_var: np.ndarray, norm: int = 2) -> float:
    """The α that weights the primal against the gradients by their noise; variances are (H, W, C).

    ``norm`` 2: the root of the mean variance of gradients over the mean variance of the primal, which weights the two
    terms of l2 by inverse variance. ``norm`` 1: the mean standard deviation of gradients over that of the primal.
    Values that are negative or not finite are left out, and so are the largest ones: one in ten thousand, but at least
    one. The result is in [1e-3, 1e3]; it is 1 if there is no noise at all.
    """

    def mean(*layers: np.ndarray) -> float:
        values = np.concatenate([_positive_values(layer) for layer in layers]) ** (norm / 2)
        if not values.size:
            return 0.0
        left_out = min(math.ceil(OUTLIERS * values.size), values.size - 1)
        return float(np.partition(values, values.size - 1 - left_out)[: values.size - left_out].mean())

    primal, gradients = mean(primal_var), mean(dx_var[:, :-1], dy_var[:-1])
    if primal == gradients == 0:
        return 1.0
    ratio = gradients / primal if primal > 0 else math.inf
    return min(max(ratio ** (1 / norm), 1e-3), 1e3)


def smooth_variances(
    primal_var: np.ndarray, dx_var: np.ndarray, dy_var: np.ndarray, trusted: tuple[np.ndarray, np.ndarray] | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Variances of the primal (1, H, W) and of the differences (2, 1, H, W), summed over colours, relative, positive.

    Variances of the primal are averaged twice over 3 x 3 pixels, without values that are negative or not finite. A
    difference has at least ``TYPICAL`` times the typical variance of its neighbourhood, which is the fourth power of
    such an average of fourth roots. All are divided by a robust mean of the three layers, and ``FLOOR`` is added;
    without any noise, they are 1 everywhere. Then variances of the primal are divided by ``SHARED``. Differences that
    are not ``trusted`` or do not exist have infinite variance.
    """
    layers = [smoothed(primal_var), *(smoothed(layer, True) for layer in (dx_var[:, :-1], dy_var[:-1]))]
    mean = robust_mean(*layers)
    p, x, y = (relative(layer, mean, primal_var.dtype) for layer in layers)
    differences = np.stack([p, p])
    differences[0, :, :-1], differences[1, :-1] = x, y
    return (p / SHARED)[None], without_missing(differences, trusted)


def relative(layer: np.ndarray, mean: float, dtype: Any) -> np.ndarray:
    """Variances (H, W) divided by ``mean``, plus ``FLOOR``; 1 everywhere if the mean is 0."""

    def rows(first: int, last: int) -> tuple:
        part = layer[first:last]
        return ((part / mean + FLOOR if mean > 0 else np.ones_like(part)).astype(dtype, copy=False),)

    return by_rows(rows, empty(layer, dtype=dtype))[0]


def without_missing(variances: np.ndarray, trusted: tuple[np.ndarray, np.ndarray] | None) -> np.ndarray:
    """Variances (2, H, W) of differences as (2, 1, H, W), infinite for missing and for not ``trusted`` ones."""
    variances[0, :, -1] = math.inf
    variances[1, -1] = math.inf
    if trusted is not None:
        variances = np.where(np.stack(trusted), variances, math.inf)
    return variances[:, None]


def _positive_values(variance: np.ndarray) -> np.ndarray:
    """The usable sums over colours, as an array (N)."""
    total, good = _over_colours(variance)
    return total[good]


def _over_colours(variance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(H, W, C) -> the sum over C in double precision, and where it is usable: finite, of values >= 0."""
    channels = [variance[..., i] for i in range(variance.shape[-1])]
    total, good = channels[0].astype(np.float64, copy=False), channels[0] >= 0
    for channel in channels[1:]:
        total, good = total + channel, good & (channel >= 0)
    good = good & np.isfinite(total)
    return np.where(good, total, 0), good


def smoothed(variance: np.ndarray, outliers: bool = False) -> np.ndarray:
    """(H, W, C) -> (H, W): the usable sums over colours, averaged twice over 3 x 3 pixels.

    Where no sum is usable, the result is the mean over the image. With ``outliers``, the average is over fourth roots,
    its fourth power is multiplied by ``TYPICAL``, and larger sums are kept.
    """
    height = len(variance)

    def rows(first: int, last: int) -> tuple:
        top, bottom = max(first - 2, 0), min(last + 2, height)
        total, good = _over_colours(variance[top:bottom])
        own = slice(first - top, last - top)
        raw, sums = total, (sum_of(total[own]), int(good[own].sum()))
        if outliers:
            total = np.sqrt(np.sqrt(total))
            # Single precision can hold the roots.
            total = (total if good.all() else np.where(good, total, 0)).astype(variance.dtype, copy=False)
        total = _box(_box(total))
        if good.all():
            # Without missing values, a count is the count of rows times the count of columns.
            ones = np.ones_like(total)
            count = _box(_box(ones[:, :1])) * _box(_box(ones[:1]))
        else:
            count = _box(_box(good.astype(variance.dtype, copy=False)))
        smooth = total / count.clip(FEW, None)
        if outliers:
            smooth = np.maximum(TYPICAL * (smooth * smooth) ** 2, raw)
        # -1 marks missing values.
        return np.where(count > 0, smooth, -1)[own], *sums

    smooth, bands = by_rows(rows, empty(variance[..., 0], dtype=np.float64))
    mean = sum(total for total, _ in bands) / max(sum(count for _, count in bands), 1)
    missing = smooth < 0
    return np.where(missing, mean, smooth) if missing.any() else smooth


def _box(values: np.ndarray) -> np.ndarray:
    """Sums over 3 x 3 values, (H, W)."""
    rows = values + 0
    rows[1:] += values[:-1]
    rows[:-1] += values[1:]
    total = rows + 0
    total[:, 1:] += rows[:, :-1]
    total[:, :-1] += rows[:, 1:]
    return total
