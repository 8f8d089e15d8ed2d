"""OpenEXR files taken apart into what they are made of, and put together again, whole or broken.

Written from the format's description (openexr.com, "OpenEXR File Layout") and not from ngpt.io.header, which it tests.
"""

import struct
from dataclasses import dataclass, field

MAGIC = b"\x76\x2f\x31\x01"
TILED, LONG_NAMES, DEEP, MULTIPART = 0x200, 0x400, 0x800, 0x1000
LINES = {0: 1, 1: 1, 2: 1, 3: 16, 4: 32, 5: 16, 6: 32, 7: 32, 8: 32, 9: 256, 10: 256, 11: 32, 12: 256, 13: 1}


@dataclass
class Attribute:
    """``size`` is what the header says of the length of ``data``; None: the truth."""

    name: bytes
    kind: bytes
    data: bytes
    size: int | None = None

    def pack(self) -> bytes:
        size = len(self.data) if self.size is None else self.size
        return self.name + b"\0" + self.kind + b"\0" + struct.pack("<i", size) + self.data


@dataclass
class Chunk:
    """``numbers``: part (multi-part files), then y, or tile x, y and levels. ``size``: as of attributes."""

    numbers: list[int]
    data: bytes
    size: int | None = None

    def pack(self) -> bytes:
        size = len(self.data) if self.size is None else self.size
        return struct.pack(f"<{len(self.numbers) + 1}i", *self.numbers, size) + self.data


@dataclass
class Exr:
    """``offsets`` replaces single entries of the offset tables, by position; the others are right."""

    flags: int
    parts: list[list[Attribute]]
    counts: list[int]
    chunks: list[Chunk]
    magic: bytes = MAGIC
    offsets: dict[int, int] = field(default_factory=dict)

    @property
    def multipart(self) -> bool:
        return bool(self.flags & MULTIPART)

    def pack(self) -> bytes:
        header = self.magic + struct.pack("<I", self.flags)
        for attributes in self.parts:
            header += b"".join(attribute.pack() for attribute in attributes) + b"\0"
        header += b"\0" if self.multipart else b""
        position = len(header) + 8 * sum(self.counts)
        body, table = [chunk.pack() for chunk in self.chunks], []
        for piece in body:
            table.append(position)
            position += len(piece)
        table = (table + [0] * sum(self.counts))[: sum(self.counts)]
        for place, value in self.offsets.items():
            if table:
                table[place % len(table)] = value
        return header + b"".join(struct.pack("<Q", value & (2**64 - 1)) for value in table) + b"".join(body)


def parse(data: bytes) -> Exr:
    """A valid file, not deep, with one level."""
    flags = struct.unpack_from("<I", data, 4)[0]
    position, parts = 8, []
    while data[position] or not parts:
        attributes = []
        while data[position]:
            name, position = _string(data, position)
            kind, position = _string(data, position)
            size = struct.unpack_from("<i", data, position)[0]
            attributes.append(Attribute(name, kind, data[position + 4 : position + 4 + size]))
            position += 4 + size
        parts.append(attributes)
        position += 1
        if not flags & MULTIPART:
            break
    position += 1 if flags & MULTIPART else 0
    counts = [_chunk_count(attributes) for attributes in parts]
    exr, lead = Exr(flags, parts, counts, []), 1 if flags & MULTIPART else 0
    first = position
    for part, count in enumerate(counts):
        numbers = lead + (4 if _find(parts[part], b"tiles") else 1)
        for i in range(count):
            (offset,) = struct.unpack_from("<Q", data, first + 8 * (sum(counts[:part]) + i))
            *head, size = struct.unpack_from(f"<{numbers + 1}i", data, offset)
            begin = offset + 4 * (numbers + 1)
            exr.chunks.append(Chunk(head, data[begin : begin + size]))
    return exr


def _chunk_count(attributes: list[Attribute]) -> int:
    x0, y0, x1, y1 = struct.unpack("<4i", _find(attributes, b"dataWindow").data)
    width, height = x1 - x0 + 1, y1 - y0 + 1
    tiles = _find(attributes, b"tiles")
    if tiles:
        across, down = struct.unpack_from("<2I", tiles.data)
        return -(-width // across) * -(-height // down)
    return -(-height // LINES[_find(attributes, b"compression").data[0]])


def _find(attributes: list[Attribute], name: bytes) -> Attribute | None:
    return next((attribute for attribute in attributes if attribute.name == name), None)


def _string(data: bytes, position: int) -> tuple[bytes, int]:
    end = data.index(b"\0", position)
    return data[position:end], end + 1
