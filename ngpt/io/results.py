"""Makes the contents of files from stacks and results: the file of a stack, with changed layers and a result."""

from dataclasses import replace
from typing import Any

import numpy as np
import OpenEXR

from ngpt.errors import NgptError
from ngpt.io.layout import as_stored, data_window, holds, is_half, scatter, taken
from ngpt.io.openexr import ExrImage, ExrPart
from ngpt.io.resolution import Found, Resolution, channels_like, layers_of_light
from ngpt.io.views import View
from ngpt.layers import LAYERS, stored_channels
from ngpt.stack import GradientStack
from ngpt.system.threads import map_parts
from ngpt.windows import put

# Attributes about the storage of a part; all others are attributes of the stack.
STRUCTURE = {"channels", "chunkCount", "compression", "dataWindow", "displayWindow", "lineOrder", "name"} | {
    "pixelAspectRatio", "screenWindowCenter", "screenWindowWidth", "tiles", "type"
}  # fmt: skip
# Attributes about the making of a result; a new result does not take them from its stack.
MADE_BY = (
    *("ngpt:method", "ngpt:weights", "ngpt:options", "ngpt:estimated", "ngpt:reconstructSeconds"),
    *("ngpt:temporal", "ngpt:history", "ngpt:historyWeights", "ngpt:pass", "ngpt:reduced"),
)
# A layer with this word in its name is not replaced by a result, because nobody takes it for the final image.
_NOISY = "noisy"


def image_of(stack: GradientStack, path: str, base: ExrImage | None = None) -> tuple[ExrImage, Resolution, int]:
    """The stack as a file, the places of its layers there, and the index of the part with its attributes.

    ``base`` is the file with the results of other views, if there are any. Raises NgptError if the stack does not have
    the size of the file that it was read from.
    """
    if stack.source is None:
        stack.require("primal", why=f"writing {path}")
        image, resolution, main = ExrImage([ExrPart("", new_header(stack), {})]), {}, 0
    else:
        own = stack.source.image.parts
        image = ExrImage([replace(part, channels=dict(part.channels)) for part in (base.parts if base else own)])
        # ``base`` lacks changes to this view, such as those of its light groups.
        for part, source, (_, channels) in zip(image.parts, own, stack.source.view.parts, strict=False):
            part.channels.update({name: source.channels[name] for name in channels.values() if base})
        resolution = dict(stack.source.resolution)
        main = resolution["primal"].part
        size = next(iter(image.parts[main].channels.values())).shape
        if (stack.height, stack.width) != size:
            raise NgptError(
                f"{path}: the stack is {stack.width}x{stack.height} but {stack.path}, which it was read from, is "
                f"{size[1]}x{size[0]}; make a new stack of its layers with GradientStack.from_arrays"
            )
    header = {name: value for name, value in image.parts[main].header.items() if name in STRUCTURE}
    image.parts[main] = replace(image.parts[main], header={**header, **stack.attributes})
    known = [name for name in stack.names if name in resolution]

    def is_unchanged(name: str) -> bool:
        found = resolution[name]
        if as_stored(image, found, main):
            return holds(image.parts[found.part], found.channels, stack[name])
        return np.array_equal(taken(image, found, main), stack[name], equal_nan=True)

    unchanged = dict(zip(known, map_parts(is_unchanged, known), strict=True))
    for name in stack.names:
        values, half = stack[name], False
        if unchanged.get(name):
            continue
        # Channels in another renderer's units, or on other pixels, are not changed, and ours are added beside them.
        if name in resolution and as_stored(image, resolution[name], main):
            part, names = image.parts[resolution[name].part], resolution[name].channels
            half = is_half(part, names) and not LAYERS[name].float_on_disk
        else:
            part, names = image.parts[main], stored_channels(name)
            if stack.source is not None:
                names = tuple(stack.source.view.channel(main, channel) for channel in names)
            resolution[name] = Found(main, names, name)
        scatter(part, names, values, half)
    return image, resolution, main


def new_header(stack: GradientStack) -> dict[str, Any]:
    """The header of the part for a stack that was not read from a file."""
    windows = {"dataWindow": stack.place.data.box, "displayWindow": stack.place.display.box}
    aspect = {} if stack.place.aspect == 1 else {"pixelAspectRatio": stack.place.aspect}
    return {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage} | windows | aspect


def leave_out_old_error(stack: GradientStack, image: ExrImage) -> None:
    """Removes the layer ``error`` from the file of a stack if the stack still has it: an earlier result made it."""
    place = stack.source.resolution.get("error") if stack.source else None
    if place and "error" in stack and holds(stack.source.image.parts[place.part], place.channels, stack["error"]):
        for channel in place.channels:
            image.parts[place.part].channels.pop(channel, None)


def replaced_layer(resolution: Resolution, view: View, origin: str, into: str | None, path: str) -> Found | None:
    """The layer that a result replaces in addition to the root, for users who load that layer; None for no layer.

    ``into``    its name, whole or the end after a dot; "root" for no layer; None for the layer of the input, unless
                "noisy" is in its name
    ``origin``  the name of the layer of the input, if an earlier result has moved the input

    Raises NgptError unless ``into`` fits exactly one layer of colour.
    """
    primal, others = resolution["primal"], layers_of_light(view.parts, resolution)
    names = channels_like(primal)
    root, kept = (tuple(view.channel(view.first, start + c) for c in names) for start in ("", "primal."))
    moved = primal.part == view.first and primal.channels == kept
    own = {} if moved or (primal.part, primal.channels) == (view.first, root) else {primal.name: primal}
    if into == "root":
        return None
    if into is None:
        if moved:
            return others.get(origin)
        return primal if _NOISY not in primal.name.lower() and primal.channels != root else None
    fitting = [found for name, found in (own | others).items() if f".{name}".endswith(f".{into}")]
    if len(fitting) != 1:
        why = "fits several layers" if fitting else "is no layer of colour"
        raise NgptError(f"{path}: --into: '{into}' {why}; there are: {', '.join(['root', *own, *others])}")
    return fitting[0]


def with_result(
    image: ExrImage, resolution: Resolution, view: View, pixels: np.ndarray, shown: Found | None
) -> tuple[ExrImage, int]:
    """The file with ``pixels`` (H, W, 3) float32 as the root of a view's first part and the input as primal.R/G/B.

    ``pixels`` also replace the layer ``shown``, which the attribute ``ngpt:pass`` then names. The second value is the
    index of the part with the result.
    """
    primal, alpha = resolution["primal"], resolution.get("alpha")
    source, parts, place = image.parts[primal.part], list(image.parts), view.first
    suffixes = channels_like(primal)
    root, kept = (tuple(view.channel(place, start + c) for c in suffixes) for start in ("", "primal."))
    half = is_half(source, primal.channels)
    values = [source.channels[name] for name in primal.channels]
    if primal.factors:
        values, half = list(np.moveaxis(taken(image, primal, primal.part), -1, 0)), False
    shows_another = primal.channels not in (root, kept) and any(name in source.channels for name in root)
    if primal.part != place or shows_another:
        parts = [part if part.name else replace(part, name="source") for part in parts]
        name = f"ngpt {view.name}".strip()
        while any(part.name == name for part in parts):
            name += " result"
        header = {key: value for key, value in source.header.items() if key not in ("channels", "lineOrder", "tiles")}
        header |= {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, "name": name}
        if view.name:
            header = {key: value for key, value in header.items() if key != "multiView"} | {"view": view.name}
        root, kept = suffixes, tuple(f"primal.{suffix}" for suffix in suffixes)
        # If a new part does not go in front, it goes to the end, where it does not change the indices of other parts.
        place = 0 if place == 0 else len(parts)
        parts.insert(place, ExrPart(name, header, {}))
    channels = parts[place].channels
    channels.update(zip(kept, values, strict=True))
    if alpha:
        part = image.parts[alpha.part]
        pixels_of_alpha = put(part.channels[alpha.channels[0]], data_window(part), data_window(source))
        channels.setdefault(root[0][:-1] + "A", pixels_of_alpha)
    scatter(parts[place], root, pixels, half)
    if shown:
        part = image.parts[shown.part]
        there = put(pixels, data_window(source), data_window(part))
        scatter(part, shown.channels, there, is_half(part, shown.channels))
        parts[place].header["ngpt:pass"] = shown.name
    return ExrImage(parts), place
