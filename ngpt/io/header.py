"""Reads headers of OpenEXR files without the library OpenEXR, to check their sizes before pixels are decoded.

A header of some hundred bytes can announce a terabyte, or a hundred thousand channels. The limits are far above the
sizes that renderers write. Layout of the format: https://openexr.com/en/latest/OpenEXRFileLayout.html
"""

import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO

from ngpt.errors import NgptError
from ngpt.system.limits import memory

MAX_HEADER = 2**24  # bytes of all headers of a file
MAX_ATTRIBUTES = 10_000
MAX_CHANNELS = 4096
MAX_PIXELS = 2**28  # in one part: 16384 x 16384
MAX_TILE = 2**20  # pixels of a tile that is larger than its image

MAGIC = b"\x76\x2f\x31\x01"
_DEEP, _MULTIPART = 0x800, 0x1000
_TYPES = {0: 4, 1: 2, 2: 4}  # uint, half, float: bytes
# Number of the compression -> lines in a chunk, and the most bytes of an image that one byte of the file can hold: 1032
# for deflate, 64 for run lengths, and generous bounds for others, which store flat blocks in very few bytes.
_COMPRESSIONS = {
    **{0: (1, 1), 1: (1, 64), 2: (1, 1032), 3: (16, 1032), 4: (32, 2**12), 5: (16, 2**11), 6: (32, 12), 7: (32, 12)},
    **{8: (32, 2**16), 9: (256, 2**16), 10: (256, 2**16), 11: (32, 2**16)},
    **{12: (256, 2**16), 13: (1, 2**16)},
}


@dataclass(frozen=True)
class PartHeader:
    """The header of a part of a file.

    ``name``      its name; "" if it has none
    ``label``     "part 0 'left'", for messages
    ``size``      (width, height) of the data window in pixels
    ``channels``  name -> (bytes of a value, x and y step of its subsampling)
    ``deep``      whether pixels hold lists of samples
    ``chunks``    number of chunks of the full-size image
    ``table``     number of entries in the table of offsets, which may also have the chunks of smaller levels
    ``tiled``     whether chunks are tiles
    ``ratio``     the most bytes of an image that one byte of the file can hold
    ``attributes``  name -> type and data, as they are in the file
    """

    name: str
    label: str
    size: tuple[int, int]
    channels: dict[str, tuple[int, tuple[int, int]]]
    deep: bool
    chunks: int
    table: int
    tiled: bool
    ratio: int
    attributes: dict[str, tuple[str, bytes]]

    def number(self, attribute: str) -> float | None:
        """The value of an attribute; None if it is absent or no number."""
        kind, data = self.attributes.get(attribute, ("", b""))
        code = {"int": "<i", "float": "<f", "double": "<d"}.get(kind)
        return struct.unpack(code, data)[0] if code and len(data) == struct.calcsize(code) else None

    def text(self, attribute: str) -> str:
        """The value of an attribute; "" if it is absent or no string."""
        kind, data = self.attributes.get(attribute, ("", b""))
        return data.decode(errors="replace") if kind == "string" else ""

    def texts(self, attribute: str) -> list[str]:
        """The strings of an attribute; none if it is absent or no list of strings."""
        kind, data = self.attributes.get(attribute, ("", b""))
        found = []
        while kind == "stringvector" and len(data) >= 4:
            (length,) = struct.unpack_from("<i", data)
            found.append(data[4 : 4 + max(length, 0)].decode(errors="replace"))
            data = data[4 + max(length, 0) :]
        return found

    @property
    def bytes(self) -> int:
        """The size of the decoded image in bytes."""
        return self.size[0] * self.size[1] * sum(size for size, _ in self.channels.values())


def read_headers(file: BinaryIO, path: str) -> list[PartHeader]:
    """The headers of the parts of an open file.

    Raises NgptError if the file is not OpenEXR, if a header is damaged, exceeds a limit above or does not fit the
    length of the file, and if the pixels would need more than half of the memory.
    """
    magic = file.read(4)
    if not magic:
        raise NgptError(f"{path}: is empty; render or copy it again")
    if magic != MAGIC:
        raise NgptError(
            f"{path}: not an OpenEXR file, nor PFM, Radiance HDR, PNG, TIFF or JPEG (it starts with {magic!r}); "
            "save the image as .exr"
        )
    try:
        flags = struct.unpack("<I", file.read(4))[0]
        if flags & 0xFF != 2:
            raise NgptError(f"{path}: is of OpenEXR version {flags & 0xFF}, and ngpt reads 2; save it anew")
        parts = [_part(i, values, flags) for i, values in enumerate(_headers(file, flags))]
        names = [part.name for part in parts]
        twice = next((name for i, name in enumerate(names) if name and name in names[:i]), None)
        if twice:
            raise _Damage(f"two parts are called '{twice[:40]}'")
    except _Damage as damage:
        raise NgptError(f"{path}: damaged or incomplete ({damage}); render or copy it again") from None
    except (struct.error, IndexError):
        raise NgptError(f"{path}: damaged or incomplete (its header ends early); render or copy it again") from None
    except _Excess as excess:
        raise NgptError(f"{path}: {excess}; if you trust the file, save it in pieces") from None
    check_size(parts, os.fstat(file.fileno()).st_size, path)
    return parts


class _Damage(Exception):
    """A damaged header; the message is a phrase."""


class _Excess(Exception):
    """A size beyond a limit; the message is a phrase."""


def _headers(file: BinaryIO, flags: int) -> Iterator[dict[bytes, tuple[bytes, bytes]]]:
    """The attributes of each part: name -> type, data."""
    count = 0
    while True:
        attributes: dict[bytes, tuple[bytes, bytes]] = {}
        while name := _string(file):
            kind, size = _string(file), struct.unpack("<i", file.read(4))[0]
            if name in attributes:
                raise _Damage(f"attribute {name!r} comes twice")
            count += 1
            if count > MAX_ATTRIBUTES:
                raise _Excess(f"its header has more than {MAX_ATTRIBUTES} attributes")
            if size < 0:
                raise _Damage(f"attribute {name!r} has {size} bytes")
            if file.tell() + size > MAX_HEADER:
                raise _Excess(f"its header is longer than {MAX_HEADER >> 20} MiB")
            data = file.read(size)
            if len(data) < size:
                raise _Damage("its header ends early")
            attributes[name] = kind, data
        if attributes:
            yield attributes
        # In a file of several parts, an empty header follows the last one.
        if not (flags & _MULTIPART and attributes):
            return


def _string(file: BinaryIO) -> bytes:
    """The bytes up to the next zero; names and types have 255 characters at most."""
    text = bytearray()
    while (byte := file.read(1)) != b"\0":
        if not byte or len(text) == 255:
            raise _Damage(f"a name begins {bytes(text[:16])!r} and does not end" if byte else "its header ends early")
        text += byte
    return bytes(text)


def _part(index: int, attributes: dict[bytes, tuple[bytes, bytes]], flags: int) -> PartHeader:
    """The header of part number ``index``, from its attributes and the flags of the file."""

    def data(name: str, kind: str) -> bytes:
        if attributes.get(name.encode(), (b"",))[0] != kind.encode():
            raise _Damage(f"part {index} has no '{name}' of type {kind}")
        return attributes[name.encode()][1]

    name = data("name", "string").decode(errors="replace") if b"name" in attributes else ""
    kind = data("type", "string") if b"type" in attributes else b""
    label = f"part {index} '{name[:40]}'" if name else f"part {index}"
    left, top, right, bottom = struct.unpack("<4i", data("dataWindow", "box2i"))
    width, height = right - left + 1, bottom - top + 1
    if width < 1 or height < 1:
        raise _Damage(f"{label} is {width}x{height} pixels")
    number = data("compression", "compression")[0]
    if number not in _COMPRESSIONS:
        raise _Damage(f"{label} has compression {number}, which is none of OpenEXR's")
    lines, ratio = _COMPRESSIONS[number]
    chunks = -(-height // lines)
    tiled = kind in (b"tiledimage", b"deeptile") or bool(not kind and flags & 0x200)
    if tiled:
        across, down = struct.unpack_from("<2I", data("tiles", "tiledesc"))
        if not (0 < across < 2**31 and 0 < down < 2**31):
            raise _Damage(f"{label} has tiles of {across}x{down} pixels")
        # OpenEXR allocates memory for whole tiles, even if the image covers only a corner of one.
        if across * down > max(MAX_TILE, 4 * width * height):
            raise _Excess(f"{label} is {width}x{height} pixels in tiles of {across}x{down}")
        chunks = -(-width // across) * -(-height // down)
    table = max(struct.unpack("<i", data("chunkCount", "int"))[0], chunks) if b"chunkCount" in attributes else chunks
    channels = dict(_channels(data("channels", "chlist"), label))
    deep = kind.startswith(b"deep") or bool(flags & _DEEP)
    texts = {
        key.decode(errors="replace"): (kind.decode(errors="replace"), data) for key, (kind, data) in attributes.items()
    }
    return PartHeader(name, label, (width, height), channels, deep, chunks, table, tiled, ratio, texts)


def _channels(data: bytes, label: str) -> Iterator[tuple[str, tuple[int, tuple[int, int]]]]:
    names: set[bytes] = set()
    position = 0
    while data[position]:
        end = data.index(b"\0", position) if b"\0" in data[position : position + 256] else len(data)
        name, (kind, x, y) = data[position:end], struct.unpack_from("<i4x2i", data, end + 1)
        position = end + 17
        if name in names:
            raise _Damage(f"{label} has two channels {name!r}")
        if kind not in _TYPES:
            raise _Damage(f"channel {name!r} of {label} is of type {kind}, which is none of OpenEXR's")
        names.add(name)
        if len(names) > MAX_CHANNELS:
            raise _Excess(f"{label} has more than {MAX_CHANNELS} channels")
        yield name.decode(errors="replace"), (_TYPES[kind], (x, y))
    if not names:
        raise _Damage(f"{label} has no channels")


def check_size(parts: list[PartHeader], length: int, path: str) -> None:
    """Raises NgptError for parts beyond the limits above, and for parts that a file of ``length`` bytes cannot hold."""
    if not parts:
        raise NgptError(f"{path}: damaged or incomplete (it has no parts); render or copy it again")
    for part in parts:
        width, height = part.size
        if width * height > MAX_PIXELS:
            raise NgptError(
                f"{path}: {part.label} is {width}x{height} pixels, and {MAX_PIXELS >> 20} million are read at most; "
                "if you trust the file, render or save it in pieces"
            )
    channels = sum(len(part.channels) for part in parts)
    if channels > MAX_CHANNELS:
        raise NgptError(f"{path}: has {channels} channels, and {MAX_CHANNELS} are read at most; keep those you need")
    if any(part.deep for part in parts):
        return
    # The least length of the file: 16 bytes for each chunk (its entry in the table, its size and its place), and the
    # data of all pixels at the highest compression.
    least = sum(16 * part.chunks + (part.bytes // part.ratio) for part in parts)
    wanted = sum(part.bytes for part in parts)
    if least > length:
        sizes = ", ".join("x".join(map(str, part.size)) for part in parts[:4])
        raise NgptError(
            f"{path}: damaged or incomplete ({length} bytes cannot hold {channels} channels of {sizes} pixels); "
            "render or copy it again"
        )
    if wanted > memory() // 2:
        raise NgptError(
            f"{path}: its {channels} channels take {wanted / 2**30:.1f} GiB, more than half of the "
            f"{memory() / 2**30:.1f} GiB of memory; keep the channels that are needed, or cut it into pieces"
        )
