"""The place of an image: the rectangle of its pixels, and the rectangle of the whole picture.

OpenEXR calls them data window and display window. Pixels of two images correspond if they have the same coordinates in
the picture, not the same index in the arrays.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ngpt.errors import NgptError

MOST = 2**28  # the most pixels of a canvas: 16384 x 16384


@dataclass(frozen=True)
class Window:
    """A rectangle of pixels. Its first pixel is (left, top), which may be negative; x points right and y down."""

    left: int
    top: int
    width: int
    height: int

    @classmethod
    def of_box(cls, box: Any) -> "Window":
        """The window of OpenEXR's ((left, top), (right, bottom)), its first and its last pixel."""
        (left, top), (right, bottom) = ((int(n) for n in corner) for corner in box)
        return cls(left, top, right - left + 1, bottom - top + 1)

    @property
    def box(self) -> tuple[np.ndarray, np.ndarray]:
        """The inverse of ``of_box``."""
        last = [self.left + self.width - 1, self.top + self.height - 1]
        return np.array([self.left, self.top], np.int32), np.array(last, np.int32)

    @property
    def corner(self) -> tuple[int, int]:
        return self.left, self.top

    @property
    def size(self) -> tuple[int, int]:
        """(width, height)."""
        return self.width, self.height

    def __str__(self) -> str:
        return f"{self.width}x{self.height} at ({self.left}, {self.top})"

    def common(self, other: "Window") -> "Window | None":
        """The window of the pixels that both windows have; None if they have no pixel in common."""
        left, top = max(self.left, other.left), max(self.top, other.top)
        width = min(self.left + self.width, other.left + other.width) - left
        height = min(self.top + self.height, other.top + other.height) - top
        return Window(left, top, width, height) if width > 0 and height > 0 else None

    def around(self, other: "Window") -> "Window":
        """The smallest window that holds both windows."""
        left, top = min(self.left, other.left), min(self.top, other.top)
        right = max(self.left + self.width, other.left + other.width)
        bottom = max(self.top + self.height, other.top + other.height)
        return Window(left, top, right - left, bottom - top)

    def times(self, k: int) -> "Window":
        """The window after each pixel has become K x K pixels."""
        return Window(k * self.left, k * self.top, k * self.width, k * self.height)

    def within(self, other: "Window") -> tuple[slice, slice]:
        """The rows and columns of these pixels in an image of the window ``other``, which must hold all of them."""
        x, y = self.left - other.left, self.top - other.top
        return slice(y, y + self.height), slice(x, x + self.width)


@dataclass(frozen=True)
class Place:
    """The place of an image.

    ``data``     the window of its pixels: a part of the picture, or more than the picture (overscan), or both
    ``display``  the window of the whole picture
    ``aspect``   the width of a pixel divided by its height, for display
    """

    data: Window
    display: Window
    aspect: float = field(default=1.0, compare=False)

    @classmethod
    def whole(cls, width: int, height: int) -> "Place":
        """The place of an image when only its size is known."""
        return cls(window := Window(0, 0, width, height), window)

    @property
    def known(self) -> bool:
        """Whether more is known than the size of the image."""
        return self != Place.whole(*self.data.size)

    def __str__(self) -> str:
        if not self.known:
            return "x".join(map(str, self.data.size))
        return f"{self.data} of {self.display if any(self.display.corner) else Place.whole(*self.display.size)}"

    def seen_from(self, other: "Place") -> "Window | None":
        """The window of the pixels in the coordinates of ``other``; None if the pictures have different resolutions.

        Many programs lose the place of a crop. So if only the size of one image is known, and the other image has the
        same size, both are taken to be at the same place. In all other cases, both places are taken to be in the same
        coordinates, unless their display windows have the same corner and different sizes: then the resolutions differ.
        """
        if self.display != other.display:
            if self.data.size == other.data.size and not (self.known and other.known):
                return other.data
            if self.display.corner == other.display.corner:
                return None
        return self.data

    def shift_in(self, other: "Place") -> tuple[int, int] | None:
        """The column and row of the first pixel in an image at ``other``; None if ``seen_from`` returns None."""
        window = self.seen_from(other)
        return None if window is None else (window.left - other.data.left, window.top - other.data.top)


@dataclass(frozen=True)
class Overlap:
    """The ``windows`` of several images in the coordinates of the first one, and their ``common`` pixels."""

    windows: list[Window]
    common: Window

    @property
    def line(self) -> str:
        """A message about the common pixels; "" if these are all pixels of all images."""
        if all(window == self.common for window in self.windows):
            return ""
        return f"compared are the pixels that all images have: {self.common}"

    def of(self, images: Sequence[np.ndarray]) -> list[np.ndarray]:
        """The common pixels of each image (H, W, C)."""
        return [image[self.common.within(window)] for image, window in zip(images, self.windows, strict=True)]


def overlap(names: Sequence[str], places: Sequence[Place]) -> Overlap:
    """The overlap of images, whose ``names`` are for messages.

    Raises NgptError for images that have no pixel in common, and for pictures of different resolutions.
    """
    windows, common = [], places[0].data
    for name, place in zip(names, places, strict=True):
        window = place.seen_from(places[0])
        if window is None:
            raise NgptError(f"{name} is {place} but {names[0]} is {places[0]}; render or crop them to one size")
        windows.append(window)
        if (both := common.common(window)) is None:
            each = ", ".join(f"{name} is {place}" for name, place in zip(names, places, strict=True))
            raise NgptError(f"{each}; these have no pixel in common: give images of the same part of the picture")
        common = both
    return Overlap(windows, common)


def put(image: np.ndarray, window: Window, canvas: Window, outside: float = 0.0) -> np.ndarray:
    """Puts an image (H, W, C) of ``window`` on the pixels of ``canvas``; ``outside`` is the value of missing pixels.

    Raises NgptError for a canvas of more than ``MOST`` pixels, which a damaged header may ask for.
    """
    if window == canvas:
        return image
    if canvas.width * canvas.height > MOST:
        size = f"{canvas.width}x{canvas.height}"
        raise NgptError(f"the display window is {size} pixels; at most {MOST >> 20} million are shown: make it smaller")
    filled = np.full((canvas.height, canvas.width, *image.shape[2:]), outside, image.dtype)
    if common := window.common(canvas):
        filled[common.within(canvas)] = image[common.within(window)]
    return filled
