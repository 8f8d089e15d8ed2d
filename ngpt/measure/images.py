"""Preparation of images for metrics."""

import numpy as np

from ngpt.errors import NgptError


def check_size(image: np.ndarray, reference: np.ndarray) -> None:
    """Raises NgptError if the images cannot be compared."""
    if image.shape != reference.shape:
        raise NgptError(
            f"images of different size cannot be compared: {image.shape[1]}x{image.shape[0]} and "
            f"{reference.shape[1]}x{reference.shape[0]}; render or crop them alike"
        )


def reinhard(image: np.ndarray) -> np.ndarray:
    """The tone map of PSNR and SSIM: x / (1 + x) for each channel, in [0, 1), values below 0 taken as 0."""
    positive = np.maximum(image, 0)
    return positive / (1 + positive)


def middle(halves: tuple[np.ndarray, ...]) -> np.ndarray:
    """m = (a + b) / 2 of a reference's two halves; the reference itself if there is only one image."""
    return halves[0] if len(halves) == 1 else (halves[0] + halves[1]) / 2
