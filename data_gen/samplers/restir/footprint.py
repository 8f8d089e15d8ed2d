"""Where a pixel's area was one frame before: on up to four pixels. NumPy; depends on motion only."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

# The pixels that a pixel's area lies on when it is moved by a fraction, starting at the one of its own corner.
CORNERS = ((0, 0), (1, 0), (0, 1), (1, 1))


def pair_motions(motion: np.ndarray, depth: np.ndarray | None, steps: Iterable[tuple[int, int]]) -> np.ndarray:
    """(steps, H, W, 2): the motion of a pixel, or of a pair of it and the pixel one step on: the nearer one's motion.

    NaN where that is not known, and for pairs that reach over the edge of the film.
    """
    height, width = motion.shape[:2]
    found = np.full((0, height, width, 2), np.nan)
    for x, y in steps:
        second = np.full_like(motion, np.nan, dtype=np.float64)
        inside = np.s_[: height - y, : width - x]
        second[inside] = motion[y:, x:]
        of_both = np.where(np.isfinite(second).all(axis=-1, keepdims=True), motion, np.nan)
        if depth is not None and (x or y):
            nearer = np.zeros((height, width), bool)
            nearer[inside] = depth[y:, x:] < depth[inside]
            of_both = np.where(nearer[..., None], second, of_both)
        found = np.concatenate([found, of_both[None]])
    return found
