"""Layers in a file: their places, and the conversion between layers (H, W, C) and channels (H, W)."""

from dataclasses import dataclass

import numpy as np

from ngpt.errors import NgptError
from ngpt.io.openexr import ExrImage, ExrPart
from ngpt.io.resolution import Found, Resolution
from ngpt.io.views import Part, View, views_of
from ngpt.windows import Place, Window, put

_HALF_MAX = 65504.0
_HALF_NORMAL_MIN = 2.0**-14
_ROWS = 16  # gathered at a time


@dataclass(frozen=True)
class StackSource:
    """The file that a stack was read from, the places of its layers there, and the view of the file that it shows."""

    image: ExrImage
    resolution: Resolution
    view: View


def file_views(image: ExrImage) -> list[View]:
    """The views of a file, from its headers."""
    return views_of(
        [
            Part(part.name, list(part.channels), str(part.header.get("view", "")), part.header.get("multiView", ()))
            for part in image.parts
        ]
    )


def place_of(part: ExrPart) -> Place:
    """The data window, the display window and the pixels' aspect of a part."""
    display = Window.of_box(part.header["displayWindow"])
    return Place(data_window(part), display, float(part.header.get("pixelAspectRatio", 1.0)))


def gather(part: ExrPart, names: tuple[str, ...]) -> np.ndarray:
    """The channels ``names`` as one array (H, W, C) float32."""
    channels = [part.channels[name] for name in names]
    layer = np.empty((*channels[0].shape, len(channels)), np.float32)
    # Some rows at a time, so that these rows are still in the cache when the next channel is written.
    for top in range(0, len(layer), _ROWS):
        rows = slice(top, top + _ROWS)
        for index, channel in enumerate(channels):
            layer[rows, :, index] = channel[rows]
    return layer


def taken(image: ExrImage, found: Found, main: int) -> np.ndarray:
    """A layer of a file, (H, W, C) float32, on the pixels of the part ``main``; 0 where the layer has no pixels."""
    layer = gather(image.parts[found.part], found.channels)
    layer = put(layer, data_window(image.parts[found.part]), data_window(image.parts[main]))
    return layer * np.asarray(found.factors, np.float32) if found.factors else layer


def data_window(part: ExrPart) -> Window:
    return Window.of_box(part.header["dataWindow"])


def as_stored(image: ExrImage, found: Found, main: int) -> bool:
    """Whether ``taken`` returns the channels of a layer unchanged: it has no factors and lies on the same pixels."""
    return not found.factors and data_window(image.parts[found.part]) == data_window(image.parts[main])


def holds(part: ExrPart, names: tuple[str, ...], values: np.ndarray) -> bool:
    """Whether the channels ``names``, as float32, are bit for bit the float32 ``values`` (H, W, C)."""
    if values.dtype != np.float32 or values.shape[:2] != part.channels[names[0]].shape:
        return False
    held = (part.channels[name].astype(np.float32, copy=False) for name in names)
    bits = np.moveaxis(values.view(np.uint32), -1, 0)
    return all(np.array_equal(one.view(np.uint32), other) for one, other in zip(held, bits, strict=True))


def scatter(part: ExrPart, names: tuple[str, ...], values: np.ndarray, half: bool) -> None:
    """Puts ``values`` (H, W, C) into the channels ``names``, as float, or as ``half`` if half can hold them.

    Raises NgptError for colours if the file has one channel for all three.
    """
    grey = np.broadcast_to(values[..., :1], values.shape)
    if len({*names}) < len(names) and not np.array_equal(values, grey, equal_nan=True):
        raise NgptError(f"channel '{names[0]}' is luminance, and the image has colours: write it without its stack")
    if half:
        peak = np.abs(values[np.isfinite(values)]).max(initial=0.0)
        half = peak <= _HALF_MAX and not 0.0 < peak < _HALF_NORMAL_MIN
    # Variances in double precision that float cannot hold become infinite in files, which counts as unknown.
    with np.errstate(over="ignore"):
        for index, name in enumerate(names):
            part.channels[name] = np.ascontiguousarray(values[..., index], dtype=np.float16 if half else np.float32)


def is_half(part: ExrPart, names: tuple[str, ...]) -> bool:
    return all(part.channels[name].dtype == np.float16 for name in names)
