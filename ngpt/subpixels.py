"""Subpixels: K x K values for each pixel of the layers that denoisers read.

A pixel on an edge mixes two surfaces, and no denoiser can separate them again. So ``GradientStack.fine`` may hold
``primal``, ``albedo`` and ``normal`` by subpixels, (K H, K W, 3) float32. Row i, column j of the subpixels of pixel
(y, x) is at [K y + i, K x + j]. Each pixel of the stack equals the mean of its subpixels, bit for bit, as ``means``
computes it. If another program has changed the pixels, this no longer holds, and the subpixels are left out.
"""

import logging
from collections.abc import Mapping

import numpy as np

from ngpt.errors import NgptError, WrongUse

_LOG = logging.getLogger(__name__)

# The layers that have subpixels
FINE = ("primal", "albedo", "normal")
# Of these layers, those that are stored as half floats, because the error of rounding is far below their noise
HALF = ("albedo", "normal")
# Header attribute: K, where a file has subpixels
SUBPIXELS = "ngpt:subpixels"
# The values of K that a render allows
CHOICES = (1, 2, 4)
# The fewest paths per pixel for which subpixels help: at 8, the error is the same and FLIP is 2 % worse.
FEWEST = 16


def subpixels(fine: Mapping[str, np.ndarray], width: int) -> int:
    """Returns K for the subpixels of an image that is ``width`` pixels wide; 1 if there are no subpixels."""
    return fine["primal"].shape[1] // width if fine else 1


def choice(k: int | str) -> int | str:
    """Converts ``k``, which may be a text, to a number of ``CHOICES`` or "auto". Raises WrongUse for other values."""
    if (text := str(k)) not in ("auto", *map(str, CHOICES)):
        raise WrongUse(f"'{text}' subpixels cannot be kept; write {', '.join(map(str, CHOICES))}, or auto")
    return text if text == "auto" else int(text)


def best(spp: int | None) -> int:
    """The K that gives OIDN's best image for ``spp`` paths per pixel; ``spp`` is None for as many as time allows."""
    return 2 if spp is None or spp >= FEWEST else 1


def means(layer: np.ndarray, k: int) -> np.ndarray:
    """The pixels (H, W, C) float32 of a layer (K H, K W, C) of subpixels. A pixel with a NaN subpixel is NaN."""
    total = np.zeros((layer.shape[0] // k, layer.shape[1] // k, *layer.shape[2:]))
    # The order of summation is fixed, because another order could round differently.
    for i in range(k):
        for j in range(k):
            total += layer[i::k, j::k]
    return (total / (k * k)).astype(np.float32)


def spread(layer: np.ndarray, k: int) -> np.ndarray:
    """A layer of pixels (H, W, C) as subpixels (K H, K W, C): each pixel is repeated."""
    return layer.repeat(k, axis=0).repeat(k, axis=1)


def stored(name: str, layer: np.ndarray) -> np.ndarray:
    """A layer of subpixels, float32, rounded as files round it."""
    if name in HALF:
        with np.errstate(over="ignore"):
            layer = layer.astype(np.float16)
    return np.ascontiguousarray(layer, np.float32)


def cropped(fine: Mapping[str, np.ndarray], window: tuple[slice, slice], k: int) -> dict[str, np.ndarray]:
    """The subpixels of the pixels in the rows and columns of ``window``."""
    return {name: np.ascontiguousarray(layer[within(window, k)]) for name, layer in fine.items()}


def within(window: tuple[slice, slice], k: int) -> tuple[slice, slice]:
    """Converts rows and columns of pixels to the rows and columns of their subpixels."""
    rows, columns = (slice(k * part.start, k * part.stop) for part in window)
    return rows, columns


def check(fine: Mapping[str, np.ndarray], width: int, height: int, path: str) -> None:
    """Raises NgptError for subpixels that do not fit an image of this size in pixels."""
    if not fine:
        return
    if "primal" not in fine or (other := next((name for name in fine if name not in FINE), None)):
        what = "no 'primal'" if "primal" not in fine else f"'{other}'"
        raise NgptError(f"{path}: the subpixels have {what}; give those of primal, and of albedo and normal")
    k = subpixels(fine, width)
    for name, layer in fine.items():
        if k < 1 or layer.shape != (k * height, k * width, 3) or layer.dtype != np.float32:
            found = f"the subpixels of '{name}' are {layer.dtype} {layer.shape}, the image {width}x{height}"
            raise NgptError(f"{path}: {found}; give float32 (K * {height}, K * {width}, 3)")


def belong(fine: Mapping[str, np.ndarray], layers: Mapping[str, np.ndarray], path: str) -> bool:
    """Whether the pixels in ``layers`` are the means of the subpixels; if not, logs a warning."""
    for name, layer in fine.items():
        k = layer.shape[1] // layers[name].shape[1] if name in layers else 0
        if not k or not np.array_equal(means(layer, k), layers[name], equal_nan=True):
            _LOG.warning("%s: the means of the subpixels differ from '%s', so they are left out", path, name)
            return False
    return True
