"""Subpixels: K x K values for each pixel of what denoisers read, whose means are the pixels.

A pixel on an edge mixes two surfaces, and no denoiser can take them apart again. So ``primal``, ``albedo`` and
``normal`` may be kept by subpixels, (K H, K W, 3) float32: subpixel (i, j) of pixel (y, x), row by row, is at
[K y + i, K x + j]. They are ``GradientStack.fine``. A pixel of the stack is the mean of its subpixels, to the bit, as
``means`` computes it. So subpixels that no longer belong to their pixels are detected, whatever program changed these.
"""

import logging
from collections.abc import Mapping, Sequence

import numpy as np

from ngpt.errors import NgptError, WrongUse

_LOG = logging.getLogger(__name__)

# The layers that have subpixels
FINE = ("primal", "albedo", "normal")
# The layers among these that are stored as half floats: rounding is far below their noise.
HALF = ("albedo", "normal")
# Header attribute: K, where a file has subpixels
SUBPIXELS = "ngpt:subpixels"
# The values of K that can be asked for
CHOICES = (1, 2, 4)
# Fewer paths than this per pixel leave too little in a subpixel: at 8 the error is the same and FLIP 2 % worse.
FEWEST = 16


def subpixels(fine: Mapping[str, np.ndarray], width: int) -> int:
    """K of the subpixels of an image of this width; 1 where there are none."""
    return fine["primal"].shape[1] // width if fine else 1


def choice(asked: int | str) -> int | str:
    """What is ``asked`` for, K or its text, as a number of ``CHOICES``, or "auto". Raises WrongUse for all else."""
    if (text := str(asked)) not in ("auto", *map(str, CHOICES)):
        raise WrongUse(f"'{text}' subpixels cannot be kept; write {', '.join(map(str, CHOICES))}, or auto")
    return text if text == "auto" else int(text)


def best(spp: int | None) -> int:
    """K of the subpixels that OIDN makes the best image of, by paths per pixel; None: as many as time allows."""
    return 2 if spp is None or spp >= FEWEST else 1


def means(layer: np.ndarray, k: int) -> np.ndarray:
    """The pixels, (H, W, C) float32, of a layer of K x K subpixels; a pixel with a subpixel that is NaN is NaN."""
    total = np.zeros((layer.shape[0] // k, layer.shape[1] // k, *layer.shape[2:]))
    # In this order: others could round otherwise.
    for i in range(k):
        for j in range(k):
            total += layer[i::k, j::k]
    return (total / (k * k)).astype(np.float32)


def spread(layer: np.ndarray, k: int) -> np.ndarray:
    """The inverse of ``means`` for subpixels that are all alike."""
    return layer.repeat(k, axis=0).repeat(k, axis=1)


def stored(name: str, layer: np.ndarray) -> np.ndarray:
    """A layer of subpixels, float32, with the values that files have of it."""
    if name in HALF:
        with np.errstate(over="ignore"):
            layer = layer.astype(np.float16)
    return np.ascontiguousarray(layer, np.float32)


def cropped(fine: Mapping[str, np.ndarray], window: tuple[slice, slice], k: int) -> dict[str, np.ndarray]:
    """The K x K subpixels of the pixels in these rows and columns."""
    rows_and_columns = within(window, k)
    return {name: np.ascontiguousarray(layer[rows_and_columns]) for name, layer in fine.items()}


def within(window: tuple[slice, slice], k: int) -> tuple[slice, slice]:
    """The rows and columns of the K x K subpixels of such pixels."""
    rows, columns = (slice(k * part.start, k * part.stop) for part in window)
    return rows, columns


Part = tuple[Mapping[str, np.ndarray], np.ndarray, tuple[slice, slice]]


def merged(parts: Sequence[Part], names: Sequence[str], size: tuple[int, int]) -> dict[str, np.ndarray]:
    """The subpixels of an image of this size (width, height), from those of its parts: means weighted by samples.

    Each part has its subpixels, the samples of its pixels (h, w, 1), and its rows and columns in the image.
    """
    k = parts[0][0]["primal"].shape[1] // parts[0][1].shape[1]
    layers = {}
    for name in names:
        total, weight = (np.zeros((k * size[1], k * size[0], 3)) for _ in range(2))
        for fine, counts, rows_and_columns in parts:
            where = within(rows_and_columns, k)
            w = spread(counts, k) * ~np.isnan(fine[name])
            total[where] += np.where(w > 0, w * fine[name].astype(np.float64), 0)
            weight[where] += w
        with np.errstate(invalid="ignore", divide="ignore"):
            layers[name] = stored(name, total / weight)
    return layers


def check(fine: Mapping[str, np.ndarray], width: int, height: int, path: str) -> None:
    """Raises NgptError for subpixels that do not fit an image of this size."""
    if not fine:
        return
    if "primal" not in fine or (other := next((name for name in fine if name not in FINE), None)):
        what = "no 'primal'" if "primal" not in fine else f"'{other}'"
        raise NgptError(f"{path}: the subpixels have {what}; give those of primal, and of albedo and normal")
    k = subpixels(fine, width)
    for name, layer in fine.items():
        if k < 1 or layer.shape != (k * height, k * width, 3) or layer.dtype != np.float32:
            raise NgptError(
                f"{path}: the subpixels of '{name}' are {layer.dtype} {layer.shape}, the image {width}x{height}; "
                f"give float32 (K * {height}, K * {width}, 3)"
            )


def belong(fine: Mapping[str, np.ndarray], layers: Mapping[str, np.ndarray], path: str) -> bool:
    """Whether the pixels are the means of the subpixels; a warning says so where they are not."""
    for name, layer in fine.items():
        k = layer.shape[1] // layers[name].shape[1] if name in layers else 0
        if not k or not np.array_equal(means(layer, k), layers[name], equal_nan=True):
            _LOG.warning(
                "%s: the subpixels are of another image, since '%s' is not their mean; they are left out", path, name
            )
            return False
    return True
