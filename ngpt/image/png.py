"""Encodes PNGs of 8-bit RGB or with a palette, so that reports need no image library."""

import struct
import zlib

import numpy as np

from ngpt.errors import NgptError


def encode_png(image: np.ndarray, level: int = 9) -> bytes:
    """An sRGB PNG of pixels (H, W, 3) uint8, with row 0 at the top. The same pixels give the same bytes.

    ``level`` is the compression level of zlib: 9 makes the smallest file, and 1 takes a tenth of the time.
    """
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or image.size == 0:
        raise NgptError(f"PNG: needs a non-empty (H, W, 3) uint8 image, got {image.shape} {image.dtype}")
    return _file(image, 2, b"", _filtered(image), level)


def encode_palette_png(places: np.ndarray, table: np.ndarray, level: int = 6) -> bytes:
    """A PNG of indices (H, W) uint8 into a ``table`` of at most 256 colours (N, 3) uint8: a third of RGB's size."""
    if places.dtype != np.uint8 or places.ndim != 2 or places.size == 0 or places.max() >= len(table):
        raise NgptError(f"PNG: needs non-empty (H, W) uint8 places in a table, got {places.shape} {places.dtype}")
    # Rows without a filter, as the standard advises for palettes.
    rows = np.pad(places, ((0, 0), (1, 0))).tobytes()
    return _file(places, 3, _chunk(b"PLTE", table.astype(np.uint8).tobytes()), rows, level)


def _file(image: np.ndarray, colours: int, table: bytes, rows: bytes, level: int) -> bytes:
    height, width = image.shape[:2]
    header = struct.pack(">IIBBBBB", width, height, 8, colours, 0, 0, 0)  # 8 bits, no interlace
    body = _chunk(b"IDAT", zlib.compress(rows, level))
    return b"\x89PNG\r\n\x1a\n" + _chunk(b"IHDR", header) + _chunk(b"sRGB", b"\0") + table + body + _chunk(b"IEND", b"")


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def _filtered(image: np.ndarray) -> bytes:
    """The rows, each with the filter (none, left or up) that gives the smallest residuals, as the standard advises."""
    rows = image.reshape(len(image), -1)
    left, up = rows.copy(), rows.copy()
    left[:, 3:] -= rows[:, :-3]  # uint8 wraps modulo 256, as the standard asks
    up[1:] -= rows[:-1]
    candidates = np.stack([rows, left, up])
    costs = np.abs(candidates.view(np.int8).astype(np.int16)).sum(axis=2)
    best = costs.argmin(axis=0)
    chosen = np.take_along_axis(candidates, best[None, :, None], axis=0)[0]
    return np.hstack([best.astype(np.uint8)[:, None], chosen]).tobytes()
