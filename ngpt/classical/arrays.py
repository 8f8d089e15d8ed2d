"""Operations for several solvers: cosine transforms, bands of rows, layouts.

Arrays are (..., H, W), float32 or float64, unless a function says otherwise.
"""

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from ngpt.system.late import fft
from ngpt.system.limits import processors
from ngpt.system.threads import map_parts

# The target size of a band of rows: the number of values in it, summed over all arrays. About a dozen temporary arrays
# of this size fit into the cache of a core. In the cache, NumPy expressions are several times faster than over whole
# images.
BAND = 3 << 17


def planes(image: np.ndarray) -> np.ndarray:
    """(H, W, C) seen as (C, H, W)."""
    return np.moveaxis(image, -1, 0)


def image(planes: np.ndarray) -> np.ndarray:
    """(C, H, W) seen as (H, W, C)."""
    return np.moveaxis(planes, 0, -1)


def over_colours(image: np.ndarray) -> np.ndarray:
    """(H, W, C) summed over C in double precision.

    Adding channel by channel is ten times as fast as NumPy's sum over an axis of three.
    """
    total = image[..., 0].astype(np.float64)
    for channel in range(1, image.shape[-1]):
        total = total + image[..., channel]
    return total


def empty(array: np.ndarray, *lead: int, channels_last: bool = False, dtype: Any = None) -> np.ndarray:
    """An uninitialised array (*lead, H, W), with H and W of ``array`` (..., H, W).

    With ``channels_last``, ``lead`` is one axis, which lies innermost in memory.
    """
    shape = (*array.shape[-2:], *lead) if channels_last else (*lead, *array.shape[-2:])
    new = np.empty(shape, dtype or array.dtype)
    return planes(new) if channels_last else new


def map_rows(function: Callable[[int, int], Any], *like: np.ndarray) -> list:
    """The results of ``function(first, last)`` for bands of rows first .. last - 1, top to bottom.

    They are computed on all cores. The height of the bands follows from ``BAND`` and the sizes of the arrays ``like``.
    """
    height = like[0].shape[-2]
    rows = max(1, BAND * height // max(1, sum(array.size for array in like)))
    return map_silent(lambda first: function(first, min(first + rows, height)), range(0, height, rows))


def map_silent(function: Callable[[Any], Any], parts: Iterable) -> list:
    """``map_parts`` without NumPy's warnings, which are silenced in each thread. reconstruct() checks the results."""

    def silent(part: Any) -> Any:
        with np.errstate(all="ignore"):
            return function(part)

    return map_parts(silent, parts)


def by_rows(function: Callable[[int, int], tuple], *out: np.ndarray) -> tuple:
    """The arrays ``out``, filled with the rows first .. last - 1 that ``function(first, last)`` returns.

    Bands of rows are computed on all cores. The function may read only its own rows of ``out``. If it returns further
    values, they are in the last item of the result: a list with one entry for each band, from top to bottom.
    """

    def band(first: int, last: int) -> tuple:
        values = function(first, last)
        for array, part in zip(out, values, strict=False):
            array[..., first:last, :] = part
        return values[len(out) :]

    return (*out, map_rows(band, *out))


def dct2(x: np.ndarray) -> np.ndarray:
    """Orthonormal cosine transform (type II) over the last two axes; ``x`` is overwritten."""
    return fft.dctn(x, axes=(-2, -1), norm="ortho", overwrite_x=True, workers=processors())


def idct2(x: np.ndarray) -> np.ndarray:
    """Inverse (and transpose) of ``dct2``."""
    return fft.idctn(x, axes=(-2, -1), norm="ortho", overwrite_x=True, workers=processors())
