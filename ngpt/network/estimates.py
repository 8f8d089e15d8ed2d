"""Estimates variances that a stack with gradients lacks, from an image with little noise."""

from dataclasses import replace

import numpy as np

from ngpt.repair import Repaired
from ngpt.system.late import ndimage


def with_variances(data: Repaired, image: np.ndarray) -> Repaired:
    """The stack with variances of image, dx and dy. Variances that the stack lacks are estimated.

    ``image`` (H, W, 3) is a reconstruction with little noise, without direct emission. The estimate is the squared
    difference between a layer and this image (or its pixel differences), averaged twice over 3 x 3 pixels. Detail that
    the reconstruction blurs counts as noise of the gradients. So gradients are trusted too little there, rather than
    too much (docs/lab/log/2026-W47.md, "what auto takes").
    """
    noise = data.noise
    if noise is None:
        # The variance is unknown where the camera sees an emitter, as in stacks that hold variances.
        seen = data.direct.any(axis=-1, keepdims=True)
        noise = np.where(seen, np.float32(np.nan), _around(data.image, image))
    variances = data.variances
    if variances is None:
        dx, dy = np.zeros_like(image), np.zeros_like(image)
        dx[:, :-1], dy[:-1] = np.diff(image, axis=1), np.diff(image, axis=0)
        of_dx, of_dy = _around(data.dx, dx), _around(data.dy, dy)
        if data.trusted is not None:
            right, below = (trusted[..., None] for trusted in data.trusted)
            of_dx, of_dy = np.where(right, of_dx, np.float32(np.nan)), np.where(below, of_dy, np.float32(np.nan))
        variances = (noise, of_dx, of_dy)
    return replace(data, noise=noise, variances=variances)


def _around(layer: np.ndarray, smooth: np.ndarray) -> np.ndarray:
    """The squared difference between a layer and ``smooth``, averaged around each pixel, (H, W, 3) float32."""
    squares = (layer.astype(np.float64) - smooth) ** 2
    for _ in range(2):
        squares = ndimage.uniform_filter(squares, (3, 3, 1), mode="nearest")
    return squares.astype(np.float32)
