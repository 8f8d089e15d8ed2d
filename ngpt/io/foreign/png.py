"""Reads PNG of all colour types and depths, interlaced or not. Gamma and profiles are ignored: values count as sRGB.

https://www.w3.org/TR/png-3/; ``ngpt.image.png`` is the encoder.
"""

import struct
import zlib
from collections.abc import Iterator
from typing import Any, BinaryIO

import numpy as np

from ngpt.io.foreign.form import Damage, Form, Unread

MAGIC = b"\x89PNG\r\n\x1a\n"
_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}
_DEPTHS = {0: (1, 2, 4, 8, 16), 2: (8, 16), 3: (1, 2, 4, 8), 4: (8, 16), 6: (8, 16)}
_LONGEST = 2**16  # pixels of a side, because filters are undone in a loop over diagonals
# For each pass of an interlaced image: x and y of its first pixel, and the steps in x and y to its next pixels
_ADAM7 = ((0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2), (0, 1, 1, 2))


def describe(file: BinaryIO) -> Form:
    """Describes the image of an open file. Raises Damage or Unread."""
    file.seek(len(MAGIC))
    if file.read(8) != b"\0\0\0\rIHDR":
        raise Damage("it has no header")
    start = _data(file, 13, b"IHDR")
    width, height, depth, colour, compression, filters, interlaced = struct.unpack(">2I5B", start)
    if depth not in _DEPTHS.get(colour, ()) or compression or filters or interlaced > 1 or not (width and height):
        raise Damage("its header makes no sense")
    if max(width, height) > _LONGEST:
        raise Unread(f"is {width}x{height} pixels, but sides longer than {_LONGEST} are not read; cut it up")
    chunks = list(_before_pixels(file))
    palette = next((data for kind, data in chunks if kind == b"PLTE"), b"")
    clear = next((data for kind, data in chunks if kind == b"tRNS"), b"")
    planes = (3 if colour & 2 else 1) + (1 if colour & 4 or clear else 0)

    def decode() -> np.ndarray:
        samples = _samples(file, (width, height), depth, _CHANNELS[colour], bool(interlaced))
        if colour == 3:
            return _looked_up(samples[..., 0], palette, clear)
        most = 2**depth - 1
        if clear:
            # Pixels of this colour are transparent.
            colour_key = np.frombuffer(clear[: 2 * samples.shape[2]], ">u2")
            if colour_key.size < samples.shape[2]:
                raise Damage("its clear colour breaks off")
            opaque = (samples != colour_key).any(axis=-1, keepdims=True)
            samples = np.concatenate([samples, (opaque * most).astype(samples.dtype)], axis=-1)
        return samples if depth >= 8 else (samples * (255 // most)).astype(np.uint8)

    # One byte inflates to at most 1032 bytes, and an index into a palette becomes four floats.
    ratio = 1032 * 8 * 16 // depth
    return Form(f"PNG, {depth} bits", (width, height), planes, ratio, True, decode, straight=True)


def _before_pixels(file: BinaryIO) -> Iterator[tuple[bytes, bytes]]:
    """Yields the kind and the data of the chunks with the palette and the transparent colour.

    Then the file is at the first chunk with pixels.
    """
    while True:
        length, kind = _next(file)
        if kind == b"IDAT":
            file.seek(-8, 1)
            return
        if kind in (b"PLTE", b"tRNS"):
            if length > 768:
                raise Damage(f"its {kind.decode()} is too long")
            yield kind, _data(file, length, kind)
        else:
            file.seek(length + 4, 1)


def _next(file: BinaryIO) -> tuple[int, bytes]:
    """The length and the kind of the chunk at the file's position."""
    header = file.read(8)
    if len(header) < 8:
        raise Damage("it ends before all of its pixels are there")
    return struct.unpack(">I4s", header)


def _data(file: BinaryIO, length: int, kind: bytes) -> bytes:
    """The data of a chunk, whose checksum is verified."""
    data, checksum = file.read(length), file.read(4)
    if len(checksum) < 4:
        raise Damage("it ends before all of its pixels are there")
    if struct.pack(">I", zlib.crc32(kind + data)) != checksum:
        raise Damage("a checksum is wrong")
    return data


def _samples(file: BinaryIO, size: tuple[int, int], depth: int, channels: int, interlaced: bool) -> np.ndarray:
    """The numbers of all pixels as they are stored, (H, W, channels) uint8 or uint16."""
    width, height = size
    passes = _ADAM7 if interlaced else ((0, 0, 1, 1),)
    # ``areas`` has the columns and rows of each pass, ``shapes`` its rows and the bytes of a row.
    areas = [(-(-(width - x) // step), -(-(height - y) // rise)) for x, y, step, rise in passes]
    shapes = [(rows, -(-columns * channels * depth // 8)) if columns > 0 else (0, 0) for columns, rows in areas]
    data = _inflated(file, sum(rows * (1 + length) for rows, length in shapes if length))
    samples = np.empty((height, width, channels), np.uint16 if depth == 16 else np.uint8)
    place = 0
    for (x, y, step, rise), (columns, rows), (_, length) in zip(passes, areas, shapes, strict=True):
        if rows <= 0 or not length:
            continue
        lines = np.frombuffer(data, np.uint8, rows * (1 + length), place).reshape(rows, 1 + length)
        place += lines.size
        plain = _unfiltered(lines, max(channels * depth // 8, 1))
        if depth == 16:
            values = plain.view(">u2")
        elif depth == 8:
            values = plain
        else:
            bits = np.unpackbits(plain, axis=1).reshape(rows, -1, depth)[:, : columns * channels]
            values = bits @ (1 << np.arange(depth)[::-1])
        samples[y::rise, x::step] = values.reshape(rows, columns, channels)
    return samples


def _inflated(file: BinaryIO, size: int) -> bytes:
    """The first ``size`` inflated bytes of the chunks with pixels; all others are ignored."""
    inflate, data = zlib.decompressobj(), bytearray()
    while len(data) < size:
        length, kind = _next(file)
        if kind != b"IDAT":
            raise Damage("not all of its pixels are there")
        data += inflate.decompress(_data(file, length, kind), size - len(data))
    return bytes(data)


def _unfiltered(lines: np.ndarray, step: int) -> np.ndarray:
    """Undoes the filters of rows, (rows, 1 + bytes), whose first byte is the filter; returns (rows, bytes).

    ``step`` is the number of bytes of a pixel. A pixel depends on the pixels to its left, above, and above left, so all
    pixels on a diagonal are computed at once.
    """
    filters, coded = lines[:, 0], lines[:, 1:]
    if filters.max(initial=0) > 4:
        raise Damage(f"row {int(filters.argmax())} has filter {filters.max()}; filters are 0 to 4")
    rows, columns = len(lines), coded.shape[1] // step
    # The row above and the column to the left are zeros.
    out = np.zeros((rows + 1, columns + 1, step), np.int16)
    out[1:, 1:] = coded.reshape(rows, columns, step)
    if filters.any():
        flat, wide = out.reshape(-1, step), columns + 1
        kinds = filters[:, None]
        for diagonal in range(rows + columns - 1):
            top, end = max(0, diagonal - columns + 1), min(rows - 1, diagonal) + 1
            first = (top + 1) * wide + diagonal - top + 1
            # The next pixel of a diagonal is one row lower and one column to the left.
            here, left, above, corner = (
                flat[first - back : first - back + (end - top - 1) * columns + 1 : columns]
                for back in (0, 1, wide, wide + 1)
            )
            kind = kinds[top:end]
            across, down = np.abs(above - corner), np.abs(left - corner)
            both = np.abs(left + above - 2 * corner)
            nearest = np.where((across <= down) & (across <= both), left, np.where(down <= both, above, corner))
            guesses: Any = (0, left, above, (left + above) >> 1, nearest)
            here[...] = (here + np.choose(kind, guesses)) & 255
    return np.ascontiguousarray(out[1:, 1:].astype(np.uint8).reshape(rows, -1))


def _looked_up(places: np.ndarray, palette: bytes, clear: bytes) -> np.ndarray:
    """The colours (H, W, 3 or 4) uint8 of indices into a palette; ``clear`` is the alpha of its first colours."""
    table = np.frombuffer(palette[: len(palette) // 3 * 3], np.uint8).reshape(-1, 3)
    if places.max() >= len(table):
        raise Damage(f"its palette has {len(table)} colours, and a pixel is number {places.max()}")
    if clear:
        alpha = np.full((len(table), 1), 255, np.uint8)
        alpha[: len(clear), 0] = np.frombuffer(clear, np.uint8)[: len(table)]
        table = np.concatenate([table, alpha], axis=1)
    return table[places]
