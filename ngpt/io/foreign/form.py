"""The description of an image that a reader has not decoded yet, and the errors of readers."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np


class Damage(Exception):
    """A damaged file; the message is a phrase."""


class Unread(Exception):
    """An intact file with a feature that ngpt does not read; the message names the feature and the remedy."""


@dataclass(frozen=True)
class Form:
    """An image that is not decoded yet.

    ``kind``      format and type of numbers, for messages: "PNG, 16 bits"
    ``size``      (width, height) in pixels
    ``channels``  1 grey, 2 grey and alpha, 3 colour, 4 colour and alpha
    ``ratio``     the most bytes of the decoded float32 image that one byte of the file can hold
    ``encoded``   whether numbers are sRGB display values, uint8 or uint16; otherwise they are scene-linear float32
    ``decode``    returns the pixels, (H, W, channels), with row 0 at the top
    ``straight``  whether colours are not yet multiplied by alpha
    """

    kind: str
    size: tuple[int, int]
    channels: int
    ratio: int
    encoded: bool
    decode: Callable[[], np.ndarray]
    straight: bool = False
