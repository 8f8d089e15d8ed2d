"""From the moments of strands to the statistics of pixels, in NumPy.

Strand s of pixel p has number s * pixels + p.
"""

from __future__ import annotations

import numpy as np

from data_gen.film.moments import Moments
from data_gen.film.nets import split


def statistics(moments: Moments, strands: int, batch: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """The number of values (pixels, 1), their mean and the variance of the mean (pixels, C) or None, over all strands.

    Values are samples, or batches of ``batch`` samples. The mean of no value is NaN, and so is the variance of fewer
    than two: unknown must not look like zero. Chan, Golub, LeVeque 1983, "Algorithms for computing the sample
    variance", eq. 2.1.
    """
    counts = np.array(moments.count, np.float64).reshape(strands, -1)
    count = counts.sum(axis=0)
    values = np.ceil(count / batch) if batch else count
    means: list[np.ndarray] = []
    variances: list[np.ndarray] = []
    with np.errstate(invalid="ignore", divide="ignore"):
        for channel in moments.mean:
            each = np.array(channel).reshape(strands, -1)
            # 0 / 0 is NaN, as it should be. A single strand keeps its mean to the last bit.
            mean = each[0] * (count / count) if strands == 1 else (counts * each).sum(axis=0) / count
            means.append(mean)
            if moments.m2:
                m2 = np.array(moments.m2[len(variances)]).reshape(strands, -1).sum(axis=0)
                if strands > 1:
                    m2 += (counts * np.square(each - mean)).sum(axis=0)
                variances.append(np.where(values > 1, m2 / (values - 1) / count, np.nan))
    return values[:, None], np.stack(means, axis=-1), np.stack(variances, axis=-1) if variances else None


def contrast(moments: Moments, strands: int, values: np.ndarray) -> np.ndarray:
    """The contrast (pixels, C) between the later and the earlier samples of each pixel, see ``data_gen.film.claims``.

    ``values`` is the number of values of each pixel.
    """
    earlier = moments.earlier[0]
    counts = [np.array(each, np.int64).reshape(strands, -1) for each in (*earlier.counts[::-1], moments.count)]
    bits = np.array(earlier.bits, np.int64).reshape(strands, -1)
    numbers, kind = np.unique(values, return_inverse=True)
    splits = np.array([split(max(int(n), 2)) for n in numbers])[kind]
    # Which samples of a strand have numbers below ``splits``: one of the two sets of ``earlier``, or all samples.
    which = np.clip(np.log2(splits).astype(np.int64) + 2 - bits, 0, 2)
    before, n = np.choose(which, counts), counts[-1].sum(axis=0)
    n1 = before.sum(axis=0)
    columns = []
    with np.errstate(invalid="ignore", divide="ignore"):
        for channel in zip(*earlier.means[::-1], moments.mean, strict=True):
            means = [np.array(each, np.float64).reshape(strands, -1) for each in channel]
            first = (before * np.choose(which, means)).sum(axis=0) / n1
            # last - first, times sqrt(n1 (n - n1)) / n
            columns.append(((counts[-1] * means[-1]).sum(axis=0) / n - first) * np.sqrt(n1 / (n - n1)))
    return np.stack(columns, axis=-1)
