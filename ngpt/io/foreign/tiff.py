"""Reads the first image of a TIFF with tifffile. Numbers of 8 or 16 bits count as sRGB, and floats as scene-linear."""

import zlib
from importlib.util import find_spec
from typing import Any, BinaryIO

import numpy as np

from ngpt.io.foreign.form import Damage, Form, Unread
from ngpt.system.install import package_command

MAGICS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_LZW, _DEFLATE = 5, (8, 32946)
# None, LZW, Deflate under its two numbers, PackBits
_COMPRESSIONS = (1, _LZW, *_DEFLATE, 32773)
_FLOATING = 3  # predictor
_GREY, _COLOUR = 1, 2
_STRAIGHT = 2  # the kind of alpha by which colours are not multiplied
_BURST = 2**24  # strips that unpack to at most this number of bytes are always accepted


def describe(file: BinaryIO) -> Form:
    """Describes the image of an open file. Raises Damage or Unread."""
    if find_spec("tifffile") is None:
        raise Unread(f"TIFF needs tifffile: {package_command('tifffile')}")
    import tifffile

    page: Any = tifffile.TiffFile(file).pages[0]
    compression, light = int(page.compression), int(page.photometric)
    if compression not in _COMPRESSIONS:
        name = getattr(page.compression, "name", compression)
        raise Unread(f"is compressed by {name}; save it with Deflate, or without compression")
    for name, used in (("LZW", compression == _LZW), ("the predictor of floats", int(page.predictor) == _FLOATING)):
        if used and find_spec("imagecodecs") is None:
            command = package_command("imagecodecs")
            raise Unread(f"TIFF with {name} needs imagecodecs: {command}; or save it with plain Deflate")
    if light not in (_GREY, _COLOUR):
        name = getattr(page.photometric, "name", light)
        raise Unread(f"holds {name} and neither grey nor R G B; save it as R G B")
    kind = None if page.dtype is None else np.dtype(page.dtype)
    if kind not in (np.uint8, np.uint16, np.float16, np.float32, np.float64):
        raise Unread(f"holds numbers of {kind or f'{page.bitspersample} bits'}; save it with 8, 16 or 32-bit floats")
    colours = 3 if light == _COLOUR else 1
    extra = tuple(map(int, page.extrasamples))
    alpha = int(page.samplesperpixel > colours)
    width, height, planar = int(page.imagewidth), int(page.imagelength), int(page.planarconfig) == 2
    if page.samplesperpixel < colours or page.imagedepth != 1:
        raise Damage("its header makes no sense")

    def decode() -> np.ndarray:
        if compression in _DEFLATE:
            _check_strips(page, file, kind)
        values = page.asarray(maxworkers=1)
        if planar and page.samplesperpixel > 1:
            values = np.moveaxis(values.reshape(-1, height, width), 0, -1)
        values = values.reshape(height, width, -1)[..., : colours + alpha]
        with np.errstate(over="ignore"):
            return values if kind.kind == "u" else values.astype(np.float32)

    bits = f"{8 * kind.itemsize} bits" if kind.kind == "u" else f"{8 * kind.itemsize}-bit floats"
    straight = extra[:1] == (_STRAIGHT,)
    return Form(f"TIFF, {bits}", (width, height), colours + alpha, 1032 * 12, kind.kind == "u", decode, straight)


def _check_strips(page: Any, file: BinaryIO, kind: np.dtype) -> None:
    """Raises Damage for a strip or tile that unpacks to more than its pixels, and would fill the memory."""
    across, down = (page.tilewidth, page.tilelength) if page.is_tiled else (page.imagewidth, page.rowsperstrip)
    most = max(across * min(down, page.imagelength + down) * page.samplesperpixel * kind.itemsize, _BURST)
    for place, length in zip(page.dataoffsets, page.databytecounts, strict=False):
        if length * 1032 > most:
            file.seek(place)
            if len(zlib.decompressobj().decompress(file.read(length), most + 1)) > most:
                raise Damage("it unpacks to more than its size")
