"""A PNG encoder for 8-bit RGB: the one image format a report needs, and no dependency for it."""

import struct
import zlib

import numpy as np

from ngpt.errors import NgptError


def encode_png(image: np.ndarray, level: int = 9) -> bytes:
    """Encodes (H, W, 3) uint8, row 0 on top, as an sRGB PNG. The same pixels give the same bytes.

    ``level`` is that of zlib: 9 makes the smallest file, 1 takes a tenth of the time.
    """
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or image.size == 0:
        raise NgptError(f"PNG: needs a non-empty (H, W, 3) uint8 image, got {image.shape} {image.dtype}")
    height, width, _ = image.shape
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)  # 8 bits, RGB, no interlace
    body = zlib.compress(_filtered(image), level)
    chunks = _chunk(b"IHDR", header) + _chunk(b"sRGB", b"\0") + _chunk(b"IDAT", body) + _chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + chunks


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def _filtered(image: np.ndarray) -> bytes:
    """Each row with the filter (none, left or up) whose residuals are smallest: the heuristic of the PNG standard."""
    rows = image.reshape(len(image), -1)
    left, up = rows.copy(), rows.copy()
    left[:, 3:] -= rows[:, :-3]  # uint8 wraps modulo 256, as the standard asks
    up[1:] -= rows[:-1]
    candidates = np.stack([rows, left, up])
    costs = np.abs(candidates.view(np.int8).astype(np.int16)).sum(axis=2)
    best = costs.argmin(axis=0)
    chosen = np.take_along_axis(candidates, best[None, :, None], axis=0)[0]
    return np.hstack([best.astype(np.uint8)[:, None], chosen]).tobytes()
