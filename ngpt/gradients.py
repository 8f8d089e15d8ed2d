"""Forward differences: the one place that fixes the sign and position of a gradient.

dx[y, x] = I[y, x + 1] - I[y, x]    last column 0
dy[y, x] = I[y + 1, x] - I[y, x]    last row 0
"""

import numpy as np


def forward_differences(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The gradients (dx, dy) of an image, each of the image's own shape (H, W, ...)."""
    dx, dy = np.zeros_like(image), np.zeros_like(image)
    np.subtract(image[:, 1:], image[:, :-1], out=dx[:, :-1])
    np.subtract(image[1:], image[:-1], out=dy[:-1])
    return dx, dy


def adjoint_differences(dx: np.ndarray, dy: np.ndarray) -> np.ndarray:
    """The adjoint of ``forward_differences``, i.e. the negative divergence, (H, W, ...).

    The last column of dx and the last row of dy stand for no difference and are ignored. With it,
    ``(forward_differences(I) * (dx, dy)).sum() == (I * adjoint_differences(dx, dy)).sum()``.
    """
    image = np.zeros_like(dx)
    image[:, :-1] -= dx[:, :-1]
    image[:, 1:] += dx[:, :-1]
    image[:-1] -= dy[:-1]
    image[1:] += dy[:-1]
    return image
