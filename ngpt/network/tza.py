"""Writes .tza files, the weights of Open Image Denoise, and reads their tables of tensors.

    u16 0x41D7, u8 2, u8 0      magic and version
    u64                         the position of the table
    tensors                     each at a multiple of 64 bytes
    u32                         the number of tensors, and for each tensor
        u16, bytes              the name
        u8, u32 ...             the shape
        bytes                   the layout: "oihw" for kernels, "x" for biases
        "f" or "h", u64         numbers of 32 or 16 bits, and the position of the tensor's data

All numbers are little-endian [Intel Open Image Denoise 2.4.1, core/tza.cpp]. OIDN accepts only tensors in 16 bits, and
ignores tensors that it does not use. So ngpt adds one unused tensor, the *mark*. Its name says which of ngpt's images
(the primal, or a base) is OIDN's colour input. A base is the result of a classical reconstruction.
"""

import struct
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ngpt.classical.bases import BASES
from ngpt.errors import NgptError
from ngpt.system.reading import read_bytes

MAGIC, VERSION, ALIGNMENT = 0x41D7, 2, 64
# The name of the mark begins with this text. The name of the image follows: "primal", or the name of a base.
MARK = "ngpt.colour."
# Limits that protect against damaged or forged files. Networks stay far below them.
MOST_TENSORS, MOST_BYTES = 4096, 2**28


def packed(tensors: Mapping[str, np.ndarray], colour: str) -> bytes:
    """The contents of a file with the given ``tensors`` in 16 bits, and the mark that names the image ``colour``.

    The tensors have four dimensions or one.
    """
    body, table = bytearray(12), bytearray()
    everything = dict(tensors) | {MARK + colour: np.ones(1)}
    for name, tensor in everything.items():
        body += bytes(-len(body) % ALIGNMENT)
        table += struct.pack("<H", len(name)) + name.encode() + struct.pack("<B", tensor.ndim)
        table += struct.pack(f"<{tensor.ndim}I", *tensor.shape)
        table += (b"oihw" if tensor.ndim == 4 else b"x") + b"h" + struct.pack("<Q", len(body))
        body += np.ascontiguousarray(tensor, "<f2").tobytes()
    body += bytes(-len(body) % ALIGNMENT)
    body[:12] = struct.pack("<HBBQ", MAGIC, VERSION, 0, len(body))
    return bytes(body + struct.pack("<I", len(everything)) + table)


def read(path: Path) -> tuple[bytes, str]:
    """The contents of a file, and the name of the image that its network takes as colour input: "primal", or a base.

    Raises NgptError if the file is of another format, is damaged, or was not written by ngpt.
    """
    data = read_bytes(path, MOST_BYTES)
    shapes = _shapes(data, path)
    marks = [name.removeprefix(MARK) for name in shapes if name.startswith(MARK)]
    if len(marks) != 1 or marks[0] not in ("primal", *BASES):
        raise NgptError(
            f"{path}: was not written by `ngpt export`: it does not say which image it denoises; use it with OIDN's "
            "own tools"
        )
    return data, marks[0]


def _shapes(data: bytes, path: Path) -> dict[str, tuple[int, ...]]:
    """Returns the shape of each tensor in a file, by name.

    Raises NgptError if the file is damaged or of another format.
    """
    try:
        magic, version, _, place = struct.unpack_from("<HBBQ", data)
        if magic != MAGIC or version != VERSION:
            raise NgptError(f"{path}: is no .tza file of version {VERSION}")
        (count,) = struct.unpack_from("<I", data, place)
        place, shapes = place + 4, {}
        for _ in range(min(count, MOST_TENSORS)):
            (length,) = struct.unpack_from("<H", data, place)
            name = data[place + 2 : place + 2 + length].decode()
            place += 2 + length
            (rank,) = struct.unpack_from("<B", data, place)
            shape = struct.unpack_from(f"<{rank}I", data, place + 1)
            place += 1 + 4 * rank + rank
            kind, begin = struct.unpack_from("<cQ", data, place)
            place += 9
            size = {b"f": 4, b"h": 2}[kind] * int(np.prod(shape, dtype=object))
            if begin + size > len(data):
                raise NgptError(f"{path}: tensor '{name}' lies beyond the end of the file; it is damaged")
            shapes[name] = shape
    except (struct.error, OverflowError, UnicodeDecodeError, KeyError) as error:
        raise NgptError(f"{path}: is no .tza file, or a damaged one") from error
    return shapes
