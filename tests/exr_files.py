"""OpenEXR files made and read without ngpt, so that tests do not trust what they test."""

import struct
from itertools import product
from pathlib import Path

import numpy as np
import OpenEXR
from exr_structure import TILED, Attribute, Chunk, Exr


def bits(array: np.ndarray) -> np.ndarray:
    """The array as unsigned integers: tells NaN from NaN and -0 from 0."""
    array = np.ascontiguousarray(array)
    return array.view(f"u{array.itemsize}")


def same_bits(a: np.ndarray, b: np.ndarray) -> bool:
    return a.dtype == b.dtype and a.shape == b.shape and np.array_equal(bits(a), bits(b))


def window(x: int, y: int, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    return np.array([x, y], np.int32), np.array([x + width - 1, y + height - 1], np.int32)


def write_raw(path: Path, *parts: tuple) -> Path:
    """Writes parts given as (channels,), (channels, header) or (channels, header, name)."""
    made = []
    for channels, *rest in parts:
        header = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION, **(rest[0] if rest else {})}
        arrays = {name: np.ascontiguousarray(array) for name, array in channels.items()}
        made.append(OpenEXR.Part(header, arrays, rest[1] if len(rest) > 1 else ""))
    OpenEXR.File(made).write(str(path))
    return path


def read_raw(path: Path) -> list[tuple[str, dict, dict[str, np.ndarray]]]:
    """Reads each part as (name, header, channels)."""
    parts = OpenEXR.File(str(path), separate_channels=True).parts
    return [(part.name(), part.header, {name: c.pixels for name, c in part.channels.items()}) for part in parts]


def comparable(value: object) -> object:
    """A header value in a form that == compares, for values of the types that OpenEXR returns."""
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    if isinstance(value, tuple):
        return tuple(comparable(item) for item in value)
    if isinstance(value, OpenEXR.PreviewImage):
        return value.pixels.tobytes()
    if isinstance(value, OpenEXR.OpaqueAttribute):
        return value.typeName, bytes(value.data)
    if isinstance(value, OpenEXR.Bytes):
        return value.type_hint, bytes(value.data)
    if isinstance(value, OpenEXR.TileDescription | OpenEXR.TimeCode | OpenEXR.KeyCode):
        return repr(value)
    return type(value).__name__, value


def noise(rng: np.random.Generator, shape: tuple[int, ...], dtype: type) -> np.ndarray:
    """Random bit patterns: NaN with payloads, Inf, -0, subnormals and the largest numbers are among them."""
    width = np.dtype(dtype).itemsize
    array = rng.integers(0, 2 ** (8 * width), shape, dtype=f"u{width}").view(dtype)
    if np.dtype(dtype).kind == "f":
        special = np.array([np.nan, -np.nan, np.inf, -np.inf, -0.0, np.finfo(dtype).smallest_subnormal], dtype)
        array = np.where(rng.random(shape) < 0.2, rng.choice(special, shape), array)
        # A signalling NaN turns into a quiet one in any arithmetic, conversion to float32 included.
        array = np.where(np.isnan(array), np.array(np.nan, dtype), array)
    return array


def write_levels(path: Path, pixels: np.ndarray, rip: bool) -> Path:
    """Writes 4x4 pixels as one tile with all mipmap or ripmap levels, smaller levels full of 99.

    Byte by byte, since OpenEXR's Python module cannot write such files.
    """
    box = struct.pack("<4i", 0, 0, 3, 3)
    channels = b"".join(name + b"\0" + struct.pack("<iB3x2i", 2, 0, 1, 1) for name in (b"B", b"G", b"R")) + b"\0"
    attributes = [
        Attribute(b"channels", b"chlist", channels),
        Attribute(b"compression", b"compression", b"\0"),
        Attribute(b"dataWindow", b"box2i", box),
        Attribute(b"displayWindow", b"box2i", box),
        Attribute(b"lineOrder", b"lineOrder", b"\0"),
        Attribute(b"pixelAspectRatio", b"float", struct.pack("<f", 1)),
        Attribute(b"screenWindowCenter", b"v2f", struct.pack("<2f", 0, 0)),
        Attribute(b"screenWindowWidth", b"float", struct.pack("<f", 1)),
        Attribute(b"tiles", b"tiledesc", struct.pack("<2IB", 4, 4, 2 if rip else 1)),
    ]
    chunks = []
    for y, x in product(range(3), range(3)) if rip else zip(range(3), range(3), strict=True):
        level = np.full((4 >> y, 4 >> x, 3), 99) if x or y else pixels
        chunks.append(Chunk([0, 0, x, y], level[..., ::-1].transpose(0, 2, 1).astype("<f4").tobytes()))
    path.write_bytes(Exr(2 | TILED, [attributes], [len(chunks)], chunks).pack())
    return path
