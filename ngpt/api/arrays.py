"""Reconstruction of images in memory: arrays of NumPy, PyTorch and Dr.Jit, and Mitsuba's bitmaps.

clean = ngpt.denoise(noisy, albedo=albedo, normal=normal)        # the same kind comes back
denoiser = ngpt.Denoiser(size, albedo=True, normals=True)        # or called as mi.OptixDenoiser is
clean = denoiser(noisy, albedo, normals, sensor.world_transform().inverse())
"""

import inspect
import os
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, TypeVar, overload

import numpy as np

from ngpt.api.tensors import Bitmap, Image, Kind, Tensor, TransformLike, is_bitmap, layer, like, to_numpy
from ngpt.errors import NgptError, did_you_mean
from ngpt.io.resolution import resolve
from ngpt.methods import METHODS, by_standing, reconstruct, unknown_method
from ngpt.options import Value
from ngpt.panorama import wrapping
from ngpt.sequence.history import Temporal
from ngpt.stack import GradientStack

T = TypeVar("T")

# Layers that methods read and Mitsuba's denoiser does not
_FURTHER = ("depth", "dx", "dy", "direct", "caustic", "primal_var", "dx_var", "dy_var", "caustic_var")
_BESIDE = ("albedo", "normal", *_FURTHER)
# Inputs of a Denoiser that must be announced to its constructor -> the keyword that announces them
_ANNOUNCED = {"albedo": "albedo", "normals": "normals", "flow": "temporal", "previous_denoised": "temporal"}
# From Mitsuba's sensor (+x left, +y up, +z forward) to the camera of the contract (+x right, +y up, +z backward).
_TO_CAMERA = np.array([-1, 1, -1], np.float32)


def methods_in_words() -> str:
    """The methods as text: their summaries, the layers that they need, and their options with defaults."""
    lines = []
    for name, method in by_standing("use", "niche").items():
        needs = f"needs {', '.join(layer for layer in method.needs if layer != 'primal') or 'only the image'}"
        needs += f"; uses {', '.join(method.uses)}" if method.uses else ""
        options = ", ".join(f"{name}={option.default!r}" for name, option in method.options.items())
        lines += [f"{name:<14}{method.summary}", f"{'':<14}{needs}", f"{'':<14}options: {options or 'none'}"]
    return "\n".join(f"    {line}" for line in lines)


def _with_methods(thing: T) -> T:
    """The ``thing``, with a list of all methods at the end of its docstring."""
    thing.__doc__ = f"{inspect.cleandoc(thing.__doc__ or '')}\n\nMethods:\n\n{methods_in_words()}"
    return thing


@overload
def denoise(image: GradientStack, method: str = "auto", **layers_and_options: Image | Value | None) -> np.ndarray: ...


@overload
def denoise(
    image: Kind,
    method: str = "auto",
    *,
    albedo: Image | None = None,
    normal: Image | None = None,
    depth: Image | None = None,
    dx: Image | None = None,
    dy: Image | None = None,
    direct: Image | None = None,
    caustic: Image | None = None,
    primal_var: Image | None = None,
    dx_var: Image | None = None,
    dy_var: Image | None = None,
    caustic_var: Image | None = None,
    wrap: bool = False,
    **options: Value,
) -> Kind: ...


@_with_methods  # type: ignore[misc]
def denoise(
    image: Image | GradientStack,
    method: str = "auto",
    *,
    albedo: Image | None = None,
    normal: Image | None = None,
    depth: Image | None = None,
    dx: Image | None = None,
    dy: Image | None = None,
    direct: Image | None = None,
    caustic: Image | None = None,
    primal_var: Image | None = None,
    dx_var: Image | None = None,
    dy_var: Image | None = None,
    caustic_var: Image | None = None,
    wrap: bool = False,
    **options: Value,
) -> Any:
    """Reconstructs a scene-linear image or stack.

    ``image``    (H, W, 3) or (H, W, 4), floats: an array of NumPy, PyTorch (any device), Dr.Jit, or a Mitsuba bitmap.
                 The result is of the same kind, type and shape; alpha is not changed. In a bitmap of many channels,
                 layers are found by their names, as in files; the result has only its colour and alpha. For a
                 ``GradientStack``, the result is (H, W, 3) float32.
    ``method``   a method below, or "auto": the best one for the given layers and the installed packages
    ``albedo``, ``normal``, ``depth``  features of the same size, in the units of ``GradientStack``: normals in camera
                 space, +x right, +y up, +z toward the viewer (``Denoiser`` converts Mitsuba's normals)
    ``dx``, ``dy``, ``direct``, ``caustic``, ``primal_var``, ``dx_var``, ``dy_var``, ``caustic_var``  further layers of
                 a gradient stack
    ``wrap``     whether the image is a panorama, whose left and right borders are neighbours. The header of a stack may
                 also mark it as a panorama (``ngpt:wrap`` or ``envmap``)

    All further keywords are options of the method, which are listed below. Raises NgptError for shapes and types that
    do not fit, for unknown names, if a layer that the method needs is missing, and for an image without any finite
    pixel.
    """
    keywords = dict(locals())
    given = {name: value for name, value in keywords.items() if name in _BESIDE and value is not None}
    _check_options("denoise", method, options, _BESIDE)
    if isinstance(image, str | os.PathLike):
        raise NgptError(f"denoise: image is the name of a file; pass ngpt.read({os.fspath(image)!r})")
    if isinstance(image, GradientStack):
        size = image.height, image.width
        stack = image.replace(**_layers("denoise", given, size)) if given else image
        return reconstruct(wrapping(stack) if wrap else stack, method, **options).image
    noisy: Any = image
    if is_bitmap(image) and _names(image):
        held = _by_name(image)
        given, noisy = held | given, held.pop("image")
        given.pop("image")
    pixels = layer("denoise", "image", noisy, (3, 4))
    layers = _layers("denoise", given, pixels.shape[:2])
    stack = _stack("denoise", pixels, layers, method, options)
    stack = wrapping(stack) if wrap else stack
    return like(_with_alpha(reconstruct(stack, method, **options).image, pixels), image)


@_with_methods
class Denoiser:
    """Reconstructs images of one size. It is called like ``mi.OptixDenoiser``.

    ``input_size``  (width, height) in pixels
    ``albedo``, ``normals``  whether each call gives these layers; layers that are not announced are refused
    ``temporal``    whether the calls are the frames of one shot, in order, with ``flow``: each result is blended with
                    the results before it (``ngpt.Temporal``)
    ``denoise_alpha``  whether an alpha channel is denoised too, as a grey image; otherwise it is not changed, and the
                    result has no light where alpha is 0 and ``noisy`` has no light
    ``method``      a method as for ``ngpt.denoise``; "auto" chooses one for the layers of each call

    All further keywords are options of the method. Raises NgptError for an unknown method, option or keyword.
    """

    def __init__(
        self,
        input_size: Sequence[int] | Tensor,
        albedo: bool = False,
        normals: bool = False,
        temporal: bool = False,
        denoise_alpha: bool = False,
        *,
        method: str = "auto",
        **options: Value,
    ):
        try:
            self.width, self.height = (int(n) for n in np.ravel(to_numpy(input_size)))
        except (TypeError, ValueError, NgptError):
            raise NgptError(f"Denoiser: input_size is {input_size!r}; it must be (width, height)") from None
        if method not in ("auto", *METHODS):
            raise unknown_method(method)
        _check_options("Denoiser", method, options, ())
        self.announced = {"albedo": albedo, "normals": normals, "temporal": temporal}
        self._temporal = Temporal() if temporal else None
        self.denoise_alpha, self.method, self.options = denoise_alpha, method, options

    @overload
    def __call__(
        self,
        noisy: Kind,
        albedo: Image | None = None,
        normals: Image | None = None,
        to_sensor: Tensor | TransformLike | None = None,
        flow: Image | None = None,
        previous_denoised: Image | None = None,
        **layers: Image,
    ) -> Kind: ...

    @overload
    def __call__(
        self,
        noisy: Bitmap,
        albedo_ch: str = "",
        normals_ch: str = "",
        to_sensor: Tensor | TransformLike | None = None,
        flow_ch: str = "",
        previous_denoised_ch: str = "",
        noisy_ch: str = "<root>",
        **layers: Image,
    ) -> Bitmap: ...

    # In the second form, the arguments are names of channels instead of arrays.
    def __call__(  # type: ignore[misc]
        self,
        noisy: Any,
        albedo: Any = None,
        normals: Any = None,
        to_sensor: Any = None,
        flow: Any = None,
        previous_denoised: Any = None,
        noisy_ch: str = "<root>",
        *,
        albedo_ch: str = "",
        normals_ch: str = "",
        flow_ch: str = "",
        previous_denoised_ch: str = "",
        **layers: Any,
    ) -> Any:
        """Reconstructs ``noisy``. The result has the same kind (array, tensor on a device, bitmap), type and shape.

        ``noisy``      (H, W, 3), or (H, W, 4) with alpha, scene-linear
        ``albedo``     (H, W, 3)
        ``normals``    (H, W, 3) in the space of Mitsuba's sensor (+x left, +y up, +z forward), or in another space
        ``to_sensor``  leads from that space to the sensor's: an array (3, 3) or (4, 4), or a transform with a
                       ``matrix``; for world space ``sensor.world_transform().inverse()``
        ``flow``       (H, W, 2) as OptiX defines it, the layer ``motion`` times -1: pixels to the right and down, from
                       the place of this point in the last frame to its place in this one; 0 where it is not known, NaN
                       where the point was not seen
        ``previous_denoised``  the last result; only needed if it was changed since then, or made elsewhere. If it is
                       ``noisy`` itself, as OptiX requires in a first frame, another shot (sequence of frames) begins
        ``layers``     ``dx``, ``dy``, ``depth``, ``direct``, ``caustic``, ``primal_var``, ``dx_var``, ``dy_var``,
                       ``caustic_var``: layers as in ``GradientStack``

        A bitmap may hold these layers as channels. Then the names of channels are given: ``denoiser(bitmap, "albedo",
        "normals", to_sensor)``, or ``albedo_ch="albedo"`` and so on. ``noisy_ch`` is the layer to denoise, by default
        the root.

        Raises NgptError for arrays of another size, for layers that were not announced, for announced layers that are
        missing, and as ``ngpt.denoise`` does.
        """
        if unknown := [name for name in layers if name not in _FURTHER]:
            meant = did_you_mean(unknown[0], _FURTHER)
            raise NgptError(f"Denoiser: no layer is called '{unknown[0]}'; {meant}there are: {', '.join(_FURTHER)}")
        given: dict[str, Any] = {"albedo": _first(albedo, albedo_ch), "normals": _first(normals, normals_ch)}
        given["flow"] = _first(flow, flow_ch)
        given["previous_denoised"] = _first(previous_denoised, previous_denoised_ch)
        for name, keyword in _ANNOUNCED.items():
            if given[name] is not None and not self.announced[keyword]:
                raise NgptError(f"Denoiser: {name} is given, but was not announced: Denoiser(size, {keyword}=True)")
            if given[name] is None and self.announced[keyword] and name != "previous_denoised":
                raise NgptError(
                    f"Denoiser: {keyword}=True announced {name}, which is not given: pass {name}=..., or leave it out"
                )
        image = noisy
        if is_bitmap(noisy):
            parts = dict(noisy.split()) if _names(noisy) else {"<root>": noisy}
            image = _part(parts, noisy_ch)
            given = {name: _part(parts, part) if isinstance(part, str) else part for name, part in given.items()}
        size = self.height, self.width
        pixels = layer("Denoiser", "noisy", image, (3, 4), size)
        previous = given.pop("previous_denoised")
        if previous is not None:
            previous = layer("Denoiser", "previous_denoised", previous, (3, 4), size)[..., :3]
        beside = {name: value for name, value in (given | layers).items() if value is not None}
        arrays = _layers("Denoiser", beside, size)
        if "normals" in arrays:
            # Normals that are not finite stay so here: ``repair`` replaces them, as it does in all layers.
            with np.errstate(invalid="ignore", over="ignore"):
                arrays["normal"] = (arrays.pop("normals") @ _rotation(to_sensor).T).astype(np.float32) * _TO_CAMERA
        if self._temporal is not None:
            arrays["motion"] = -arrays.pop("flow")
            if previous is not None and np.array_equal(previous, pixels[..., :3], equal_nan=True):
                del arrays["motion"]  # a cut
        # Noisy alpha is 0 in many pixels by chance, so such pixels must not count as empty.
        noisy_part = pixels[..., :3] if self.denoise_alpha else pixels
        stack = _stack("Denoiser", noisy_part, arrays, self.method, self.options)
        result = reconstruct(stack, self.method, **self.options).image
        if self._temporal is not None:
            result = self._temporal.next(stack, result, previous)
        result = _with_alpha(result, pixels)
        if self.denoise_alpha and pixels.shape[2] == 4:
            result = np.concatenate([result[..., :3], _alpha(pixels[..., 3:], arrays)], axis=-1)
        return like(result, noisy)


def _stack(
    where: str, image: np.ndarray, layers: Mapping[str, np.ndarray], method: str, options: Mapping[str, Any]
) -> GradientStack:
    """The image and its layers as a stack. Raises NgptError, which begins with ``where``, if the method needs more."""
    alpha = {"alpha": image[..., 3:]} if image.shape[2] > 3 else {}
    stack = GradientStack({"primal": image[..., :3], **alpha, **layers}, path=where)
    needs = METHODS[method].needs if method in METHODS and not options.get("weights") else ()
    if lacking := [name for name in needs if name not in stack]:
        arguments = ", ".join(f"{name}=..." for name in lacking)
        raise NgptError(f"{where}: method '{method}' needs {', '.join(lacking)}: pass {arguments}")
    return stack


def _with_alpha(result: np.ndarray, image: np.ndarray) -> np.ndarray:
    """The result (H, W, 3) with the alpha of ``image``, if it has any."""
    return np.concatenate([result, image[..., 3:]], axis=-1) if image.shape[2] > 3 else result


def _alpha(alpha: np.ndarray, layers: Mapping[str, np.ndarray]) -> np.ndarray:
    """Denoises coverage (H, W, 1) as a grey image. The result is clipped to the range of ``alpha``."""
    features = {name: layers[name] for name in ("albedo", "normal") if name in layers}
    grey = reconstruct(_stack("Denoiser: alpha", np.repeat(alpha, 3, axis=-1), features, "auto", {})).image
    return np.clip(grey[..., :1], alpha.min(), alpha.max())


def _layers(where: str, given: Mapping[str, Any], size: tuple[int, int]) -> dict[str, np.ndarray]:
    """The given layers as NumPy arrays of this (height, width)."""
    channels = {"depth": (1,), "flow": (2,)}
    return {name: layer(where, name, value, channels.get(name, (3,)), size) for name, value in given.items()}


def _check_options(where: str, method: str, options: Iterable[str], layers: tuple[str, ...]) -> None:
    """Raises NgptError for names that are not options of the method. The message may suggest one of the ``layers``."""
    entries = METHODS.values() if method == "auto" else [METHODS[method]] if method in METHODS else []
    known = list(dict.fromkeys(option for entry in entries for option in entry.options))
    for name in options if entries else ():
        if name not in known:
            meant = did_you_mean(name, [*known, *layers])
            beside = f"; layers: {', '.join(layers)}" if layers else ""
            names = ", ".join(known) or "none"
            raise NgptError(f"{where}: method '{method}' has no option '{name}'; {meant}options: {names}{beside}")


def _first(value: Any, channel: str) -> Any:
    """The ``value``, or else the name of a ``channel``; None for "" and for tensors without elements."""
    value = channel if value is None else value
    return None if (isinstance(value, str) and not value) or 0 in getattr(value, "shape", ()) else value


def _names(bitmap: Any) -> list[str]:
    """The names of the channels of a bitmap with many channels; none for a plain image."""
    many = bitmap.pixel_format() == type(bitmap.pixel_format()).MultiChannel
    return [field.name for field in bitmap.struct_()] if many else []


def _by_name(bitmap: Any) -> dict[str, np.ndarray]:
    """The layers of a bitmap with many channels, found by their names as in files; "image" is colour with alpha."""
    names, pixels, layers = _names(bitmap), to_numpy(bitmap, "denoise: image"), {}
    for name, found in resolve([("", names)], path="denoise: bitmap").items():
        layers[name] = pixels[..., [names.index(channel) for channel in found.channels]]
        if found.factors:
            layers[name] = layers[name] * np.asarray(found.factors, np.float32)
    image = layers.pop("primal"), layers.pop("alpha", pixels[..., :0])
    return {"image": np.concatenate(image, axis=-1), **layers}


def _part(parts: Mapping[str, Any], name: str) -> Any:
    """The layer of a bitmap by its name. Raises NgptError if there is none."""
    if name not in parts:
        raise NgptError(f"Denoiser: the bitmap has no layer '{name}'; it has: {', '.join(parts)}")
    return parts[name]


def _rotation(to_sensor: Any) -> np.ndarray:
    """The matrix (3, 3) for normals: the inverse transpose of a transform, scaled to determinant 1 or -1."""
    if to_sensor is None:
        return np.eye(3)
    matrix = to_numpy(getattr(to_sensor, "matrix", to_sensor), "Denoiser: to_sensor")
    if matrix.size not in (9, 16) or matrix.dtype.kind not in "fiu":
        raise NgptError(f"Denoiser: to_sensor is {matrix.shape} of {matrix.dtype}; it must be (3, 3) or (4, 4) numbers")
    side = 3 if matrix.size == 9 else 4
    turn = matrix.reshape(side, side)[:3, :3].astype(np.float64)
    volume = abs(np.linalg.det(turn)) if np.isfinite(turn).all() else np.nan
    if not 0 < volume < np.inf:
        raise NgptError(f"Denoiser: to_sensor has determinant {volume:.3g}; it must be a rotation, scaled at most")
    return np.linalg.inv(turn).T * np.cbrt(volume)
