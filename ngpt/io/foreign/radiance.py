"""Reads Radiance HDR: RGBE pixels, plain or with the old or the new run lengths.

A pixel has R G B in 8 bits each and an exponent e for all three: value = byte * 2^(e - 136), as in most readers.
(Radiance itself adds half a step.) Pixels are divided by EXPOSURE and COLORCORR, with which they were multiplied.
https://radsite.lbl.gov/radiance/refer/filefmts.pdf
"""

import math
import re
from typing import BinaryIO

import numpy as np

from ngpt.io.foreign.form import Damage, Form, Unread

_MOST = 2**16  # bytes of the header
_SHORTEST, _LONGEST = 8, 0x7FFF  # the widths of images that may have the new run lengths


def describe(file: BinaryIO) -> Form:
    """Describes the image of an open file. Raises Damage or Unread."""
    start = file.read(_MOST)
    text, gap, rest = start.partition(b"\n\n")
    line = re.match(rb"([-+])Y +(\d{1,9}) +([-+])X +(\d{1,9})\n", rest)
    if gap and not line and re.match(rb"[-+]X ", rest):
        raise Unread("has columns for rows; turn it with pfilt or another program")
    if not line:
        raise Damage("its header does not end in a size, such as -Y 360 +X 640")
    if (form := re.search(rb"^FORMAT *= *(\S+)", text, re.MULTILINE)) and form[1] != b"32-bit_rle_rgbe":
        raise Unread(f"holds {form[1][:30].decode(errors='replace')} and no RGB; convert it with ra_xyze -r")
    height, width = int(line[2]), int(line[4])
    body = len(text) + len(gap) + line.end()
    gain = _multiplied(text)

    def decode() -> np.ndarray:
        file.seek(body)
        pixels = _pixels(file.read(), width, height)
        light = np.ldexp(pixels[..., :3].astype(np.float32), pixels[..., 3:].astype(np.int32) - 136)
        light[pixels[..., 3] == 0] = 0.0
        with np.errstate(over="ignore"):
            light = light if (gain == 1.0).all() else (light / gain).astype(np.float32)
        return light[:: 1 if line[1] == b"-" else -1, :: 1 if line[3] == b"+" else -1]

    # Two bytes of the new run lengths can hold 127 values, but one old repetition can hold a whole image.
    return Form("Radiance HDR", (width, height), 3, 2**24, False, decode)


def _multiplied(header: bytes) -> np.ndarray:
    """The factors (3,) of the pixels: the product of all EXPOSURE and COLORCORR in the header."""
    gain = np.ones(3)
    for name, value in re.findall(rb"^(EXPOSURE|COLORCORR) *= *(.*)$", header, re.MULTILINE):
        try:
            numbers = [float(number) for number in value.split()]
        except ValueError:
            numbers = []
        if len(numbers) != (1 if name == b"EXPOSURE" else 3) or not all(0 < n < math.inf for n in numbers):
            raise Damage(f"{name.decode()} is {value[:40]!r}")
        gain = gain * numbers
    if not (np.isfinite(gain).all() and (gain > 0).all()):
        raise Damage("its exposures multiply to no number")
    return gain


def _pixels(data: bytes, width: int, height: int) -> np.ndarray:
    """The RGBE pixels (H, W, 4) uint8."""
    if _SHORTEST <= width <= _LONGEST and data[:4] == bytes((2, 2, width >> 8, width & 255)):
        return _new_runs(data, width, height)
    pixels = np.frombuffer(data[: len(data) // 4 * 4], np.uint8).reshape(-1, 4)
    repeats = (pixels[:, :3] == 1).all(axis=1)
    if repeats.any():
        pixels = _old_runs(pixels, repeats, width * height)
    if len(pixels) < width * height:
        raise Damage(f"it has only {len(pixels)} of its {width * height} pixels")
    return pixels[: width * height].reshape(height, width, 4)


def _old_runs(pixels: np.ndarray, repeats: np.ndarray, count: int) -> np.ndarray:
    """The pixels (n, 4) without repetitions. A pixel 1 1 1 n repeats the pixel before it n times.

    If several such pixels follow each other, each n counts 256 times as much as the one before.
    """
    places = np.arange(len(pixels))
    last = np.maximum.accumulate(np.where(repeats, -1, places))
    if repeats[0]:
        raise Damage("it begins with a repetition")
    digit = np.minimum(places - last - 1, 3)
    times = np.where(repeats, pixels[:, 3].astype(np.int64) << (8 * np.maximum(digit, 0)), 1)
    end = np.cumsum(times)
    if not len(end) or end[-1] < count:
        raise Damage(f"it has only {end[-1] if len(end) else 0} of its {count} pixels")
    # Values beyond the image are not used.
    times = np.clip(count - (end - times), 0, times)
    return np.repeat(pixels[last], times, axis=0)


def _new_runs(data: bytes, width: int, height: int) -> np.ndarray:
    """The pixels (H, W, 4) of rows that store all R, then all G, B and exponents.

    The byte 128 + n means that the next byte occurs n times. A byte n of up to 128 means that n bytes follow.
    """
    pixels, place, begin = np.empty((height, 4, width), np.uint8), 0, bytes((2, 2, width >> 8, width & 255))
    for y in range(height):
        if data[place : place + 4] != begin:
            raise Damage(f"row {y} does not begin as one")
        place += 4
        for part in range(4):
            line, x = pixels[y, part], 0
            while x < width:
                run = data[place] if place < len(data) else 0
                length = run - 128 if run > 128 else run
                values = data[place + 1 : place + 2] if run > 128 else data[place + 1 : place + 1 + length]
                if not length or x + length > width or len(values) < (1 if run > 128 else length):
                    raise Damage(f"row {y} breaks off or is too long")
                line[x : x + length] = np.frombuffer(values, np.uint8)
                x, place = x + length, place + 1 + len(values)
    return np.moveaxis(pixels, 1, 2)
