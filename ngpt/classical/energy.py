"""Restores the light that weighted reconstructions lose, near the place where it was lost.

Weights are estimated from the same samples that they weight. A pixel with a bright sample is trusted less than its
neighbours without one, so weighted means are too dark. The image is therefore multiplied by a ratio: the light of the
primal, which is unbiased, over the light of the image, both summed over a wide neighbourhood. Dark regions beside
bright ones get little of the restored light.
"""

import numpy as np

from ngpt.classical.arrays import by_rows, empty, over_colours
from ngpt.classical.arrays import image as as_image
from ngpt.classical.leastsquares import solve

# The size of the neighbourhood in pixels: the length scale of a screened Poisson equation. 16 and 64 are as good.
REACH = 32

# The largest ratio and its inverse. Beside a pixel of 1e12, rounding errors make sums and ratios meaningless.
MOST = 4.0


def keep_energy(image: np.ndarray, primal: np.ndarray) -> np.ndarray:
    """The reconstruction ``image`` with the local brightness of ``primal``; all are (H, W, C).

    The ratio is smooth, the same for all colours, and 1 where the brightness of both is equal. If both are multiplied
    by k, so is the result.
    """
    double = empty(image[..., 0], 2, dtype=np.float64)
    brightness, _ = by_rows(lambda i, j: (np.stack([over_colours(x[i:j]) for x in (primal, image)]),), double)
    # Averages over REACH pixels, up to a factor that cancels in the ratio.
    local = solve(brightness, 1 / REACH**2)

    def rows(first: int, last: int) -> tuple:
        before, after = local[:, first:last]
        lit = (before > 0) & (after > 0)
        factor = np.where(lit, before / np.where(lit, after, 1), 1).clip(1 / MOST, MOST)
        factor = factor.astype(image.dtype, copy=False)
        return (np.stack([factor * image[first:last, :, channel] for channel in range(image.shape[-1])]),)

    out = empty(image[..., 0], image.shape[-1], channels_last=True, dtype=image.dtype)
    return as_image(by_rows(rows, out)[0])
