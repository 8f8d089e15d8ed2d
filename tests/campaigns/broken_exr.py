"""Broken OpenEXR files: valid stacks with one to four things wrong with them, drawn from a ``random.Random``."""

import io
import struct
import zlib
from copy import deepcopy
from functools import cache
from random import Random

import numpy as np
import OpenEXR
from broken_data import bytes_changed
from exr_structure import Attribute, Exr, parse

INTEGERS = (0, 1, -1, 2, 7, 15, 16, 17, 255, 256, 65535, 65536, 2**24, 2**30, 2**31 - 1, -(2**31), -(2**31) + 1)
KINDS = (b"box2i", b"chlist", b"compression", b"float", b"int", b"string", b"stringvector", b"tiledesc", b"v2f")
KINDS += (b"preview", b"m44f", b"floatvector", b"bytes", b"idmanifest", b"deepImageState", b"mine", b"")
NAMES = (
    b"R",
    b"",
    b"left",
    b"left.R",
    b"primal.R",
    b"dx.R",
    b"A",
    b"a" * 32,
    b"b" * 300,
    b"\xff\xfe",
    b"R\x7f",
    b"...",
)
NAMES += (b"name", b"type", b"dataWindow", b"channels", b"chunkCount", b"tiles", b"ngpt:spp", b"view", b"multiView")
TYPES = (b"scanlineimage", b"tiledimage", b"deepscanline", b"deeptile", b"", b"mine")
FLAGS = (0x200, 0x400, 0x800, 0x1000, 0x1200, 1, 2, 0x100, 0x80000000)


@cache
def seeds() -> tuple[bytes, ...]:
    """Valid stacks, 20x17 pixels, of every compression, layout and pixel type that files of users have."""
    made, rng = [], np.random.default_rng(7)
    for name, number in sorted(OpenEXR.Compression.__members__.items()):
        if name.startswith("NUM"):
            continue
        layers = {"": "f2" if number != OpenEXR.ZIP_COMPRESSION else "f4", "albedo.": "f2", "dx.": "f4", "dy.": "f4"}
        made.append(_file([_channels(rng, layers)], {"compression": number}))
    tiles = OpenEXR.TileDescription()
    tiles.xSize = tiles.ySize = 8
    tiled = {"type": OpenEXR.tiledimage, "tiles": tiles, "compression": OpenEXR.ZIPS_COMPRESSION}
    made.append(_file([_channels(rng, {"": "f4", "dx.": "f4", "dy.": "f4", "id.": "u4"})], tiled))
    names = {"compression": OpenEXR.RLE_COMPRESSION, "owner": "me", "ngpt:spp": 4, "multiView": ["left", "right"]}
    parts = [_channels(rng, {"": "f2"}), _channels(rng, {"dx.": "f4"}), _channels(rng, {"dy.": "f4", "A": "f2"})]
    return (*made, _file(parts, names), _file(parts, tiled))


def _channels(rng: np.random.Generator, layers: dict[str, str]) -> dict[str, np.ndarray]:
    names = [(f"{layer}{suffix}", kind) for layer, kind in layers.items() for suffix in "RGB"]
    smooth = np.add.outer(np.arange(17), np.arange(20)) / 16
    return {
        name: np.ascontiguousarray(smooth + rng.random((17, 20)) * (rng.random((17, 20)) < 0.3)).astype(kind)
        for name, kind in names
    }


def _file(parts: list[dict[str, np.ndarray]], header: dict) -> bytes:
    made = [
        OpenEXR.Part({"type": OpenEXR.scanlineimage} | header, channels, f"part{i}" if len(parts) > 1 else "")
        for i, channels in enumerate(parts)
    ]
    stream = io.BytesIO()
    OpenEXR.File(made).write(stream)
    return stream.getvalue()


def exr_changed(rng: Random) -> bytes:
    """A broken file."""
    exr = deepcopy(parse(rng.choice(seeds())))
    for _ in range(rng.choice((1, 1, 2, 4))):
        rng.choice((attribute, attribute, image, image, channels, chunk, chunk, table))(rng, exr)
    data = exr.pack()
    match rng.randrange(5):
        case 0:
            data = bytes_changed(rng, data)
        case 1:
            # The beginning of one file and the end of another
            other = rng.choice(seeds())
            data = data[: rng.randrange(len(data) + 1)] + other[rng.randrange(len(other)) :]
    return data


def _named(rng: Random, exr: Exr, *names: bytes) -> Attribute:
    """An attribute of one of these names, or any."""
    found = [each for part in exr.parts for each in part if not names or each.name in names]
    return rng.choice(found) if found else Attribute(b"x", b"int", bytes(4))


def _number_into(rng: Random, data: bytes) -> bytes:
    place = rng.randrange(len(data) + 1) if rng.random() < 0.5 else rng.randrange(len(data) // 4 + 1) * 4
    size = rng.choice((2, 4, 4, 8))
    number = (rng.choice(INTEGERS) & (2 ** (8 * size) - 1)).to_bytes(size, "little")
    return data[:place] + number + data[place + size :]


def attribute(rng: Random, exr: Exr) -> None:
    """Any attribute: gone, twice, of another name, type, length or content; large ones, and many."""
    one, part = _named(rng, exr), rng.choice(exr.parts)
    match rng.randrange(9):
        case 0 if part:
            part.pop(rng.randrange(len(part)))
        case 1:
            part.insert(rng.randrange(len(part) + 1), deepcopy(one))
        case 2:
            one.name = rng.choice(NAMES)
        case 3:
            one.kind = rng.choice(KINDS)
        case 4:
            one.data = rng.randbytes(rng.choice((0, 1, 3, 4, 8, 16, 20, 64, 1000)))
        case 5:
            one.data = _number_into(rng, one.data)
        case 6:
            one.size = rng.choice(INTEGERS)
        case 7:
            part.append(Attribute(b"ballast", rng.choice(KINDS), bytes(rng.choice((10**5, 2**20)))))
        case 8:
            part.extend(Attribute(b"a%d" % i, b"int", struct.pack("<i", i)) for i in range(rng.choice((100, 3000))))


def image(rng: Random, exr: Exr) -> None:
    """What says how the image is stored: windows, compression, order of lines, tiles, kinds of parts, their number."""
    added = None
    match rng.randrange(9):
        case 0:
            window = _named(rng, exr, b"dataWindow", b"displayWindow")
            window.data = _number_into(rng, window.data)
        case 1:
            # More than a body of a few kB can hold, in few chunks
            width, height = rng.choice((65535, 2**20, 2**26)), rng.choice((1, 16, 256, 1024, 65535))
            _named(rng, exr, b"dataWindow").data = struct.pack("<4i", 0, 0, width - 1, height - 1)
        case 2:
            _named(rng, exr, b"compression", b"lineOrder").data = bytes([rng.choice((*range(14), 255))])
        case 3:
            sides = (rng.choice(INTEGERS) & 0xFFFFFFFF for _ in range(2))
            added = Attribute(
                b"tiles", b"tiledesc", struct.pack("<2IB", *sides, rng.choice((0, 1, 2, 16, 17, 18, 255)))
            )
        case 4:
            added = Attribute(b"type", b"string", rng.choice(TYPES))
        case 5:
            added = Attribute(b"chunkCount", b"int", struct.pack("<i", rng.choice(INTEGERS)))
        case 6:
            exr.flags ^= rng.choice(FLAGS)
        case 7:
            for part in exr.parts:
                part.append(Attribute(b"name", b"string", b"part0"))
        case 8:
            exr.parts.append(deepcopy(rng.choice(exr.parts)))
            exr.flags |= 0x1000
    if added:
        part = rng.choice(exr.parts)
        # In half of the cases it replaces the attribute of the same name.
        part[:] = [each for each in part if each.name != added.name or rng.random() < 0.5]
        part.append(added)


def channels(rng: Random, exr: Exr) -> None:
    """One channel or several: another name, type, step or order; gone, twice, very many."""
    listed = _named(rng, exr, b"channels")
    entries, data, position = [], listed.data, 0
    while (end := data.find(b"\0", position)) > position and len(data) >= end + 17:
        entries.append([data[position:end], *struct.unpack_from("<iB3x2i", data, end + 1)])
        position = end + 17
    if not entries:
        return
    match rng.randrange(8):
        case 0:
            rng.choice(entries)[0] = rng.choice(NAMES)
        case 1:
            rng.choice(entries)[1] = rng.choice((0, 1, 2, 3, -1, 2**31 - 1))
        case 2:
            rng.choice(entries)[3:] = [rng.choice((*INTEGERS, 2, 4)), rng.choice((1, 2, 4, 0, -1))]
        case 3:
            entries.append(deepcopy(rng.choice(entries)))
        case 4:
            entries.pop(rng.randrange(len(entries)))
        case 5:
            entries.extend([rng.choice((b"left", b"left.R")), 1, 0, 1, 1] for _ in range(2))
        case 6:
            entries.extend([b"c%06d" % i, i % 3, 0, 1, 1] for i in range(rng.choice((50, 2000, 100_000))))
        case 7:
            entries.reverse()
    if rng.random() < 0.7:
        entries.sort(key=lambda entry: entry[0])
    listed.data = b"".join(name + b"\0" + struct.pack("<iB3x2i", *rest) for name, *rest in entries) + b"\0"


def chunk(rng: Random, exr: Exr) -> None:
    """A piece of the image: its place, its size, and what is in it."""
    if not exr.chunks:
        return
    chunk = rng.choice(exr.chunks)
    match rng.randrange(7):
        case 0:
            chunk.numbers[rng.randrange(len(chunk.numbers))] = rng.choice(INTEGERS)
        case 1:
            chunk.size = rng.choice((*INTEGERS, rng.randrange(5000)))
        case 2:
            size = rng.choice((0, 1, len(chunk.data), rng.randrange(5000)))
            chunk.data = rng.choice((bytes(size), b"\xff" * size, zlib.compress(bytes(size))))
        case 3 | 4:
            # Decoders keep counts and tables at the beginning of a chunk.
            data = bytearray(chunk.data)
            for _ in range(rng.choice((1, 1, 4, 16)) if data else 0):
                place = rng.randrange(len(data) if rng.random() < 0.5 else min(len(data), 40))
                data[place] = rng.choice((0, 255, rng.randrange(256)))
            chunk.data = bytes(data)
        case 5:
            chunk.data = _number_into(rng, chunk.data)
        case 6:
            chunk.data = zlib.compress(bytes(rng.choice((10**5, 10**7))))


def table(rng: Random, exr: Exr) -> None:
    """Where the pieces begin, their order, and their number."""
    match rng.randrange(3):
        case 0:
            offset = rng.choice((*INTEGERS, 2**63 - 1, 2**63, rng.randrange(20_000), rng.randrange(400)))
            exr.offsets[rng.randrange(max(sum(exr.counts), 1))] = offset
        case 1:
            exr.chunks.reverse()
        case 2:
            del exr.chunks[rng.randrange(len(exr.chunks) + 1) :]
