"""Subpixels in files: one more part, ``fine``, which other readers may ignore.

This part holds R G B, ``albedo.R/G/B`` and ``normal.X/Y/Z``. Its data window is K times that of the pixels, and the
attribute ``ngpt:subpixels`` holds K. Its display window is not multiplied, because OpenEXR requires the same display
window in all parts of a file.
"""

import logging
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import OpenEXR

from ngpt.io.layout import data_window, gather, scatter
from ngpt.io.openexr import ExrImage, ExrPart
from ngpt.layers import stored_channels
from ngpt.stack import GradientStack
from ngpt.subpixels import FINE, HALF, SUBPIXELS, belong

_LOG = logging.getLogger(__name__)

PART = "fine"
# The name for the part with the pixels if it has no name: in a file of several parts, each part needs a name.
_PIXELS = "stack"
# Attributes that OpenEXR requires to be the same in all parts of a file
_COMMON = ("displayWindow", "pixelAspectRatio", "timeCode", "chromaticities")


def is_fine(name: str, attributes: Mapping) -> bool:
    """Whether a part of this name and with these attributes holds subpixels."""
    return name == PART and SUBPIXELS in attributes


def apart(image: ExrImage) -> tuple[ExrImage, ExrPart | None]:
    """The file without its subpixels, and the part with the subpixels, None if it has none."""
    fine = next((part for part in image.parts[1:] if is_fine(part.name, part.header)), None)
    if fine is None:
        return image, None
    return ExrImage([part for part in image.parts if part is not fine]), fine


def subpixels_of(part: ExrPart, stack: GradientStack) -> dict[str, np.ndarray]:
    """The subpixels in a part, by layer; none, with a warning, if they do not match the pixels of the stack."""
    data, window = stack.place.data, data_window(part)
    k = part.header[SUBPIXELS]
    if not isinstance(k, int) or k < 2 or window != data.times(k):
        found = (stack.path, PART, window, SUBPIXELS, k, data)
        _LOG.warning("%s: part '%s' has %s and '%s' %s, which do not fit the pixels at %s; they are left out", *found)
        return {}
    names = {name: stored_channels(name) for name in FINE}
    held = {name: gather(part, its) for name, its in names.items() if all(c in part.channels for c in its)}
    return held if "primal" in held and belong(held, stack.layers, stack.path) else {}


def with_subpixels(image: ExrImage, main: int, stack: GradientStack) -> ExrImage:
    """The file of a stack with its subpixels added, if it has any; ``main`` is the index of the part with pixels."""
    header = image.parts[main].header
    if not stack.fine:
        header.pop(SUBPIXELS, None)
        return image
    k = stack.fine["primal"].shape[1] // stack.width
    header[SUBPIXELS] = k
    own = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, SUBPIXELS: k}
    own["dataWindow"] = stack.place.data.times(k).box
    part = ExrPart(PART, own | {name: header[name] for name in _COMMON if name in header}, {})
    for name, layer in stack.fine.items():
        scatter(part, stored_channels(name), layer, half=name in HALF)
    return ExrImage([*(each if each.name else replace(each, name=_PIXELS) for each in image.parts), part])
