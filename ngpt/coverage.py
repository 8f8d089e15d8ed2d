"""Keeps results dark in empty pixels, where alpha is 0 and the input has no light.

Light is premultiplied by alpha, so light at alpha 0 is legal: fire and glare add to the background. Pixels with such
light, and dark pixels among them, are not changed.

Light that a method spreads into empty pixels is missing in covered pixels. Hair, for example, may cover a tenth of each
pixel. Then few samples hit the hair, and a method blurs it. Therefore the light in empty pixels is given back to the
covered pixels around them, in proportion to their alpha, but no more than the method took from these pixels.
"""

import numpy as np

from ngpt.stack import GradientStack
from ngpt.system.late import ndimage

# Side, in pixels, of a square around each pixel with light at alpha 0. Black pixels in it may be black by chance.
_CHANCE = 5
# Standard deviation, in pixels, of the window in which light is given back
_WINDOW = 2.0


def empty_pixels(stack: GradientStack) -> np.ndarray:
    """The empty pixels, (H, W) booleans. If most light is at alpha 0, alpha is not coverage, and no pixel is empty."""
    if "alpha" not in stack:
        return np.zeros((stack.height, stack.width), bool)
    uncovered = stack["alpha"][..., 0] == 0
    light = np.nan_to_num(np.abs(stack["primal"]).sum(axis=-1, dtype=np.float64), posinf=0.0)
    dark = ~stack["primal"].any(axis=-1)
    empty = uncovered & dark
    if not empty.any() or 2 * light[uncovered].sum() > light.sum():
        return np.zeros_like(empty)
    return empty & ~ndimage.maximum_filter(uncovered & ~dark, _CHANCE)


def kept_within(image: np.ndarray, stack: GradientStack) -> np.ndarray:
    """The reconstruction (H, W, 3) of a stack, with the light in its empty pixels given back; float32."""
    empty = empty_pixels(stack)
    if not image[empty].any():
        return image
    spread = np.where(empty[..., None], image, 0).astype(np.float64)
    left = image - spread
    owed, spread_there = _around(np.nan_to_num(stack["primal"], posinf=0.0, neginf=0.0) - left), _around(spread)
    spread *= np.clip(_over(owed, spread_there), 0, 1)
    alpha = np.clip(np.nan_to_num(stack["alpha"].astype(np.float64)), 0, 1)
    return (left + alpha * _around(_over(spread, _around(alpha)))).astype(np.float32)


def mirrored(image: np.ndarray, empty: np.ndarray) -> np.ndarray:
    """The image (H, W, C) with its ``empty`` pixels filled by reflection at the nearest covered pixel.

    If the reflected pixel and the nearest pixel are not in the same island of covered pixels, the nearest pixel itself
    is taken. So each island is continued by light and noise like its own.
    """
    if not empty.any() or empty.all():
        return image
    nearest = ndimage.distance_transform_edt(empty, return_distances=False, return_indices=True)
    islands = ndimage.label(~empty)[0]
    limits = np.array(empty.shape)[:, None, None] - 1
    seen = np.clip(2 * nearest - np.indices(empty.shape), 0, limits)
    same = islands[tuple(seen)] == islands[tuple(nearest)]
    return image[tuple(np.where(same, seen, nearest))]


def _around(values: np.ndarray) -> np.ndarray:
    """Averages (H, W, C) in a Gaussian window around each pixel. Pixels outside of the image count as 0."""
    return ndimage.gaussian_filter(values, (_WINDOW, _WINDOW, 0), mode="constant", truncate=3)


def _over(values: np.ndarray, divisor: np.ndarray) -> np.ndarray:
    """The quotient; 0 where the divisor is 0."""
    return np.where(divisor != 0, values / np.where(divisor != 0, divisor, 1), 0)
