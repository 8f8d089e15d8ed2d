"""Statistics of a whole image, which all of its tiles share when a network reconstructs them."""

from collections.abc import Mapping

import numpy as np

# The typical radiance of an image after exposure. 4 becomes ln(5) = 1.6 after compression, so that the logarithm still
# compresses radiance that is 40 times darker.
KEY = 4.0
BLOCK = 16
# Rows that are processed together; a multiple of BLOCK.
_BAND = 256


def statistics(layers: Mapping[str, np.ndarray]) -> np.ndarray:
    """(5,) float32: exposure, largest depth, least (at most 0) and largest (at least 0) radiance, 0 for the mean
    variance.

    ``layers`` (H, W, C): ``primal``, and ``depth`` where there is one; values that are not finite count as 0. The
    exposure is computed as in ``ngpt.network.features.exposure``. The mean variance is needed only if the graph
    makes the base, see export/CONTRACT.md.
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
