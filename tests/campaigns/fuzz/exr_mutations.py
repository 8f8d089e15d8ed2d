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


@cache
def seeds() -> tuple[tuple[str, bytes], ...]:
    """Valid stacks, 20x17 pixels, of every compression, layout and pixel type that files of users have."""
    made, rng = [], np.random.default_rng(7)
    for name, number in sorted(OpenEXR.Compression.__members__.items()):
        if name.startswith(("NUM", "ZSTD", "LJ2K")):  # for deep images, and reserved
            continue
        layers = {"": "f2" if number != OpenEXR.ZIP_COMPRESSION else "f4", "albedo.": "f2", "dx.": "f4", "dy.": "f4"}
        made.append((name, _file([_channels(rng, layers)], {"compression": number})))
    tiles = OpenEXR.TileDescription()
    tiles.xSize = tiles.ySize = 8
    tiled = {"type": OpenEXR.tiledimage, "tiles": tiles, "compression": OpenEXR.ZIPS_COMPRESSION}
    made.append(("tiles", _file([_channels(rng, {"": "f4", "dx.": "f4", "dy.": "f4", "id.": "u4"})], tiled)))
    names = {"compression": OpenEXR.RLE_COMPRESSION, "owner": "me", "ngpt:spp": 4, "multiView": ["left", "right"]}
    parts = [_channels(rng, {"": "f2"}), _channels(rng, {"dx.": "f4"}), _channels(rng, {"dy.": "f4", "A": "f2"})]
    made.append(("parts", _file(parts, names)))
    made.append(("tiled parts", _file(parts, tiled)))
    return tuple(made)


def _channels(rng: np.random.Generator, layers: dict[str, str]) -> dict[str, np.ndarray]:
    names = [(f"{layer}{suffix}", kind) for layer, kind in layers.items() for suffix in "RGB"]
    smooth = np.add.outer(np.arange(17), np.arange(20)) / 16
    return {
        name: np.ascontiguousarray(smooth + rng.random((17, 20)) * (rng.random((17, 20)) < 0.3)).astype(kind)
        for name, kind in names
    }


def _file(parts: list[dict[str, np.ndarray]], header: dict) -> bytes:
    several = len(parts) > 1
    made = [
        OpenEXR.Part({"type": OpenEXR.scanlineimage} | header, channels, f"part{i}" if several else "")
        for i, channels in enumerate(parts)
    ]
    stream = io.BytesIO()
    OpenEXR.File(made).write(stream)
    return stream.getvalue()


def mutate(number: int) -> tuple[str, bytes]:
    """File ``number``, and what was done to it."""
    rng = random.Random(number)
    kind, data = rng.choice(seeds())
    exr, done = deepcopy(parse(data)), []
    for _ in range(rng.choice((1, 1, 1, 2, 3, 4))):
        change = rng.choice(CHANGES)
        change(rng, exr)
        done.append(change.__name__.strip("_"))
    data = exr.pack()
    for _ in range(rng.choice((0, 0, 0, 1, 2))):
        change = rng.choice(RAW)
        data = change(rng, data)
        done.append(change.__name__.strip("_"))
    return f"{kind}: {', '.join(done)}", data


def _attribute(rng: random.Random, exr: Exr) -> Attribute:
    return rng.choice(rng.choice([part for part in exr.parts if part] or [[Attribute(b"x", b"int", bytes(4))]]))


def _named(rng: random.Random, exr: Exr, name: bytes) -> Attribute:
    found = [attribute for part in exr.parts for attribute in part if attribute.name == name]
    return rng.choice(found) if found else _attribute(rng, exr)


def attribute_dropped(rng, exr):
    part = rng.choice(exr.parts)
    if part:
        part.pop(rng.randrange(len(part)))


def attribute_twice(rng, exr):
    part = rng.choice(exr.parts)
    part.insert(rng.randrange(len(part) + 1), deepcopy(_attribute(rng, exr)))


def attribute_renamed(rng, exr):
    _attribute(rng, exr).name = rng.choice(NAMES)


def attribute_of_another_type(rng, exr):
    _attribute(rng, exr).kind = rng.choice(KINDS)


def attribute_with_other_bytes(rng, exr):
    _attribute(rng, exr).data = rng.randbytes(rng.choice((0, 1, 3, 4, 8, 16, 20, 64, 1000)))


def attribute_with_numbers(rng, exr):
    attribute = _attribute(rng, exr)
    attribute.data = _number_into(rng, attribute.data)


def attribute_that_lies_about_its_size(rng, exr):
    _attribute(rng, exr).size = rng.choice(INTEGERS)


def attribute_of_a_megabyte(rng, exr):
    rng.choice(exr.parts).append(Attribute(b"ballast", rng.choice(KINDS), bytes(rng.choice((10**5, 2**20)))))


def header_of_many_attributes(rng, exr):
    for i in range(rng.choice((100, 3000))):
        rng.choice(exr.parts).append(Attribute(b"a%d" % i, b"int", struct.pack("<i", i)))


def window_moved(rng, exr):
    window = _named(rng, exr, rng.choice((b"dataWindow", b"displayWindow")))
    corner = [rng.choice(INTEGERS) for _ in range(2)]
    size = [rng.choice((0, 1, 17, 20, rng.choice(INTEGERS))) for _ in range(2)]
    values = [*corner, corner[0] + size[0] - 1, corner[1] + size[1] - 1]
    window.data = struct.pack("<4i", *(max(-(2**31), min(2**31 - 1, value)) for value in values))


def window_with_numbers(rng, exr):
    window = _named(rng, exr, b"dataWindow")
    window.data = _number_into(rng, window.data)


def window_of_many_pixels(rng, exr):
    """More than a body of a few kB can hold, in few chunks."""
    height = rng.choice((1, 16, 256, 1024, 65535))
    _named(rng, exr, b"dataWindow").data = struct.pack("<4i", 0, 0, rng.choice((65535, 2**20, 2**26)) - 1, height - 1)


def channels_changed(rng, exr):
    channels = _named(rng, exr, b"channels")
    entries, data, position = [], channels.data, 0
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
    channels.data = b"".join(name + b"\0" + struct.pack("<iB3x2i", *rest) for name, *rest in entries) + b"\0"


def compression_changed(rng, exr):
    _named(rng, exr, b"compression").data = bytes([rng.choice((*range(14), 255))])


def line_order_changed(rng, exr):
    _named(rng, exr, b"lineOrder").data = bytes([rng.choice((0, 1, 2, 3, 255))])


def tiles_changed(rng, exr):
    data = struct.pack(
        "<2IB", *(rng.choice(INTEGERS) & 0xFFFFFFFF for _ in range(2)), rng.choice((0, 1, 2, 16, 17, 18, 255))
    )
    rng.choice(exr.parts).append(Attribute(b"tiles", b"tiledesc", data))
    if rng.random() < 0.7:
        _named(rng, exr, b"tiles").data = data


def type_changed(rng, exr):
    kinds = (b"scanlineimage", b"tiledimage", b"deepscanline", b"deeptile", b"", b"mine")
    for part in exr.parts if rng.random() < 0.5 else exr.parts[:1]:
        part[:] = [attribute for attribute in part if attribute.name != b"type"]
        part.append(Attribute(b"type", b"string", rng.choice(kinds)))


def flags_changed(rng, exr):
    exr.flags ^= rng.choice((0x200, 0x400, 0x800, 0x1000, 0x1200, 1, 2, 0x100, 0x80000000))


def part_names_alike(rng, exr):
    for part in exr.parts:
        part[:] = [attribute for attribute in part if attribute.name != b"name"]
        part.append(Attribute(b"name", b"string", b"part0"))


def part_added(rng, exr):
    exr.parts.append(deepcopy(rng.choice(exr.parts)))
    exr.flags |= 0x1000


def chunk_count_changed(rng, exr):
    rng.choice(exr.parts).append(Attribute(b"chunkCount", b"int", struct.pack("<i", rng.choice(INTEGERS))))


def offsets_changed(rng, exr):
    for _ in range(rng.choice((1, 1, 3))):
        place = rng.randrange(max(sum(exr.counts), 1))
        exr.offsets[place] = rng.choice((*INTEGERS, 2**63 - 1, 2**63, rng.randrange(20_000), rng.randrange(400)))


def chunks_shuffled(rng, exr):
    rng.shuffle(exr.chunks)


def chunks_dropped(rng, exr):
    del exr.chunks[rng.randrange(len(exr.chunks) + 1) :]


def chunk_place_changed(rng, exr):
    if exr.chunks:
        chunk = rng.choice(exr.chunks)
        chunk.numbers[rng.randrange(len(chunk.numbers))] = rng.choice(INTEGERS)


def chunk_size_changed(rng, exr):
    if exr.chunks:
        rng.choice(exr.chunks).size = rng.choice((*INTEGERS, rng.randrange(5000)))


def chunk_with_other_bytes(rng, exr):
    if exr.chunks:
        chunk = rng.choice(exr.chunks)
        size = rng.choice((0, 1, len(chunk.data), rng.randrange(5000)))
        chunk.data = rng.choice((rng.randbytes(size), bytes(size), b"\xff" * size, zlib.compress(bytes(size))))


def chunk_flipped(rng, exr):
    """The decoder's own state: counts and tables stand at a chunk's beginning."""
    for _ in range(rng.choice((1, 1, 4, 16))):
        if not exr.chunks:
            return
        chunk = rng.choice(exr.chunks)
        if chunk.data:
            data = bytearray(chunk.data)
            data[rng.randrange(len(data) if rng.random() < 0.5 else min(len(data), 40))] = rng.choice(
                (0, 255, rng.randrange(256))
            )
            chunk.data = bytes(data)


def chunk_with_numbers(rng, exr):
    if exr.chunks:
        chunk = rng.choice(exr.chunks)
        chunk.data = _number_into(rng, chunk.data)


def chunk_that_is_a_bomb(rng, exr):
    if exr.chunks:
        rng.choice(exr.chunks).data = zlib.compress(bytes(rng.choice((10**5, 10**7))))


def _number_into(rng: random.Random, data: bytes) -> bytes:
    place = rng.randrange(max(len(data) - 3, 1)) if rng.random() < 0.5 else rng.randrange(len(data) // 4 + 1) * 4
    size = rng.choice((2, 4, 4, 8))
    number = (rng.choice(INTEGERS) & (2 ** (8 * size) - 1)).to_bytes(size, "little")
    return data[:place] + number + data[place + size :]


def bytes_flipped(rng: random.Random, data: bytes) -> bytes:
    flipped = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 8, 64))):
        if flipped:
            flipped[rng.randrange(len(flipped) if rng.random() < 0.5 else min(len(flipped), 600))] ^= (
                1 << rng.randrange(8)
            )
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
    other = rng.choice(seeds())[1]
    return data[: rng.randrange(len(data) + 1)] + other[rng.randrange(len(other)) :]


CHANGES: tuple[Callable, ...] = (
    attribute_dropped, attribute_twice, attribute_renamed, attribute_of_another_type, attribute_with_other_bytes,
    attribute_with_numbers, attribute_that_lies_about_its_size, attribute_of_a_megabyte, header_of_many_attributes,
    window_moved, window_with_numbers, window_of_many_pixels, channels_changed, channels_changed, channels_changed,
    compression_changed, line_order_changed, tiles_changed, type_changed, flags_changed, part_names_alike, part_added,
    chunk_count_changed, offsets_changed, chunks_shuffled, chunks_dropped, chunk_place_changed, chunk_size_changed,
    chunk_with_other_bytes, chunk_flipped, chunk_flipped, chunk_flipped, chunk_with_numbers, chunk_with_numbers,
    chunk_that_is_a_bomb,
)  # fmt: skip
RAW: tuple[Callable, ...] = (bytes_flipped, bytes_flipped, file_cut_off, bytes_inserted, bytes_removed, spliced)
