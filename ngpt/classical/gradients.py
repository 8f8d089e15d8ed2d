"""Forward differences. The sign and position of gradients are defined here.

dx[y, x] = I[y, x + 1] - I[y, x]    last column 0
dy[y, x] = I[y + 1, x] - I[y, x]    last row 0
"""

from collections.abc import Callable

import numpy as np

from ngpt.classical.arrays import by_rows


def forward_differences(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The gradients (dx, dy) of an image, each of the image's own shape (H, W, ...)."""
    dx, dy = differences(np.moveaxis(image, (0, 1), (-2, -1)), 0, image.shape[0])
    return np.moveaxis(dx, (-2, -1), (0, 1)), np.moveaxis(dy, (-2, -1), (0, 1))


def differences(planes: np.ndarray, first: int, last: int) -> tuple[np.ndarray, np.ndarray]:
    """dx and dy of rows first .. last - 1 of (..., H, W) planes."""
    here, below = planes[..., first:last, :], planes[..., first + 1 : last + 1, :]
    dx, dy = -here, -here
    dx[..., :-1] += here[..., 1:]
    dx[..., -1] = 0
    rows = below.shape[-2]
    dy[..., :rows, :] += below
    dy[..., rows:, :] = 0
    return dx, dy


def adjoint(dx: np.ndarray, dy: np.ndarray) -> np.ndarray:
    """The adjoint of ``differences``, i.e. the negative divergence, (..., rows, W).

    The unused column of dx and row of dy must be 0. Then ``(differences(I) * (dx, dy)).sum()`` equals
    ``(I * adjoint(dx, dy)).sum()``.
    """
    total = -dx
    total -= dy
    total[..., 1:] += dx[..., :-1]
    total[..., 1:, :] += dy[..., :-1, :]
    return total


def adjoint_by_rows(function: Callable[[int, int], tuple], *out: np.ndarray) -> tuple:
    """``by_rows`` for a function that returns v, dx, dy and further values; the first result is v + adjoint(dx, dy).

    v may be None, which stands for 0.
    """

    def band(first: int, last: int) -> tuple:
        v, dx, dy, *values = function(first, last)
        total = adjoint(dx, dy)
        if v is not None:
            total += v
        others = len(out) - 1
        return (total, *values[:others], last, dy[..., -1, :], *values[others:])

    total, *arrays, bands = by_rows(band, *out)
    # The last row of dy of a band also contributes to the first row of the next band.
    for last, lowest, *_ in bands[:-1]:
        total[..., last, :] += lowest
    return (total, *arrays, [values for _, _, *values in bands])
