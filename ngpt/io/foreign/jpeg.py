"""Reads JPEG with Pillow, and rotates the image as its orientation tag says."""

from importlib.util import find_spec
from typing import BinaryIO

import numpy as np

from ngpt.io.foreign.form import Form, Unread
from ngpt.system.install import package_command

MAGIC = b"\xff\xd8\xff"
_SIDEWAYS = (5, 6, 7, 8)  # values of the orientation tag that swap width and height
_ORIENTATION = 0x112


def describe(file: BinaryIO) -> Form:
    """Describes the image of an open file. Raises Damage or Unread."""
    if find_spec("PIL") is None:
        raise Unread(f"JPEG needs Pillow: {package_command('pillow')}")
    from PIL import ImageOps
    from PIL.JpegImagePlugin import JpegImageFile

    # Image.open is not used, because it limits the size: ``files`` checks the size before decoding.
    image = JpegImageFile(file)
    if image.mode not in ("L", "RGB"):
        raise Unread(f"holds {image.mode} and neither grey nor R G B; save it as R G B")
    size = image.size[::-1] if image.getexif().get(_ORIENTATION) in _SIDEWAYS else image.size

    def decode() -> np.ndarray:
        pixels = np.asarray(ImageOps.exif_transpose(image))
        return pixels.reshape(*pixels.shape[:2], -1)

    return Form("JPEG, 8 bits", size, len(image.mode), 2**16, True, decode)
