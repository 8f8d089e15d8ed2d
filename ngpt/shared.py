"""Noise that pixels share: the layer ``shared``, which renders have whose paths end in a cache.

It is a sample of that noise, with the distribution of the noise itself. For any weights w of pixels, the expected
square of Σ w shared is the variance that the cache gives to Σ w primal: of a pixel, of a block, or of the whole image.
Stacks are merged by means, and so are their layers ``shared``. ``primal_var`` holds its part of each pixel's variance.
"""

from __future__ import annotations

import numpy as np

# Header attributes: whether paths shared their tails, and why not; the share of the cache's light that was cut from
# records which were too bright
TAILS, CUT = "ngpt:tails", "ngpt:tailsCut"
# Side of the square of pixels over which the squares of a pixel's variance are averaged
_AROUND = 5


def shared_variance(shared: np.ndarray) -> np.ndarray:
    """The variance of each pixel that it shares with others, (H, W, C), of the layer ``shared``, (H, W, C)."""
    squares = np.square(shared.astype(np.float64))
    means = [box_means(squares[..., channel], _AROUND) for channel in range(squares.shape[-1])]
    return np.maximum(np.stack(means, axis=-1), 0)


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
