"""Converts arrays of NumPy, PyTorch, Dr.Jit and others, and Mitsuba's bitmaps, to NumPy, and results back.

No library is imported here: arrays are recognised by their methods.
"""

import sys
from collections.abc import Collection
from typing import Any, Protocol, TypeVar

import numpy as np

from ngpt.errors import NgptError

# The number of channels of colour, albedo and normal. A tensor with at least as many may come from an integrator.
_OF_A_STACK = 9


class Tensor(Protocol):
    """An array (H, W, C) of any library: NumPy, PyTorch, Dr.Jit, JAX."""

    @property
    def shape(self) -> tuple[int, ...]: ...


class Bitmap(Protocol):
    def pixel_format(self) -> Any: ...

    def component_format(self) -> Any: ...


class TransformLike(Protocol):
    @property
    def matrix(self) -> Any: ...


Image = Tensor | Bitmap
Kind = TypeVar("Kind", bound=Image)  # the kind of an input and its result


def is_bitmap(value: Any) -> bool:
    return hasattr(value, "pixel_format") and hasattr(value, "component_format")


def to_numpy(value: Any, name: str = "the array") -> np.ndarray:
    """An array of any library, on any device, as a NumPy array that shares its memory if possible.

    Raises NgptError, whose message begins with ``name``, for objects that NumPy cannot read, for bitmaps that are not
    linear, and for tensors that carry gradients, which would be lost.
    """
    if isinstance(value, np.ndarray):
        return value
    if detached := _detached(value, name.rpartition(" ")[2]):
        raise NgptError(f"{name} carries gradients, which no method passes on; pass {detached} (docs/use/python.md)")
    if is_bitmap(value) and value.srgb_gamma():
        raise NgptError(f"{name} is a bitmap with the curve of displays; pass bitmap.convert(srgb_gamma=False)")
    try:
        if hasattr(value, "detach"):  # PyTorch
            value = value.detach().cpu()
            return (value.float() if str(value.dtype) == "torch.bfloat16" else value).numpy()
        if hasattr(value, "numpy"):  # Dr.Jit
            return value.numpy()
        array = np.asarray(value)
        if array.dtype == object and hasattr(value, "__dlpack__"):
            array = np.from_dlpack(value)
    except (TypeError, ValueError, BufferError, RuntimeError) as error:
        why = " ".join(str(error).split())
        raise NgptError(f"{name} is a {type(value).__name__} that NumPy cannot read: {why}; pass an array") from error
    return array.astype(np.float32) if array.dtype.name == "bfloat16" else array


def _detached(value: Any, name: str) -> str:
    """The code that detaches ``value``, called ``name``, from its gradients; "" if it carries none."""
    torch = sys.modules.get("torch")
    if torch is not None and isinstance(value, torch.Tensor):
        return f"{name}.detach()" if value.requires_grad and torch.is_grad_enabled() else ""
    of_drjit = type(value).__module__.startswith("drjit")
    return f"drjit.detach({name})" if of_drjit and sys.modules["drjit"].grad_enabled(value) else ""


def like(image: np.ndarray, example: Any) -> Any:
    """The image (H, W, C) as an object of the same library, device and number type as ``example``.

    If the example is a bitmap, the result is an RGB or RGBA bitmap. If it is of an unknown kind, the result is a NumPy
    array.
    """
    if isinstance(example, np.ndarray):
        return _of_type(image, example.dtype) if example.dtype.kind == "f" else image
    if is_bitmap(example):
        kinds = type(example.pixel_format())
        kind = kinds.RGB if image.shape[2] == 3 else kinds.RGBA
        pixels = _of_type(image, np.asarray(example).dtype)
        return type(example)(np.ascontiguousarray(pixels), pixel_format=kind)
    if hasattr(example, "new_tensor"):  # PyTorch
        half = str(example.dtype) == "torch.float16"
        return example.new_tensor(_of_type(image, np.dtype(np.float16)) if half else image)
    if hasattr(example, "__array_namespace__"):
        return example.__array_namespace__().asarray(image, dtype=example.dtype)
    if type(example).__module__.startswith("drjit"):
        return type(example)(np.ascontiguousarray(image, np.float32))
    return image


def _of_type(image: np.ndarray, dtype: np.dtype) -> np.ndarray:
    """The image in another type of floats. Values beyond the range of half floats are clipped to stay finite."""
    limits = np.finfo(dtype)
    return (np.clip(image, limits.min, limits.max) if dtype.itemsize == 2 else image).astype(dtype)


def layer(
    where: str, name: str, value: Any, channels: Collection[int], size: tuple[int, int] | None = None
) -> np.ndarray:
    """The ``value`` as a NumPy array (H, W, C) of floats, where C is one of ``channels``.

    ``size``  the required (height, width); None for any

    Raises NgptError, whose message begins with ``where``, for other shapes, images without pixels, and integers.
    """
    array = to_numpy(value, f"{where}: {name}")
    array = array[..., None] if array.ndim == 2 and 1 in channels else array
    fits = array.ndim == 3 and array.shape[2] in channels and (size is None or array.shape[:2] == size)
    if not fits:
        rows, columns = size or ("height", "width")
        wanted = " or ".join(f"({rows}, {columns}, {n})" for n in channels)
        remedy = _remedy(name, value, array.shape, channels)
        raise NgptError(f"{where}: {name} has shape {tuple(array.shape)}; it must be {wanted}{remedy}")
    if array.size == 0:
        raise NgptError(f"{where}: {name} is {array.shape[1]}x{array.shape[0]}; it has no pixels to work on")
    if array.dtype.kind in "iu":
        raise NgptError(f"{where}: {name} is of type {array.dtype}; pass scene-linear floats, not integers")
    return array


def _remedy(name: str, value: Any, shape: tuple[int, ...], channels: Collection[int]) -> str:
    """The end of a message about a wrong shape, with the array to pass instead; "" if that is not clear."""
    if len(shape) == 3 and shape[0] in channels and shape[2] not in channels:
        turn = "permute" if hasattr(value, "permute") else "transpose"
        return f"; channels come first there: pass {name}.{turn}(1, 2, 0)"
    if len(shape) == 4:
        return f"; pass the images of a batch one by one: {name}[0]"
    if len(shape) == 3 and shape[2] >= _OF_A_STACK and name in ("image", "noisy"):
        return (
            f"; if it has the layers of one of our integrators, pass "
            f"ngpt.GradientStack.from_aovs({name}, scene.integrator().aov_names()), and for its colour alone "
            f"{name}[..., :3]"
        )
    if len(shape) == 3 and shape[2] > max(channels):
        return f"; pass {name}[..., :{max(channels)}]"
    if 3 in channels and (len(shape) == 2 or shape[2:] == (1,)):
        grey = name if len(shape) == 3 else f"{name}[..., None]"
        return f"; an image of one channel is {grey}.repeat(3, axis=-1)"
    return ""
