"""Gradient stacks and results in OpenEXR files: `read` and `write`.

Images of other formats (``ngpt.io.foreign``) are read as if they were OpenEXR files with the same light.

Layers are found by the names of the contract or of other renderers (``ngpt.io.aliases``). All other contents of a file,
including unknown layers, are kept on writing, as ``ngpt.io.openexr`` describes.
"""

import logging
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ngpt.errors import NgptError
from ngpt.io import fine
from ngpt.io.aliases import is_image, writer_of
from ngpt.io.foreign.files import ENCODED, FROM, file_headers, read_file
from ngpt.io.isolated import read_exr_isolated
from ngpt.io.layout import StackSource, data_window, file_views, gather, is_half, place_of, scatter, taken
from ngpt.io.openexr import ExrImage, ExrPart, write_exr
from ngpt.io.primaries import converted, to_rec709
from ngpt.io.reduced import REDUCED, reduced
from ngpt.io.resolution import Found, Resolution, channels_like, resolve, resolve_alone
from ngpt.io.resolution import layers_of_light as find_light
from ngpt.io.results import MADE_BY, STRUCTURE, image_of, leave_out_old_error, new_header, replaced_layer, with_result
from ngpt.io.views import Part, View, choose_views, views_of
from ngpt.layers import LAYERS, RGB, XYZ, stored_channels
from ngpt.stack import GradientStack
from ngpt.system.reading import regular_file
from ngpt.system.threads import map_parts
from ngpt.version import __version__
from ngpt.windows import Place, put

_LOG = logging.getLogger(__name__)


def read(
    path: str | os.PathLike,
    layers: Mapping[str, str] | None = None,
    isolated: bool = False,
    files: Mapping[str, str | os.PathLike] | None = None,
    view: str | None = None,
) -> GradientStack:
    """Reads a gradient stack, or any render that contains an image.

    ``layers``    the names of layers in the file, by their names in the contract: {"albedo": "ViewLayer.Denoising
                  Albedo"}; or channels with signs and factors: {"motion": "-velocity.R,velocity.G"}. Layers that are
                  not named here are found by their usual names (``ngpt.io.aliases``)
    ``isolated``  whether to decode the file in a separate process: a hostile file that crashes the decoder then raises
                  NgptError (``ngpt.io.isolated``)
    ``files``     separate files by names of the contract, {"albedo": "albedo.exr"}, which replace layers of ``path``.
                  In a file of several layers, the one with a known name is read, or else the root
    ``view``      the name of a view of a stereo file (``ngpt.io.views``); None: the first

    Half and uint channels become float32. Unknown layers stay in ``stack.source`` and are written with the stack. The
    primal of a result file is its noisy input, so that a result can be reconstructed again. Colours stay in the
    primaries that the header names (``ngpt.io.primaries``). Light that is encoded for displays, as in PNG, becomes
    scene-linear (``ngpt.io.foreign.files``). A layer whose data window differs from the primal's is put onto the pixels
    of the primal, and is 0 outside its own window.

    Raises NgptError if the file cannot be read, holds no primal, or holds layers without a pixel in common with the
    primal; and if the size or place of a layer in ``files`` differs from the primal's.
    """
    image, subpixels = _opened(path, isolated)
    stack = _stack(image, _one_view(image, view, str(path)), layers, isolated, files, str(path))
    return _with_fine(stack, subpixels)


def read_views(
    path: str | os.PathLike,
    layers: Mapping[str, str] | None = None,
    isolated: bool = False,
    files: Mapping[str, str | os.PathLike] | None = None,
    view: str | None = None,
) -> list[GradientStack]:
    """Like ``read``, but returns a stack for each view, or for the named view; one stack for a file without views."""
    image, subpixels = _opened(path, isolated)
    found = choose_views(file_views(image), view, str(path))
    if len(found) == 1:
        return [_with_fine(_stack(image, found[0], layers, isolated, files, str(path)), subpixels)]
    return [_stack(image, one, layers, isolated, files, f"{path}, view {one.name}") for one in found]


def _opened(path: str | os.PathLike, isolated: bool) -> tuple[ExrImage, ExrPart | None]:
    """The contents of a file without its subpixels, and the part with the subpixels, None if it has none."""
    return fine.apart(read_exr_isolated(path) if isolated else read_file(path))


def _with_fine(stack: GradientStack, part: ExrPart | None) -> GradientStack:
    return stack if part is None else replace(stack, fine=fine.subpixels_of(part, stack))


def _one_view(image: ExrImage, wanted: str | None, path: str) -> View:
    """The view of that name, or the first; logs a warning if the file has others."""
    found = choose_views(file_views(image), wanted, path)
    if len(found) > 1:
        _LOG.warning("%s: has the views %s; %s is read", path, ", ".join(view.name for view in found), found[0].name)
    return found[0]


def _resolved(
    view: View, layers: Mapping[str, str] | None, attributes: Iterable[Mapping[str, Any]], path: str
) -> Resolution:
    """The places of the layers of a view in its file; ``attributes`` are the headers of the parts."""
    headers, wanted = list(attributes), {name: view.without(text) for name, text in (layers or {}).items()}
    origin = next((str(header["ngpt:pass"]) for header in headers if "ngpt:pass" in header), "")
    # In a result file, the input is in another layer than the one that it was first read from.
    if origin and f".{origin}".endswith(f".{wanted.get('primal')}"):
        del wanted["primal"]
    writer = writer_of(name for header in headers for name in header)
    return resolve(view.parts, wanted, path, writer, origin)


def _stack(
    image: ExrImage,
    view: View,
    layers: Mapping[str, str] | None,
    isolated: bool,
    files: Mapping[str, str | os.PathLike] | None,
    path: str,
) -> GradientStack:
    """The stack of one view of a file."""
    resolution = _resolved(view, layers, (part.header for part in image.parts), path)
    main = image.parts[resolution["primal"].part]
    if channels_like(resolution["primal"]) == XYZ:
        main.header.setdefault("colorInteropID", "lin_ciexyzd65_scene")  # Mitsuba's X Y Z are relative to D65
    here = data_window(main)
    for name, found in resolution.items():
        there = data_window(image.parts[found.part])
        if here.common(there) is None:
            raise NgptError(f"{path}: layer '{name}' is {there} but 'primal' {here}; render them in one picture")
    layers_found = map_parts(lambda found: taken(image, found, resolution["primal"].part), resolution.values())
    arrays = dict(zip(resolution, layers_found, strict=True))
    attributes = {name: value for name, value in main.header.items() if name not in STRUCTURE}
    stack = GradientStack(arrays, attributes, StackSource(image, resolution, view), path, place_of(main))
    separate = {name: _separate_layer(file, name, stack, main, isolated) for name, file in (files or {}).items()}
    places = ", ".join(f"{name} ({' '.join(found.channels)})" for name, found in resolution.items())
    _LOG.info("%s: %dx%d, %s", path, stack.width, stack.height, places)
    return stack.replace(**separate) if separate else stack


def layers_in(path: str | os.PathLike, layers: Mapping[str, str] | None = None) -> frozenset[str]:
    """The names of the layers that ``read`` would find, from the header of the file.

    Raises NgptError as ``read`` does for missing and ambiguous layers.
    """
    views, texts = _views_in(path)
    return frozenset(_resolved(views[0], layers, texts, str(path)))


def views_in(path: str | os.PathLike) -> list[View]:
    """The views of a file with the names of their layers, from its header. Raises NgptError if it is no image."""
    return _views_in(path)[0]


def _views_in(path: str | os.PathLike) -> tuple[list[View], list[dict[str, str]]]:
    """The views of a file, and the text attributes of its parts."""
    with regular_file(Path(path)) as file:
        headers = file_headers(file, str(path))
    headers = [part for i, part in enumerate(headers) if not (i and fine.is_fine(part.name, part.attributes))]
    parts = [Part(part.name, list(part.channels), part.text("view"), part.texts("multiView")) for part in headers]
    return views_of(parts), [{name: part.text(name) for name in part.attributes} for part in headers]


def _separate_layer(
    file: str | os.PathLike, name: str, stack: GradientStack, main: ExrPart, isolated: bool
) -> np.ndarray:
    """Layer ``name`` (H, W, C) from a separate file.

    Raises NgptError unless it has the size of the ``stack`` and the place of ``main``, the part with the primal.
    """
    if name not in LAYERS or name == "primal":
        raise NgptError(f"{file}: layer '{name}' cannot be read from a separate file")
    parts = (read_exr_isolated(file) if isolated else read_file(file)).parts
    if name != "albedo" and (kind := parts[0].header.get(FROM, "")).endswith(ENCODED):
        raise NgptError(f"{file}: {name} is not a colour to display, and this is {kind}; save it as .exr or .pfm")
    found = resolve_alone([(part.name, list(part.channels)) for part in parts], name, str(file))
    layer = gather(parts[found.part], found.channels)
    here, there = data_window(main), data_window(parts[found.part])
    if layer.shape[:2] != (stack.height, stack.width):
        size, expected = f"{layer.shape[1]}x{layer.shape[0]}", f"{stack.width}x{stack.height}"
        raise NgptError(f"{file}: {name} is {size} but {stack.path} is {expected}; render them at one size")
    if here != there:
        raise NgptError(
            f"{file}: {name} starts at pixel {there.corner} but {stack.path} at {here.corner}; crop them alike"
        )
    return layer


class Picture(NamedTuple):
    """The picture that a viewer shows for a file, (H, W, 3) float32, and its place."""

    pixels: np.ndarray
    place: Place


def read_image(path: str | os.PathLike, isolated: bool = False, view: str | None = None) -> np.ndarray:
    """Reads the picture that a viewer shows for a file, (H, W, 3) float32, as ``read_picture`` does."""
    return read_picture(path, isolated, view).pixels


def read_picture(path: str | os.PathLike, isolated: bool = False, view: str | None = None) -> Picture:
    """Reads the picture that a viewer shows: the root R G B of the first part.

    In a result file, this is the reconstruction; in a stack, the primal; in a file without a root image, the layer that
    ``read`` takes as the primal. The picture is converted to linear Rec. 709 (``ngpt.io.primaries``). ``isolated`` and
    ``view`` are as for ``read``.
    """
    image, _ = _opened(path, isolated)
    part, chosen = image.parts[0], _one_view(image, view, str(path))
    if view is None and all(name in part.channels for name in RGB):
        return Picture(converted(gather(part, RGB), to_rec709(part.header)), place_of(part))
    stack = _stack(image, chosen, None, isolated, None, str(path))
    # In a result file, the picture is the root beside the input.
    for place in (stack.source.resolution["primal"].part, chosen.first):
        like = channels_like(stack.source.resolution["primal"])
        part, root = image.parts[place], tuple(chosen.channel(place, name) for name in like)
        if all(name in part.channels for name in root):
            return Picture(converted(gather(part, root), to_rec709(part.header)), place_of(part))
    return Picture(converted(stack["primal"], to_rec709(stack.attributes)), stack.place)


def write(
    path: str | os.PathLike,
    image: np.ndarray | GradientStack | Sequence[np.ndarray],
    like: GradientStack | Sequence[GradientStack] | None = None,
    overwrite: bool = False,
    attributes: Mapping[str, Any] | None = None,
    into: str | None = None,
    *,
    reduce: int = 1,
) -> Path:
    """Writes a stack, a result or an image as OpenEXR, and returns its path.

    ``image``       a ``GradientStack``; or an image (H, W, 3), which is a result if ``like`` is given; or a list of the
                    results of all views of a file
    ``like``        the stack that the result was made from; or a list of the stacks of the views (``read_views``)
    ``attributes``  header attributes, which are added to those of the stack; for a result, ``Result.attributes``
    ``into``        the layer that a result replaces in addition to the root; "root" for no further layer
    ``reduce``      K: each K x K pixels of a result become one, by the rules of ``ngpt.io.reduced``

    A stack that was read from a file is written as that file, with its layers and attributes brought up to date. Any
    other stack becomes one scanline part at its ``place``, compressed with ZIP, with primal in the root R G B.
    Subpixels become one more part (``ngpt.io.fine``). An image without ``like`` is written as float R G B.

    A result is written as the file of its stack, with ``image`` in the root R G B of the first part, which viewers
    show, and with the input in primal.R/G/B. If the first part does not hold primal, or shows another layer in its
    root, it is not changed, and a new part goes in front. Alpha is copied into the root if the file has it elsewhere.
    By default, ``image`` also replaces the layer that the input was read from, such as ``ViewLayer.Combined``, and the
    attribute ``ngpt:pass`` names that layer. The layer is not replaced if its name says that it is noisy. If the stack
    is itself a result, its attributes on how it was made (``MADE_BY``) and its layer ``error`` are left out. A new
    layer ``error`` (``like=stack.replace(error=...)``) is written.

    Channels keep their type, half or float, and become float if half cannot hold the values (above 65504, or all below
    6.1e-5). Gradients, variances and depth are written as float.

    Raises NgptError if the file cannot be written, if it exists and ``overwrite`` is False, and for an image whose size
    differs from its stack's.
    """
    if structural := STRUCTURE & (attributes or {}).keys():
        raise NgptError(f"{path}: attribute '{min(structural)}' is OpenEXR's own; give it another name")
    if isinstance(image, GradientStack):
        if like is not None:
            raise NgptError(f"{path}: `like` goes with an image, not with a stack; pass one of the two")
        result, _, main = image_of(image, str(path))
        result.parts[main].header.update({**(attributes or {}), "ngpt:version": __version__})
        return write_exr(path, fine.with_subpixels(result, main, image), overwrite)
    if like is None:
        return write(path, GradientStack.from_arrays(path=str(path), primal=image), None, overwrite, attributes)
    if reduce != 1:
        attributes = {**(attributes or {}), REDUCED: reduce}
    pairs: list[tuple[Any, GradientStack]] = [(image, like)] if isinstance(like, GradientStack) else []
    pairs = pairs or list(zip(image, like, strict=True))  # type: ignore[arg-type]
    # The first view comes last: it may get a part in front of all others, which changes the numbers of their parts.
    pairs.sort(key=lambda pair: pair[1].source is None or pair[1].source.view.first == 0)
    if reduce != 1:
        pairs = [(one, replace(stack, fine={})) for one, stack in pairs]
    made: ExrImage | None = None
    for one, stack in pairs:
        pixels = GradientStack.from_arrays(path=str(path), primal=one)["primal"]
        if pixels.shape != stack["primal"].shape:
            sizes = f"{pixels.shape[1]}x{pixels.shape[0]} but the stack {stack.path} is {stack.width}x{stack.height}"
            raise NgptError(f"{path}: the result is {sizes}; results are written at the size of their stack")
        made = _result(stack, pixels, made, attributes or {}, into, str(path))
    assert made is not None
    if reduce != 1:
        made = reduced(made, reduce, [stack for _, stack in pairs])
    return write_exr(path, made, overwrite)


def layers_of_result(stack: GradientStack, into: str | None = None) -> tuple[list[str], list[str]]:
    """The layers that ``write`` replaces by a result, the root first; and layers named like images that stay noisy."""
    if stack.source is None:
        return ["root"], []
    origin, source = str(stack.attributes.get("ngpt:pass", "")), stack.source
    found = replaced_layer(source.resolution, source.view, origin, into, stack.path)
    written = ["root", found.name] if found else ["root"]
    images = [name for name in (source.resolution["primal"].name, *_light(stack)) if is_image(name)]
    return written, [name for name in images if name not in written]


def _result(
    stack: GradientStack,
    pixels: np.ndarray,
    base: ExrImage | None,
    attributes: Mapping[str, Any],
    into: str | None,
    path: str,
) -> ExrImage:
    """The file of a stack with ``pixels`` (H, W, 3) as its result. ``base`` has the results of other views, if any."""
    found, resolution, main = image_of(stack, path, base)
    leave_out_old_error(stack, found)
    view = stack.source.view if stack.source else file_views(found)[0]
    for name in MADE_BY:
        found.parts[main].header.pop(name, None)
    shown = replaced_layer(resolution, view, str(stack.attributes.get("ngpt:pass", "")), into, path)
    result, main = with_result(found, resolution, view, pixels, shown)
    result.parts[main].header.update({**attributes, "ngpt:version": __version__})
    return fine.with_subpixels(result, main, stack)


def with_channels(stack: GradientStack, channels: Mapping[str, np.ndarray]) -> GradientStack:
    """Returns the ``stack``, which must not come from a file, with further channels (H, W) for ``write``.

    Their names, such as ``diagnostics.discarded``, are outside the contract. ``pass_through`` returns these channels
    like the unknown channels of a file.
    """
    stack.require("primal", why="carrying further channels")
    part, found = ExrPart("", new_header(stack), {}), {}
    for name in stack.names:
        found[name] = Found(0, stored_channels(name), name)
        scatter(part, found[name].channels, stack[name], half=False)
    part.channels.update({name: np.ascontiguousarray(image, np.float32) for name, image in channels.items()})
    image = ExrImage([part])
    return replace(stack, source=StackSource(image, found, file_views(image)[0]))


def pass_through(stack: GradientStack) -> dict[str, np.ndarray]:
    """The channels of a stack's file that belong to no layer of the contract: name -> (H, W)."""
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
    """The channels of ``pass_through`` without those of ``layers_of_light``."""
    light = {id(part.channels[name]) for part, names in _light(stack).values() for name in names}
    return {name: channel for name, channel in pass_through(stack).items() if id(channel) not in light}


def layers_of_light(stack: GradientStack) -> dict[str, np.ndarray]:
    """The layers of colour in a stack's file that are not in the contract: name -> (H, W, 3) float32."""
    return {
        name: put(gather(part, names), data_window(part), stack.place.data)
        for name, (part, names) in _light(stack).items()
    }


def replace_layers_of_light(stack: GradientStack, layers: Mapping[str, np.ndarray]) -> GradientStack:
    """The stack with some of its ``layers_of_light`` replaced by ``layers``, (H, W, 3)."""
    image = ExrImage([replace(part, channels=dict(part.channels)) for part in stack.source.image.parts])
    changed = replace(stack, source=replace(stack.source, image=image))
    places = _light(changed)
    for name, values in layers.items():
        part, names = places[name]
        scatter(part, names, put(values, stack.place.data, data_window(part)), is_half(part, names))
    return changed


def _light(stack: GradientStack) -> dict[str, tuple[ExrPart, tuple[str, ...]]]:
    """The part and the channels of each of the ``layers_of_light``, by its name."""
    if stack.source is None:
        return {}
    parts = stack.source.image.parts
    found = find_light(stack.source.view.parts, stack.source.resolution)
    return {name: (parts[place.part], place.channels) for name, place in found.items()}
