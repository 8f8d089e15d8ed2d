"""Statistics of a whole image. If a network reconstructs the image in tiles, every tile gets the same statistics."""

from collections.abc import Mapping

import numpy as np

# The typical radiance of an image after exposure. Its logarithm is ln(1 + 4) = 1.6. Radiance that is 40 times darker is
# 0.1 after exposure, and ln(1 + x) still compresses it a little.
KEY = 4.0
# The side, in pixels, of the blocks that are averaged for the exposure.
BLOCK = 16
# The number of rows that are processed at a time, a multiple of BLOCK.
_BAND = 256


def statistics(layers: Mapping[str, np.ndarray]) -> np.ndarray:
    """(5,) float32: exposure, largest depth, least radiance (at most 0), largest radiance (at least 0), and 0.

    ``layers`` holds the arrays (H, W, C) ``primal`` and, optionally, ``depth``. Values that are not finite count as 0.
    The exposure equals that of ``ngpt.network.features.exposure``. The last entry stands for the mean variance. Only a
    graph that computes the base itself needs this variance (export/CONTRACT.md).
    """
    primal, low, high, means = layers["primal"], 0.0, 0.0, []
    for top in range(0, len(primal), _BAND):
        rows = np.nan_to_num(primal[top : top + _BAND], nan=0, posinf=0, neginf=0)
        low, high = min(low, float(rows.min())), max(high, float(rows.max()))
        means.append(_block_means(np.maximum(rows, 0).mean(axis=-1, dtype=np.float32)).ravel())
    values = np.sort(np.concatenate(means))[::-1]
    lit = int(np.sum(values > 0))
    exposure = values[min(lit // 2, len(values) - 1)] / KEY if lit else 1.0
    depth = np.nan_to_num(layers["depth"], posinf=0, neginf=0).max() if "depth" in layers else 0.0
    return np.array([exposure, depth, low, high, 0], np.float32)


def _block_means(values: np.ndarray) -> np.ndarray:
    """Means over blocks of 16x16 pixels; blocks at the border may be smaller."""
    starts = [np.arange(0, length, BLOCK) for length in values.shape]
    counts = [np.diff([*start, length]) for start, length in zip(starts, values.shape, strict=True)]
    sums = np.add.reduceat(np.add.reduceat(values, starts[0], axis=0, dtype=np.float64), starts[1], axis=1)
    return sums / np.outer(*counts)
