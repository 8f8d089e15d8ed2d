"""Noise that pixels share: the layer ``shared`` of renders whose paths end in a cache.

The layer is a sample with the distribution of that noise. Let w be weights of pixels: of one pixel, of a block, or of
the whole image. The expected square of the sum Σ w · shared is then the variance that the cache adds to Σ w · primal.
``primal_var`` includes the variance of this noise in each pixel. In a merged stack, ``shared`` is the mean of the
layers ``shared`` of its parts, as ``primal`` is the mean of the layers ``primal``.
"""

from __future__ import annotations

import numpy as np

# Header attributes. TAILS says in a sentence whether paths shared their tails (ended in the cache), or why not. CUT is
# the share of the cache's light that was cut off from records that were too bright.
TAILS, CUT = "ngpt:tails", "ngpt:tailsCut"
# Side, in pixels, of the square over which squares of ``shared`` are averaged for a pixel's variance
_AROUND = 5
# Side of the square blocks whose noise is reported
_BLOCK = 32


def shared_variance(shared: np.ndarray) -> np.ndarray:
    """The variance of the shared noise in each pixel, (H, W, C), from the layer ``shared``, (H, W, C).

    Values that are not finite count as zero, because the running sums of ``box_means`` would spread them.
    """
    squares = np.square(np.where(np.isfinite(shared), shared, 0).astype(np.float64))
    means = [box_means(squares[..., channel], _AROUND) for channel in range(squares.shape[-1])]
    return np.maximum(np.stack(means, axis=-1), 0)


def noise_of_light(primal: np.ndarray, primal_var: np.ndarray, shared: np.ndarray) -> dict[str, dict[str, float]]:
    """The standard errors of the mean light in the whole image, and in whole blocks of ``_BLOCK`` pixels, if any.

    The layers are (H, W, C). "own" is the noise of single pixels, and "shared" is shared noise. Both are root mean
    squares over channels and blocks, relative to the mean light of the image. Values that are not finite count as zero.
    """
    layers = (np.where(np.isfinite(layer), layer, 0) for layer in (primal, primal_var, shared))
    light, variance, sample = (layer.astype(np.float64) for layer in layers)
    own, scale = np.maximum(variance - shared_variance(sample), 0), abs(light.mean()) or np.nan
    found = {}
    for name, (height, width) in (("whole image", own.shape[:2]), (f"blocks of {_BLOCK}x{_BLOCK}", (_BLOCK, _BLOCK))):
        rows, columns = own.shape[0] // height, own.shape[1] // width
        if rows * columns:
            of_own, of_shared = (
                layer[: rows * height, : columns * width].reshape(rows, height, columns, width, -1).mean(axis=(1, 3))
                for layer in (own, sample)
            )
            squares = {"own": of_own / (height * width), "shared": of_shared**2}
            found[name] = {part: float(np.sqrt(square.mean()) / scale) for part, square in squares.items()}
    return found


def box_means(image: np.ndarray, size: int) -> np.ndarray:
    """The mean of ``size`` x ``size`` pixels around each pixel of an image (H, W), which is mirrored at its edges.

    The result equals that of SciPy's ``uniform_filter`` bit for bit. SciPy is not used, because its import would take
    longer than computing all variances of a small render.
    """
    if not image.size:  # differences within a single row or column of pixels
        return image
    before = size // 2
    for axis in (0, 1):
        lines = np.moveaxis(image, axis, 0).astype(np.float64)
        lines = np.pad(lines, ((before, size - 1 - before), (0, 0)), mode="symmetric")
        total = np.zeros(lines.shape[1])
        for line in lines[:size]:
            total += line
        means = np.empty(np.moveaxis(image, axis, 0).shape, image.dtype)
        means[0] = total / size
        for i in range(1, len(means)):
            total += lines[i + size - 1] - lines[i - 1]
            means[i] = total / size
        image = np.moveaxis(means, 0, axis)
    return image
