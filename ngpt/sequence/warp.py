"""Warps images of one frame into another frame along motion vectors."""

import numpy as np


def warped(
    image: np.ndarray, motion: np.ndarray, sharp: bool = False, shift: tuple[int, int] = (0, 0)
) -> tuple[np.ndarray, np.ndarray]:
    """The ``image`` of one frame, looked up at x + motion for each pixel x of another frame.

    ``image``   (h, w, C)
    ``motion``  (H, W, 2), in pixels to the right and down; where it is not finite, nothing is found
    ``sharp``   whether values between pixels are interpolated by a Catmull-Rom spline, clamped to the range of the four
                nearest pixels. Otherwise interpolation is bilinear, which loses detail each time
    ``shift``   the position (x, y) of the other frame's first pixel in the image

    Returns the values (H, W, C), of the image's type, and (H, W) booleans: whether x + motion is inside the image.
    Where it is not, the value is 0.
    """
    (x, y), (height, width) = _aims(motion, shift), image.shape[:2]
    with np.errstate(invalid="ignore"):
        found = (x >= -0.5) & (x <= width - 0.5) & (y >= -0.5) & (y <= height - 0.5)
    x, y = (np.where(found, v, 0) for v in (x, y))
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    fx, fy = ((v - whole).astype(image.dtype)[..., None] for v, whole in ((x, left), (y, top)))

    def tap(i: int, j: int) -> np.ndarray:
        return image[np.clip(top + j, 0, height - 1), np.clip(left + i, 0, width - 1)]

    if not sharp:
        upper, lower = (tap(0, j) + fx * (tap(1, j) - tap(0, j)) for j in (0, 1))
        value = upper + fy * (lower - upper)
    else:
        across, down = _catmull_rom(fx), _catmull_rom(fy)
        taps = [[tap(i, j) for i in range(-1, 3)] for j in range(-1, 3)]
        rows = [sum(weight * pixel for weight, pixel in zip(across, row, strict=True)) for row in taps]
        value = sum(weight * row for weight, row in zip(down, rows, strict=True))
        around = [*taps[1][1:3], *taps[2][1:3]]
        value = np.clip(value, np.minimum.reduce(around), np.maximum.reduce(around))
    return np.where(found[..., None], value, 0).astype(image.dtype, copy=False), found


def bilinear_taps(
    motion: np.ndarray, size: tuple[int, int], shift: tuple[int, int] = (0, 0)
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The taps of a bilinear lookup at x + motion in an image of ``size`` (h, w); ``shift`` is as for ``warped``.

    Returns the indices of four pixels in row-major order, (4, N) with N = H * W; their weights (4, N); and booleans
    (H, W): whether x + motion lies between pixel centres of the image.
    """
    (x, y), (height, width) = _aims(motion, shift), size
    with np.errstate(invalid="ignore"):
        found = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    x, y = (np.where(found, v, 0) for v in (x, y))
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    fx, fy = x - left, y - top
    right, below = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    places = [row * width + column for row in (top, below) for column in (left, right)]
    weights = [(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy]
    return np.stack(places).reshape(4, -1), np.stack(weights).reshape(4, -1), found


def _aims(motion: np.ndarray, shift: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """The coordinates x and y (H, W) of x + motion."""
    y, x = np.mgrid[: motion.shape[0], : motion.shape[1]].astype(np.float64)
    return x + shift[0] + motion[..., 0], y + shift[1] + motion[..., 1]


def _catmull_rom(f: np.ndarray) -> list[np.ndarray]:
    """The weights of four neighbouring pixels for a position at the fraction ``f`` between the second and the third."""
    return [
        f * (-0.5 + f * (1 - 0.5 * f)),
        1 + f * f * (-2.5 + 1.5 * f),
        f * (0.5 + f * (2 - 1.5 * f)),
        f * f * (-0.5 + 0.5 * f),
    ]
