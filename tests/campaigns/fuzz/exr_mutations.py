"""Broken OpenEXR files: valid stacks with one to four things wrong with them, a function of a number each."""

import io
import random
import struct
import zlib
from collections.abc import Callable
from copy import deepcopy
from functools import cache

import numpy as np
import OpenEXR
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
    b"A",
    b"a" * 32,
    b"b" * 300,
    b"\xff\xfe",
    b"R\x7f",
    b"name",
    b"type",
)
NAMES += (b"dataWindow", b"channels", b"chunkCount", b"tiles", b"dx.R", b"...", b"ngpt:spp", b"view", b"multiView")
TYPES = (b"scanlineimage", b"tiledimage", b"deepscanline", b"deeptile", b"", b"mine")


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


def mutate(number: int) -> bytes:
    """File ``number``."""
    rng = random.Random(number)
    exr = deepcopy(parse(rng.choice(seeds())))
    for _ in range(rng.choice((1, 1, 1, 2, 3, 4))):
        change = rng.choices((attribute, image, chunks), (9, 13, 12))[0]
        change(rng, exr)
    data = exr.pack()
    for _ in range(rng.choice((0, 0, 0, 1, 2))):
        data = spliced(rng, data) if rng.random() < 0.2 else rng.choice(RAW)(rng, data)
    return data


# --- changes of a file that is taken apart ---------------------------------------------------------------------------


def _named(rng: random.Random, exr: Exr, name: bytes | None = None) -> Attribute:
    """An attribute of that name, or any."""
    found = [each for part in exr.parts for each in part if name in (None, each.name)]
    return rng.choice(found) if found else Attribute(b"x", b"int", bytes(4))


def _set(rng: random.Random, exr: Exr, name: bytes, kind: bytes, data: bytes) -> None:
    """Adds an attribute; in half of the cases it replaces all attributes of the same name."""
    part = rng.choice(exr.parts)
    if rng.random() < 0.5:
        part[:] = [each for each in part if each.name != name]
    part.append(Attribute(name, kind, data))


def attribute(rng: random.Random, exr: Exr) -> None:
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


def image(rng: random.Random, exr: Exr) -> None:
    """What says how the image is stored: windows, channels, compression, tiles, kinds of parts, their number."""
    match rng.randrange(13):
        case 0:
            corner = [rng.choice(INTEGERS) for _ in range(2)]
            size = [rng.choice((0, 1, 17, 20, rng.choice(INTEGERS))) for _ in range(2)]
            values = [*corner, corner[0] + size[0] - 1, corner[1] + size[1] - 1]
            window = _named(rng, exr, rng.choice((b"dataWindow", b"displayWindow")))
            window.data = struct.pack("<4i", *(max(-(2**31), min(2**31 - 1, value)) for value in values))
        case 1:
            window = _named(rng, exr, b"dataWindow")
            window.data = _number_into(rng, window.data)
        case 2:
            # More than a body of a few kB can hold, in few chunks.
            width, height = rng.choice((65535, 2**20, 2**26)), rng.choice((1, 16, 256, 1024, 65535))
            _named(rng, exr, b"dataWindow").data = struct.pack("<4i", 0, 0, width - 1, height - 1)
        case 3 | 4 | 5:
            channels(rng, _named(rng, exr, b"channels"))
        case 6:
            _named(rng, exr, b"compression").data = bytes([rng.choice((*range(14), 255))])
        case 7:
            _named(rng, exr, b"lineOrder").data = bytes([rng.choice((0, 1, 2, 3, 255))])
        case 8:
            sides = (rng.choice(INTEGERS) & 0xFFFFFFFF for _ in range(2))
            data = struct.pack("<2IB", *sides, rng.choice((0, 1, 2, 16, 17, 18, 255)))
            _set(rng, exr, b"tiles", b"tiledesc", data)
        case 9:
            _set(rng, exr, b"type", b"string", rng.choice(TYPES))
        case 10:
            exr.flags ^= rng.choice((0x200, 0x400, 0x800, 0x1000, 0x1200, 1, 2, 0x100, 0x80000000))
        case 11:
            for _ in exr.parts:
                _set(rng, exr, b"name", b"string", b"part0")
        case 12:
            exr.parts.append(deepcopy(rng.choice(exr.parts)))
            exr.flags |= 0x1000


def channels(rng: random.Random, listed: Attribute) -> None:
    """One channel or several: another name, type, step or order; gone, twice, very many."""
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
            entries.extend([b"left", 1, 0, 1, 1] if rng.random() < 0.5 else [b"left.R", 2, 0, 1, 1] for _ in range(2))
        case 6:
            entries.extend([b"c%06d" % i, rng.randrange(3), 0, 1, 1] for i in range(rng.choice((50, 2000, 100_000))))
        case 7:
            rng.shuffle(entries)
    if rng.random() < 0.7:
        entries.sort(key=lambda entry: entry[0])
    listed.data = b"".join(name + b"\0" + struct.pack("<iB3x2i", *rest) for name, *rest in entries) + b"\0"


def chunks(rng: random.Random, exr: Exr) -> None:
    """The pieces that the image is stored in: where they begin, their order, places and sizes, and what is in them."""
    chunk = rng.choice(exr.chunks) if exr.chunks else None
    match rng.randrange(12):
        case 0:
            _set(rng, exr, b"chunkCount", b"int", struct.pack("<i", rng.choice(INTEGERS)))
        case 1:
            for _ in range(rng.choice((1, 1, 3))):
                place = rng.randrange(max(sum(exr.counts), 1))
                exr.offsets[place] = rng.choice(
                    (*INTEGERS, 2**63 - 1, 2**63, rng.randrange(20_000), rng.randrange(400))
                )
        case 2:
            rng.shuffle(exr.chunks)
        case 3:
            del exr.chunks[rng.randrange(len(exr.chunks) + 1) :]
        case 4 if chunk:
            chunk.numbers[rng.randrange(len(chunk.numbers))] = rng.choice(INTEGERS)
        case 5 if chunk:
            chunk.size = rng.choice((*INTEGERS, rng.randrange(5000)))
        case 6 if chunk:
            size = rng.choice((0, 1, len(chunk.data), rng.randrange(5000)))
            chunk.data = rng.choice((rng.randbytes(size), bytes(size), b"\xff" * size, zlib.compress(bytes(size))))
        case 7 | 8 | 9 if chunk:
            # The decoder's own state: counts and tables stand at a chunk's beginning.
            data = bytearray(chunk.data)
            for _ in range(rng.choice((1, 1, 4, 16)) if data else 0):
                place = rng.randrange(len(data) if rng.random() < 0.5 else min(len(data), 40))
                data[place] = rng.choice((0, 255, rng.randrange(256)))
            chunk.data = bytes(data)
        case 10 if chunk:
            chunk.data = _number_into(rng, chunk.data)
        case 11 if chunk:
            chunk.data = zlib.compress(bytes(rng.choice((10**5, 10**7))))


# --- changes of bytes -------------------------------------------------------------------------------------------------


def _number_into(rng: random.Random, data: bytes) -> bytes:
    place = rng.randrange(max(len(data) - 3, 1)) if rng.random() < 0.5 else rng.randrange(len(data) // 4 + 1) * 4
    size = rng.choice((2, 4, 4, 8))
    number = (rng.choice(INTEGERS) & (2 ** (8 * size) - 1)).to_bytes(size, "little")
    return data[:place] + number + data[place + size :]


def bytes_flipped(rng: random.Random, data: bytes) -> bytes:
    flipped = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 8, 64)) if data else 0):
        place = rng.randrange(len(flipped) if rng.random() < 0.5 else min(len(flipped), 600))
        flipped[place] ^= 1 << rng.randrange(8)
    return bytes(flipped)


def file_cut_off(rng: random.Random, data: bytes) -> bytes:
    return data[: rng.randrange(len(data) + 1)]


def bytes_inserted(rng: random.Random, data: bytes) -> bytes:
    place = rng.randrange(len(data) + 1)
    return data[:place] + rng.randbytes(rng.choice((1, 4, 100))) + data[place:]


def bytes_removed(rng: random.Random, data: bytes) -> bytes:
    place = rng.randrange(len(data) + 1)
    return data[:place] + data[place + rng.choice((1, 4, 100)) :]


def spliced(rng: random.Random, data: bytes) -> bytes:
    other = rng.choice(seeds())
    return data[: rng.randrange(len(data) + 1)] + other[rng.randrange(len(other)) :]


RAW: tuple[Callable, ...] = (bytes_flipped, bytes_flipped, file_cut_off, bytes_inserted, bytes_removed)
