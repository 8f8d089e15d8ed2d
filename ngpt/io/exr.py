"""Gradient stacks and results in OpenEXR files: `read` and `write`.

Layers go by their names, those of the contract or of other renderers (``ngpt.io.aliases``). All else that a file
holds, layers the toolkit does not know included, passes through as ``ngpt.io.openexr`` describes.
"""

import logging
import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import OpenEXR

from ngpt.errors import NgptError
from ngpt.io.aliases import Found, Resolution, resolve, resolve_alone
from ngpt.io.aliases import layers_of_light as find_light
from ngpt.io.header import read_headers
from ngpt.io.isolated import read_exr_isolated
from ngpt.io.openexr import ExrImage, ExrPart, read_exr, write_exr
from ngpt.io.primaries import converted, to_rec709
from ngpt.layers import LAYERS, RGB
from ngpt.stack import GradientStack
from ngpt.system.reading import regular_file
from ngpt.system.threads import map_parts
from ngpt.version import __version__
from ngpt.windows import Place, Window

_LOG = logging.getLogger(__name__)

__all__ = [
    "MADE_BY",
    "ExrImage",
    "ExrPart",
    "Picture",
    "StackSource",
    "channels_alone",
    "layers_in",
    "layers_of_light",
    "pass_through",
    "read",
    "read_exr",
    "read_image",
    "read_picture",
    "replace_layers_of_light",
    "with_channels",
    "write",
    "write_exr",
]

# Attributes that describe how a part is stored, rather than what it shows; a stack's attributes are all others.
_STRUCTURE = {"channels", "chunkCount", "compression", "dataWindow", "displayWindow", "lineOrder", "name"} | {
    "pixelAspectRatio", "screenWindowCenter", "screenWindowWidth", "tiles", "type"
}  # fmt: skip
# Attributes that say what made a result; those of the stack are others, and stay.
MADE_BY = (
    "ngpt:method",
    "ngpt:weights",
    "ngpt:options",
    "ngpt:estimated",
    "ngpt:reconstructSeconds",
    "ngpt:temporal",
    "ngpt:history",
    "ngpt:historyWeights",
)
_HALF_MAX = 65504.0
_HALF_NORMAL_MIN = 2.0**-14
_ROWS = 16  # that are gathered at a time


@dataclass(frozen=True)
class StackSource:
    """The file a stack was read from, and where in it the layers are."""

    image: ExrImage
    resolution: Resolution


def read(
    path: str | os.PathLike,
    layers: Mapping[str, str] | None = None,
    isolated: bool = False,
    files: Mapping[str, str | os.PathLike] | None = None,
) -> GradientStack:
    """Reads a gradient stack, or any render with an image in it.

    Layers are found by their names in the contract or in other renderers (``ngpt.io.aliases``). ``layers`` maps names
    of the contract to names in the file: ``{"albedo": "ViewLayer.Denoising Albedo"}``. Half and uint channels are
    converted to float32; layers the toolkit does not know stay in ``stack.source`` and come back on writing. In a
    result file primal is the kept input, so that reconstructing a result gives the result again.

    ``files`` maps names of the contract to files of their own, ``{"albedo": "albedo.exr"}``, which win over layers of
    that name in ``path``. Of several layers in such a file the one of a known name counts, else its root.

    ``isolated`` decodes the file in a process of its own, so that one made to crash the decoder is an NgptError too:
    for files of strangers (``ngpt.io.isolated``).

    Colours stay in the primaries of the file, which its header attribute ``chromaticities`` names.

    Raises NgptError if the file cannot be read, holds no primal, or holds layers of different size or place; and for
    such a file of a layer.
    """
    image = read_exr_isolated(path) if isolated else read_exr(path)
    ours = any("ngpt:sampler" in part.header for part in image.parts)
    resolution = resolve([(part.name, list(part.channels)) for part in image.parts], layers, str(path), ours)
    layers_found = map_parts(lambda found: _gather(image.parts[found.part], found.channels), resolution.values())
    arrays = dict(zip(resolution, layers_found, strict=True))
    main = image.parts[resolution["primal"].part]
    attributes = {name: value for name, value in main.header.items() if name not in _STRUCTURE}
    stack = GradientStack(arrays, attributes, StackSource(image, resolution), str(path), _place(main))
    for name, found in resolution.items():
        here, there = main.header["dataWindow"], image.parts[found.part].header["dataWindow"]
        if not np.array_equal(here, there):
            raise NgptError(
                f"{path}: layer '{name}' starts at pixel {_corner(there)} but 'primal' at {_corner(here)}; "
                "render them with one data window"
            )
    alone = {name: _read_alone(file, name, stack, main, isolated) for name, file in (files or {}).items()}
    told = ", ".join(f"{name} ({' '.join(found.channels)})" for name, found in resolution.items())
    _LOG.info("%s: %dx%d, %s", path, stack.width, stack.height, told)
    return stack.replace(**alone) if alone else stack


def layers_in(path: str | os.PathLike, layers: Mapping[str, str] | None = None) -> frozenset[str]:
    """The names of the layers that ``read`` would find, by the file's header; raises NgptError as it does for that."""
    with regular_file(Path(path)) as file:
        parts = [(part.name, list(part.channels)) for part in read_headers(file, str(path))]
    return frozenset(resolve(parts, layers, str(path)))


def _read_alone(file: str | os.PathLike, name: str, stack: GradientStack, main: ExrPart, isolated: bool) -> np.ndarray:
    """Layer ``name`` (H, W, C) of a file of its own, of the size and place of ``main``, the part that holds primal."""
    if name not in LAYERS or name == "primal":
        raise NgptError(f"{file}: layer '{name}' cannot come from a file of its own")
    parts = (read_exr_isolated(file) if isolated else read_exr(file)).parts
    found = resolve_alone([(part.name, list(part.channels)) for part in parts], name, str(file))
    layer = _gather(parts[found.part], found.channels)
    if layer.shape[:2] != (stack.height, stack.width):
        raise NgptError(
            f"{file}: {name} is {layer.shape[1]}x{layer.shape[0]} but {stack.path} is {stack.width}x{stack.height}; "
            "render them at one size"
        )
    here, there = main.header["dataWindow"], parts[found.part].header["dataWindow"]
    if not np.array_equal(here, there):
        raise NgptError(
            f"{file}: {name} starts at pixel {_corner(there)} but {stack.path} at {_corner(here)}; "
            "render them with one data window"
        )
    return layer


class Picture(NamedTuple):
    """What a viewer shows of a file, (H, W, 3) float32, and where it lies."""

    pixels: np.ndarray
    place: Place


def read_image(path: str | os.PathLike, isolated: bool = False) -> np.ndarray:
    """Reads what a viewer would show of a file, (H, W, 3) float32: the pixels of ``read_picture``."""
    return read_picture(path, isolated).pixels


def read_picture(path: str | os.PathLike, isolated: bool = False) -> Picture:
    """Reads the picture that a viewer would show: the root R G B of the first part.

    That is the reconstruction in a result file and the primal in a stack; in a file without a root image, it is what
    ``read`` takes for the primal. Unlike there, light of other primaries is converted to linear Rec. 709
    (``ngpt.io.primaries``): pictures are looked at and compared.
    """
    part = (read_exr_isolated(path) if isolated else read_exr(path)).parts[0]
    if all(name in part.channels for name in RGB):
        return Picture(converted(_gather(part, RGB), to_rec709(part.header)), _place(part))
    stack = read(path, isolated=isolated)
    return Picture(converted(stack["primal"], to_rec709(stack.attributes)), stack.place)


def write(
    path: str | os.PathLike,
    image: np.ndarray | GradientStack,
    like: GradientStack | None = None,
    overwrite: bool = False,
    attributes: Mapping[str, Any] | None = None,
) -> Path:
    """Writes a stack, a result or an image, and returns its path.

    A stack is written as the file it was read from with its layers and attributes brought up to date (they are never
    removed), or else as one scanline part at its ``place``, compressed with ZIP, primal in the root R G B.

    A result, ``image`` (H, W, 3) with ``like`` the stack it was made of, is that file with ``image`` in the root R G B
    of its first part, which is what viewers show, and the input in primal.R/G/B. Should the first part be another than
    the one that holds primal, or show something else in its root, then it stays as it is and a new part goes in front.
    Alpha is copied into the root if the file has it elsewhere.

    Channels keep their type, half or float, and become float where half cannot hold the values (above 65504, or all
    below 6.1e-5). Gradients, variances and depth are written as float. An ``image`` alone is written as float R G B.

    ``attributes`` go into the header beside those of the stack: ``Result.attributes`` say what made a result. What a
    stack that is itself a result says of its own making (``MADE_BY``) is left out of the new result, and so is the
    layer ``error`` that was read with it. One that was put in its place (``like=stack.replace(error=...)``) is written.
    """
    if structural := _STRUCTURE & (attributes or {}).keys():
        raise NgptError(f"{path}: attribute '{min(structural)}' is OpenEXR's own; give it another name")
    if isinstance(image, GradientStack):
        if like is not None:
            raise NgptError(f"{path}: `like` goes with an image, not with a stack; pass one of the two")
        result, _, main = _image_of(image, str(path))
    elif like is not None:
        pixels = GradientStack.from_arrays(path=str(path), primal=image)["primal"]
        if pixels.shape != like["primal"].shape:
            raise NgptError(
                f"{path}: the result is {pixels.shape[1]}x{pixels.shape[0]} but the stack {like.path} is "
                f"{like.width}x{like.height}; results are written at the size of their stack"
            )
        found, resolution, _ = _image_of(like, str(path))
        _leave_out_old_error(like, found)
        result, main = _with_result(found, resolution, pixels), 0
        for name in MADE_BY:
            result.parts[0].header.pop(name, None)
    else:
        result, _, main = _image_of(GradientStack.from_arrays(path=str(path), primal=image), str(path))
    result.parts[main].header.update({**(attributes or {}), "ngpt:version": __version__})
    return write_exr(path, result, overwrite)


def with_channels(stack: GradientStack, channels: Mapping[str, np.ndarray]) -> GradientStack:
    """Returns a stack that was made, not read, with further channels, (H, W) each, to be written beside its layers.

    They go by names outside the contract, ``diagnostics.discarded`` for one, and are carried along as such channels of
    a file are. ``pass_through`` reads them.
    """
    stack.require("primal", why="carrying further channels")
    part, found = ExrPart("", _new_header(stack), {}), {}
    for name in stack.names:
        prefix = "" if name in ("primal", "alpha") else f"{name}."
        found[name] = Found(0, tuple(prefix + suffix for suffix in LAYERS[name].channels), name)
        _scatter(part, found[name].channels, stack[name], half=False)
    part.channels.update({name: np.ascontiguousarray(image, np.float32) for name, image in channels.items()})
    return replace(stack, source=StackSource(ExrImage([part]), found))


def pass_through(stack: GradientStack) -> dict[str, np.ndarray]:
    """The channels that a stack carries along beside the layers of the contract: name -> (H, W), as in the file."""
    if stack.source is None:
        return {}
    known = {(found.part, channel) for found in stack.source.resolution.values() for channel in found.channels}
    return {
        name: channel
        for i, part in enumerate(stack.source.image.parts)
        for name, channel in part.channels.items()
        if (i, name) not in known
    }


def channels_alone(stack: GradientStack) -> dict[str, np.ndarray]:
    """Of what ``pass_through`` gives, the channels that are in none of the ``layers_of_light``."""
    light = {id(part.channels[name]) for part, names in _light(stack).values() for name in names}
    return {name: channel for name, channel in pass_through(stack).items() if id(channel) not in light}


def layers_of_light(stack: GradientStack) -> dict[str, np.ndarray]:
    """The layers of colour that a stack carries along beside those of the contract: name -> (H, W, 3) float32."""
    return {name: _gather(part, names) for name, (part, names) in _light(stack).items()}


def replace_layers_of_light(stack: GradientStack, layers: Mapping[str, np.ndarray]) -> GradientStack:
    """The stack with others in place of some of its ``layers_of_light``, (H, W, 3), of the type they have there."""
    image = ExrImage([replace(part, channels=dict(part.channels)) for part in stack.source.image.parts])
    changed = replace(stack, source=StackSource(image, stack.source.resolution))
    places = _light(changed)
    for name, values in layers.items():
        part, names = places[name]
        _scatter(part, names, values, _is_half(part, names))
    return changed


def _light(stack: GradientStack) -> dict[str, tuple[ExrPart, tuple[str, ...]]]:
    """Where they are."""
    if stack.source is None:
        return {}
    parts = stack.source.image.parts
    found = find_light([(part.name, list(part.channels)) for part in parts], stack.source.resolution)
    return {name: (parts[place.part], place.channels) for name, place in found.items()}


def _gather(part: ExrPart, names: tuple[str, ...]) -> np.ndarray:
    """Returns the channels ``names`` as one array (H, W, C) float32."""
    channels = [part.channels[name] for name in names]
    layer = np.empty((*channels[0].shape, len(channels)), np.float32)
    # Some rows at a time: what one channel wrote is then in the cache when the next comes between it.
    for top in range(0, len(layer), _ROWS):
        rows = slice(top, top + _ROWS)
        for index, channel in enumerate(channels):
            layer[rows, :, index] = channel[rows]
    return layer


def _holds(part: ExrPart, names: tuple[str, ...], values: np.ndarray) -> bool:
    """Whether the channels ``names`` are ``values`` (H, W, C), of those that are float32 bit for bit."""
    if values.dtype != np.float32:
        return False
    return values.shape[:2] == part.channels[names[0]].shape and all(
        np.array_equal(part.channels[name].astype(np.float32, copy=False).view(np.uint32), bits)
        for name, bits in zip(names, np.moveaxis(values.view(np.uint32), -1, 0), strict=True)
    )


def _image_of(stack: GradientStack, path: str) -> tuple[ExrImage, Resolution, int]:
    """Returns the stack as a file, where the layers are in it, and the index of the part that has the attributes."""
    if stack.source is None:
        stack.require("primal", why=f"writing {path}")
        image, resolution, main = ExrImage([ExrPart("", _new_header(stack), {})]), {}, 0
    else:
        image = ExrImage([replace(part, channels=dict(part.channels)) for part in stack.source.image.parts])
        resolution = dict(stack.source.resolution)
        main = resolution["primal"].part
        size = next(iter(image.parts[main].channels.values())).shape
        if (stack.height, stack.width) != size:
            raise NgptError(
                f"{path}: the stack is {stack.width}x{stack.height} but {stack.path}, which it was read from, is "
                f"{size[1]}x{size[0]}; make a new stack of its layers with GradientStack.from_arrays"
            )
    header = {name: value for name, value in image.parts[main].header.items() if name in _STRUCTURE}
    image.parts[main] = replace(image.parts[main], header={**header, **stack.attributes})
    found = {name: (image.parts[resolution[name].part], resolution[name].channels) for name in resolution}
    known = [name for name in stack.names if name in resolution]
    unchanged = dict(zip(known, map_parts(lambda name: _holds(*found[name], stack[name]), known), strict=True))
    for name in stack.names:
        values, half = stack[name], False
        if unchanged.get(name):
            continue
        if name in resolution:
            part, names = found[name]
            half = _is_half(part, names) and not LAYERS[name].float_on_disk
        else:
            prefix = "" if name in ("primal", "alpha") else f"{name}."
            part, names = image.parts[main], tuple(prefix + suffix for suffix in LAYERS[name].channels)
            resolution[name] = Found(main, names, name)
        _scatter(part, names, values, half)
    return image, resolution, main


def _leave_out_old_error(stack: GradientStack, image: ExrImage) -> None:
    """Removes the layer ``error`` that came with the file of a stack: it is that of an earlier result."""
    place = stack.source.resolution.get("error") if stack.source else None
    if place and "error" in stack and _holds(stack.source.image.parts[place.part], place.channels, stack["error"]):
        for channel in place.channels:
            image.parts[place.part].channels.pop(channel, None)


def _with_result(image: ExrImage, resolution: Resolution, pixels: np.ndarray) -> ExrImage:
    """Returns the file with ``pixels`` (H, W, 3) float32 as the root of its first part, the input as primal.R/G/B."""
    primal, alpha = resolution["primal"], resolution.get("alpha")
    source, parts = image.parts[primal.part], image.parts
    root, kept = ("R", "G", "B"), ("primal.R", "primal.G", "primal.B")
    shows_another = primal.channels not in (root, kept) and any(name in source.channels for name in root)
    if primal.part != 0 or shows_another:
        parts = [part if part.name else replace(part, name="source") for part in parts]
        name = "ngpt"
        while any(part.name == name for part in parts):
            name += " result"
        header = {key: value for key, value in source.header.items() if key not in ("channels", "lineOrder", "tiles")}
        header |= {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, "name": name}
        parts = [ExrPart(name, header, {}), *parts]
    channels = parts[0].channels
    half = _is_half(source, primal.channels)
    channels.update(zip(kept, [source.channels[name] for name in primal.channels], strict=True))
    if alpha:
        channels.setdefault("A", image.parts[alpha.part].channels[alpha.channels[0]])
    _scatter(parts[0], root, pixels, half)
    return ExrImage(parts)


def _scatter(part: ExrPart, names: tuple[str, ...], values: np.ndarray, half: bool) -> None:
    """Puts ``values`` (H, W, C) into the channels ``names``: as half if asked to and half can hold them, else float."""
    if half:
        peak = np.abs(values[np.isfinite(values)]).max(initial=0.0)
        half = peak <= _HALF_MAX and not 0.0 < peak < _HALF_NORMAL_MIN
    # Variances in double precision may be beyond floats: they are infinite in files, which counts as not known.
    with np.errstate(over="ignore"):
        for index, name in enumerate(names):
            part.channels[name] = np.ascontiguousarray(values[..., index], dtype=np.float16 if half else np.float32)


def _is_half(part: ExrPart, names: tuple[str, ...]) -> bool:
    return all(part.channels[name].dtype == np.float16 for name in names)


def _place(part: ExrPart) -> Place:
    return Place(Window.of_box(part.header["dataWindow"]), Window.of_box(part.header["displayWindow"]))


def _new_header(stack: GradientStack) -> dict[str, Any]:
    """Of the part that a stack is written to which comes from no file."""
    windows = {"dataWindow": stack.place.data.box, "displayWindow": stack.place.display.box}
    return {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage} | windows


def _corner(window: tuple[np.ndarray, np.ndarray]) -> str:
    return f"({window[0][0]}, {window[0][1]})"
