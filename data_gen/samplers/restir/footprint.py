"""Where a pixel's area was one frame before: on up to four pixels, and how much of what is known of them it takes over.

NumPy, and of motion alone: what has no random numbers in it may decide what counts.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

# Of a pixel's area that was moved by a fraction: the pixels it lies on, from the one of its own corner on.
CORNERS = ((0, 0), (1, 0), (0, 1), (1, 1))


def pair_motions(motion: np.ndarray, depth: np.ndarray | None, steps: Iterable[tuple[int, int]]) -> np.ndarray:
    """(steps, H, W, 2): the motion of the pixel, or of the pair of it and the one a step on: that of the nearer one.

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


def confidence_after(
    before: np.ndarray, motions: np.ndarray, steps: Iterable[tuple[int, int]], cap: float
) -> np.ndarray:
    """(steps, H, W) float32: a frame's confidence, 1 and by areas that of the frame ``before``; at most ``cap``.

    0 for pairs that reach over the edge of the film.
    """
    count, height, width = before.shape
    y, x = np.mgrid[:height, :width]
    after = np.ones((count, height, width))
    for domain, (right, down) in enumerate(steps):
        known = np.isfinite(motions[domain]).all(axis=-1)
        place = np.stack([x, y], axis=-1) + np.where(known[..., None], motions[domain], -2)
        base = np.floor(place).astype(np.int64)
        part = place - base
        for corner in CORNERS:
            at = base + corner
            inside = ((at >= 0) & (at < (width, height))).all(axis=-1)
            area = np.prod(np.where(corner, part, 1 - part), axis=-1)
            column, row = np.where(inside[..., None], at, 0).transpose(2, 0, 1)
            after[domain] += np.where(inside & known, area * before[domain, row, column], 0)
        after[domain] = np.minimum(after[domain], cap)
        if right:
            after[domain, :, -right:] = 0
        if down:
            after[domain, -down:] = 0
    return after.astype(np.float32)
