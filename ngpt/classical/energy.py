"""Restores the light that data-dependent weights lose, near the place where it was lost.

Weights are estimated from the samples that they weigh. A pixel that a bright sample hit is trusted less than its
neighbours that none hit, so weighted means are dark. So an image is brightened by the ratio of the light in a wide
neighbourhood before and after, and keeps the energy of the primal, which is unbiased. Dark regions beside bright ones
get little of it.
"""

import numpy as np

from ngpt.classical.arrays import by_rows, empty, over_colours
from ngpt.classical.arrays import image as as_image
from ngpt.classical.leastsquares import solve

# Pixels over which energy is compared: the screened Poisson equation's length. 16 and 64 pixels are as good.
REACH = 32

# A neighbourhood becomes at most this many times brighter or darker: sums with pixels of 1e12 lose all other digits.
MOST = 4.0


def keep_energy(image: np.ndarray, primal: np.ndarray) -> np.ndarray:
    """The reconstruction with the local brightness of ``primal``; both are (H, W, C), and so is the result.

    The factor is one for all colours, smooth, and 1 where the two agree. f(k image, k primal) = k f(image, primal).
    """
    double = empty(image[..., 0], 2, dtype=np.float64)
    brightness, _ = by_rows(lambda i, j: (np.stack([over_colours(x[i:j]) for x in (primal, image)]),), double)
    # Averaged over REACH pixels up to a factor, which cancels in the ratio; sums are kept.
    local = solve(brightness, 1 / REACH**2)

    def rows(first: int, last: int) -> tuple:
        before, after = local[:, first:last]
        lit = (before > 0) & (after > 0)
        factor = np.where(lit, before / np.where(lit, after, 1), 1).clip(1 / MOST, MOST)
        factor = factor.astype(image.dtype, copy=False)
        return (np.stack([factor * image[first:last, :, channel] for channel in range(image.shape[-1])]),)

    out = empty(image[..., 0], image.shape[-1], channels_last=True, dtype=image.dtype)
    return as_image(by_rows(rows, out)[0])
