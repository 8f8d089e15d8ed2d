"""What the noise of points is, where samples are none that are independent of each other.

Samples of a pixel that are points of one net (``data_gen.paths.streams``) keep apart from each other: the sample
variance, which takes them for independent, overstates the noise of their mean. How much is seen in the render itself.
The later part of a pixel's samples, from the last number on that is a power of two, is held against those before. With
n1 and n2 samples and means a and b,

    E (a - b)² n1 n2 / n² = variance of the mean

where both parts are independent, as rounds of points are; for two halves it is (Va + Vb) / 4, whatever these are. Where
all samples are of one net its halves are not independent, and a law for how the variance falls has to help. One square says little of a pixel, but all pixels together say by which factor sample variances are to be taken.
"""

from __future__ import annotations

import math

import numpy as np

# The noisiest pixels are left out: few samples of light that is found by luck say nothing of the others.
_QUIET = 0.99
# So many pixels are taken for those of independent samples, lest few pixels say it by chance.
_PRIOR = 32.0


def factor(seen: np.ndarray, variance: np.ndarray, of_one_net: int) -> float:
    """By how much the sample ``variance`` of the mean is to be multiplied.

    ``seen`` is the later samples against the earlier ones, as above, without the square; both (H, W, C). NaN is left
    out. ``of_one_net`` is the number of samples where all of a pixel are of one net, else 0.
    """
    squares, variances = np.square(seen).sum(axis=-1).ravel(), variance.sum(axis=-1).ravel()
    good = np.isfinite(squares) & np.isfinite(variances) & (variances > 0)
    if not good.any():
        return 1.0
    squares, variances = squares[good], variances[good]
    quiet = variances <= np.quantile(variances, _QUIET)
    squares, variances = squares[quiet], variances[quiet]
    prior = _PRIOR * variances.mean()
    ratio = float((squares.sum() + prior) / (variances.sum() + prior))
    return _of_one_net(ratio, of_one_net) if of_one_net else ratio


def _of_one_net(ratio: float, n: int) -> float:
    """The factor where both halves are of one net, and the ``ratio`` is that of halves which are not independent.

    Were the variance of n points c / n^a, halves of a net would differ by 4 c (2^a - 1) / n^a in the mean square, and the
    ratio would be (2^a - 1)(n - 1) / (n^a - 1), which falls with a from 1 on. The factor is n^(1 - a).
    """
    if n < 3 or ratio >= 1:
        return min(ratio, 1.0)
    low, high = 1.0, 3.0
    for _ in range(40):
        a = (low + high) / 2
        low, high = (a, high) if (2**a - 1) * (n - 1) / (n**a - 1) > ratio else (low, a)
    return math.pow(n, 1 - low)
