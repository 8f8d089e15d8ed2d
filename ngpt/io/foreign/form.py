"""The parts that all readers share: the facts about an image before it is decoded, and their errors."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np


class Damage(Exception):
    """The damage of a file, in a few words."""


class Unread(Exception):
    """A feature of an intact file that is not read here, and the remedy."""


@dataclass(frozen=True)
class Form:
    """An image that is not decoded yet.

    ``kind``      format and type of numbers, for messages: "PNG, 16 bits"
    ``size``      (width, height)
    ``channels``  1 grey, 2 grey and alpha, 3 colour, 4 colour and alpha
    ``ratio``     the most bytes of the decoded float32 image that one byte of the file can stand for
    ``encoded``   whether numbers are display values: uint8 or uint16 of sRGB; others are scene-linear float32
    ``decode``    () -> (H, W, channels), row 0 on top
    ``straight``  whether colours are not yet multiplied by alpha
    """

    kind: str
    size: tuple[int, int]
    channels: int
    ratio: int
    encoded: bool
    decode: Callable[[], np.ndarray]
    straight: bool = False
