"""What the solvers need beyond the operations that NumPy arrays and torch tensors share.

A solver is written once, against the names both modules have (``where``, ``stack``, ``zeros_like``, slices, operators),
and against this file for the rest: cosine transforms, bands of rows, precision. torch is never imported here; it comes
in with the first tensor. On tensors everything is differentiable and runs on their device.
"""

import sys
from collections.abc import Callable, Iterable
from types import ModuleType
from typing import Any

import numpy as np

from ngpt.system.late import fft
from ngpt.system.limits import processors
from ngpt.system.threads import map_parts

# Array is a NumPy array or a torch tensor: (..., H, W), float32 or float64.
Array = Any

# Values that one band of rows has in all results. The dozen or so temporaries of a stencil then stay in a core's own
# cache, which makes plain NumPy expressions several times faster than over whole images.
BAND = 3 << 17


def module(array: Array) -> ModuleType:
    """``numpy`` or ``torch``, whichever the array belongs to."""
    return np if isinstance(array, np.ndarray) else sys.modules["torch"]


def cast(array: Array, dtype: Any) -> Array:
    """The array in that precision (a dtype of its own module), itself if it has it."""
    return array.astype(dtype, copy=False) if isinstance(array, np.ndarray) else array.to(dtype)


def detach(array: Array) -> Array:
    """The same values (of an array, or a number), as a constant for automatic differentiation."""
    return array.detach() if hasattr(array, "detach") else array


def to_numpy(array: Array) -> np.ndarray:
    """A tensor's values in an array of its own precision, on the CPU."""
    return array if isinstance(array, np.ndarray) else array.detach().cpu().numpy()


def like(values: np.ndarray, array: Array) -> Array:
    """NumPy values as an array of the kind, precision and device of ``array``."""
    if isinstance(array, np.ndarray):
        return values.astype(array.dtype)
    return module(array).as_tensor(values, dtype=array.dtype, device=array.device)


def planes(image: Array) -> Array:
    """(H, W, C) seen as (C, H, W)."""
    return module(image).moveaxis(image, -1, 0)


def image(planes: Array) -> Array:
    """(C, H, W) seen as (H, W, C)."""
    return module(planes).moveaxis(planes, 0, -1)


def over_colours(image: Array) -> Array:
    """(H, W, C) summed over C in double precision; channel by channel, ten times as fast as over an axis of three."""
    total = cast(image[..., 0], module(image).float64)
    for channel in range(1, image.shape[-1]):
        total = total + image[..., channel]
    return total


def empty(array: Array, *lead: int, channels_last: bool = False, dtype: Any = None) -> Array:
    """Uninitialised (*lead, H, W) for ``array`` (..., H, W); one leading axis may lie innermost in memory."""
    shape, dtype = (*array.shape[-2:], *lead) if channels_last else (*lead, *array.shape[-2:]), dtype or array.dtype
    new = np.empty(shape, dtype) if isinstance(array, np.ndarray) else array.new_empty(shape, dtype=dtype)
    return planes(new) if channels_last else new


def map_rows(function: Callable[[int, int], Any], *like: Array) -> list:
    """What ``function(first, last)`` returns for bands of rows first .. last - 1 of (..., H, W) arrays, top to bottom.

    NumPy: many bands, on all cores. torch: one.
    """
    height = like[0].shape[-2]
    if not isinstance(like[0], np.ndarray):
        return [function(0, height)]
    rows = max(1, BAND * height // max(1, sum(array.size for array in like)))

    return map_silent(lambda first: function(first, min(first + rows, height)), range(0, height, rows))


def map_silent(function: Callable[[Any], Any], parts: Iterable) -> list:
    """``map_parts`` without NumPy's warnings, which are silenced per thread; reconstruct() checks what comes out."""

    def silent(part: Any) -> Any:
        with np.errstate(all="ignore"):
            return function(part)

    return map_parts(silent, parts)


def by_rows(function: Callable[[int, int], tuple], *out: Array) -> tuple:
    """The arrays (..., H, W), shaped like ``out``, whose rows first .. last - 1 ``function(first, last)`` returns.

    What the function returns beyond these comes back as one last item, a list over the bands, from top to bottom.

    NumPy: computed band by band into ``out``, of which the function must read no rows but its own.
    torch: computed in one piece, and ``out`` is left alone, which keeps the computation differentiable.
    """
    if not isinstance(out[0], np.ndarray):
        values = function(0, out[0].shape[-2])
        return (*values[: len(out)], [values[len(out) :]])

    def band(first: int, last: int) -> tuple:
        values = function(first, last)
        for array, part in zip(out, values, strict=False):
            array[..., first:last, :] = part
        return values[len(out) :]

    return (*out, map_rows(band, *out))


def dct2(x: Array) -> Array:
    """Orthonormal cosine transform (type II) over the last two axes; a NumPy ``x`` is overwritten."""
    if isinstance(x, np.ndarray):
        return fft.dctn(x, axes=(-2, -1), norm="ortho", overwrite_x=True, workers=processors())
    return _dct(_dct(x).mT).mT


def idct2(x: Array) -> Array:
    """Inverse (and transpose) of ``dct2``."""
    if isinstance(x, np.ndarray):
        return fft.idctn(x, axes=(-2, -1), norm="ortho", overwrite_x=True, workers=processors())
    return _idct(_idct(x.mT).mT)


def _twiddle(n: int, x: Array) -> Array:
    """exp(-iπk/2n) for k up to n/2, with the factors that make the transform orthonormal."""
    k = np.arange(n // 2 + 1)
    values = np.exp(-0.5j * np.pi * k / n) * np.sqrt(2 / n)
    values[0] = np.sqrt(1 / n)
    torch = module(x)
    return torch.as_tensor(values, dtype=torch.complex128, device=x.device).to(
        torch.complex64 if x.dtype == torch.float32 else torch.complex128
    )


def _dct(x: Array) -> Array:
    """Type II along the last axis by one real FFT of the same length [Makhoul 1980, "A Fast Cosine Transform"]."""
    torch, n = module(x), x.shape[-1]
    spectrum = torch.fft.rfft(torch.cat([x[..., ::2], x[..., 1::2].flip(-1)], -1)) * _twiddle(n, x)
    # The other half of the real transform's spectrum is the conjugate of this one.
    return torch.cat([spectrum.real, -spectrum.imag[..., 1 : (n + 1) // 2].flip(-1)], -1)


def _idct(x: Array) -> Array:
    torch, n = module(x), x.shape[-1]
    real = x[..., : n // 2 + 1]
    mirrored = torch.cat([torch.zeros_like(x[..., :1]), x[..., (n + 1) // 2 :].flip(-1)], -1)
    # The twiddle factors have absolute value √(2/n) but the first, √(1/n): dividing by them is exact.
    even_odd = torch.fft.irfft(torch.complex(real, -mirrored) / _twiddle(n, x), n)
    half = (n + 1) // 2
    result = torch.stack([even_odd[..., :half], torch.nn.functional.pad(even_odd[..., half:].flip(-1), (0, n % 2))], -1)
    return result.flatten(-2)[..., :n]
