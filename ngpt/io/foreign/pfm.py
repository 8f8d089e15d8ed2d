"""Reads and writes portable float maps (PFM), the format of Open Image Denoise's programs.

A file has a header of text (``PF``, or ``Pf`` for grey; width and height; scale), and then float32 numbers, the bottom
row first. A negative scale means little-endian. Its magnitude multiplies the numbers, as in oidnDenoise.
https://www.pauldebevec.com/Research/HDR/PFM/
"""

import math
import os
import re
from pathlib import Path
from typing import BinaryIO

import numpy as np

from ngpt.io.foreign.form import Damage, Form
from ngpt.system.files import atomic_output

_HEADER = re.compile(rb"P([Ff])\s+(\d{1,9})\s+(\d{1,9})\s+(\S{1,40})\s")


def describe(file: BinaryIO) -> Form:
    """Describes the image of an open file. Raises Damage."""
    header = _HEADER.match(file.read(256))
    try:
        scale = float(header[4]) if header else 0.0
    except ValueError:
        scale = 0.0
    if not header or scale == 0.0 or not math.isfinite(scale):
        raise Damage("its header is not: PF, width and height, scale")
    channels, width, height = 3 if header[1] == b"F" else 1, int(header[2]), int(header[3])
    start = header.end()

    def decode() -> np.ndarray:
        file.seek(start)
        count = width * height * channels
        values = np.fromfile(file, "<f4" if scale < 0 else ">f4", count)
        if values.size < count:
            raise Damage(f"it has only {values.size} of its {count} numbers")
        values = values.reshape(height, width, channels)[::-1].astype(np.float32)
        with np.errstate(over="ignore"):
            return values if abs(scale) == 1.0 else values * np.float32(abs(scale))

    return Form("PFM", (width, height), channels, 4, False, decode)


def write_pfm(path: str | os.PathLike, image: np.ndarray, overwrite: bool = False) -> Path:
    """Writes an image (H, W, 3), with row 0 at the top, as little-endian float32, complete or not at all."""
    height, width = image.shape[:2]
    with atomic_output(path, overwrite) as temporary, temporary.open("wb") as file:
        file.write(b"PF\n%d %d\n-1.0\n" % (width, height))
        file.write(np.ascontiguousarray(image[::-1], "<f4").tobytes())
    return Path(path)
