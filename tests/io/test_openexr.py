"""OpenEXR files, verbatim: every attribute type, tiles and levels, lossy sources, memory layouts, and bad files."""

from fractions import Fraction

import numpy as np
import OpenEXR
import pytest
from exr_files import comparable, read_raw, same_bits, window, write_levels, write_raw

from ngpt.errors import NgptError
from ngpt.io.openexr import ExrImage, ExrPart, read_exr, write_exr

PIXELS = {name: np.arange(12, dtype=np.float32).reshape(3, 4) + 20 * i for i, name in enumerate("RGB")}


def preview():
    image = OpenEXR.PreviewImage(3, 2)
    for field in "rgba":
        image.pixels[field] = np.arange(6).reshape(2, 3) + ord(field)
    return image


ATTRIBUTES = {
    "owner": "Zoë",
    "x:empty string": "",
    "x:string with\nlines": "two\nlines",
    "multiView": ["left", "right"],
    "x:floats": [1.0, 2.0],
    "x:many floats": [0.5, float("nan"), float("-inf"), 1e-40],
    "x:float": 0.25,
    "x:nan": float("nan"),
    "x:int": -(2**31),
    "x:double": np.array([0.1]),
    "chromaticities": (0.5, 0.25, 0.375, 0.5, 0.125, 0.0625, 0.3125, 0.328125),
    "x:box2i": window(-4, 7, 9, 2),
    "x:box2f": (np.array([-0.5, 1], np.float32), np.array([2, 3.5], np.float32)),
    "originalDataWindow": window(-4, 7, 9, 2),
    **{f"x:v{n}{code}": np.array([1, -2.5, 3], code)[:n] for n in (2, 3) for code in ("i4", "f4", "f8")},
    **{f"x:m{n}{code}": (np.arange(n * n) / 10).reshape(n, n).astype(code) for n in (3, 4) for code in ("f4", "f8")},
    "framesPerSecond": Fraction(24000, 1001),
    "timeCode": OpenEXR.TimeCode(1, 2, 3, 4, 1, 0, 0, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8),
    "keyCode": OpenEXR.KeyCode(1, 2, 3, 4, 5, 4, 64),
    "envmap": OpenEXR.ENVMAP_CUBE,
    "preview": preview(),
    "x:opaque": OpenEXR.OpaqueAttribute(b"\0\1\2", "theirs"),
    "x:bytes": OpenEXR.Bytes(b"\0\1\2", "hint"),
    "x:compression": OpenEXR.PIZ_COMPRESSION,
    "x:lineOrder": OpenEXR.DECREASING_Y,
    "version": 1,
    "view": "left",
    "pixelAspectRatio": 2.0,
    "screenWindowCenter": np.array([0.5, 0.25], np.float32),
    "adoptedNeutral": np.array([0.25, 0.5], np.float32),
    "a name of more than thirty-one characters": 1,
}


@pytest.mark.parametrize("name", ATTRIBUTES)
def test_attributes_of_every_type_pass_through(tmp_path, name):
    source = write_raw(tmp_path / "a.exr", (PIXELS, {name: ATTRIBUTES[name]}))
    old = read_raw(source)[0][1]
    assert name in old
    new = read_raw(write_exr(tmp_path / "b.exr", read_exr(source)))[0][1]
    del old["channels"], new["channels"]
    assert repr({n: comparable(value) for n, value in new.items()}) == repr({n: comparable(old[n]) for n in old})


@pytest.mark.parametrize(
    ("value", "stored"),
    [
        (np.int64(5), 5),
        (np.float32(0.5), 0.5),
        (np.float64(0.5), 0.5),
        (np.str_("a"), "a"),
        (True, 1),
        ([np.float32(1), np.float64(2)], [1.0, 2.0]),
        (np.arange(16, dtype=np.float32).reshape(4, 4).T, np.arange(16, dtype=np.float32).reshape(4, 4).T.copy()),
        (np.arange(6, dtype=np.float32)[::2], np.array([0, 2, 4], np.float32)),
        (np.arange(4, dtype=np.int32)[::-2], np.array([3, 1], np.int32)),
        ((np.arange(4, dtype=np.int32)[::2], np.arange(4, dtype=np.int32)[2:]), window(0, 2, 3, 2)),
    ],
    ids=str,
)
def test_attributes_are_stored_as_they_mean(tmp_path, value, stored):
    path = write_exr(tmp_path / "a.exr", ExrImage([ExrPart("", {"x": value}, PIXELS)]))
    assert comparable(read_raw(path)[0][1]["x"]) == comparable(stored)


UNSTORABLE = [
    *(2**31, -(2**31) - 1, np.int64(2**40), 1e300, 1j, Fraction(2**31, 1), Fraction(1, 2**32), (1, 2**40)),
    *([1.0, 1e300], [1, 2], ["a", 1.0], np.arange(4), np.zeros((2, 2)), np.zeros(3, np.float16), np.array(["a"])),
    *(None, {}, b"a", object, OpenEXR.Rational(1, 2)),
]


@pytest.mark.parametrize("value", UNSTORABLE, ids=str)
def test_attributes_that_would_change_are_refused_by_name(tmp_path, value):
    message = not_written(tmp_path, ExrPart("", {"my:value": value}, PIXELS))
    assert "a.exr: attribute 'my:value' = " in message and "store it as a string" in message


def not_written(folder, part):
    """What is said of a part that cannot be written; no file is left."""
    with pytest.raises(NgptError) as caught:
        write_exr(folder / "a.exr", ExrImage([part]))
    assert "\n" not in str(caught.value) and not list(folder.iterdir())
    return str(caught.value)


@pytest.mark.parametrize("layout", ["[::-1]", "[1:, 2:]", ".T"])
@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.uint32])
def test_strided_arrays_are_not_written_as_garbage(tmp_path, layout, dtype):
    base = np.arange(80).reshape(8, 10).astype(dtype)
    views = {name: eval(f"base{layout}", {"base": base + dtype(i)}) for i, name in enumerate("RGB")}
    path = write_exr(tmp_path / "a.exr", ExrImage([ExrPart("", {}, views)]))
    for name, pixels in read_raw(path)[0][2].items():
        assert same_bits(pixels, np.ascontiguousarray(views[name]))


@pytest.mark.parametrize("compression", ["PXR24", "B44", "B44A", "DWAA", "DWAB", "LJ2K"])
@pytest.mark.parametrize("tiled", [False, True])
def test_lossy_sources_are_written_without_further_loss(tmp_path, compression, tiled):
    rng = np.random.default_rng(3)
    header = {"compression": getattr(OpenEXR, f"{compression}_COMPRESSION"), "owner": "me"}
    if tiled:
        header |= {"type": OpenEXR.tiledimage, "tiles": OpenEXR.TileDescription()}
    types = ["f4", "f4", "f4"] if compression == "LJ2K" else ["f2", "f4", "f2"]  # it loses nothing of mixed types
    channels = {name: rng.random((37, 41)).astype(dtype) for name, dtype in zip("RGB", types, strict=True)}
    source = write_raw(tmp_path / "a.exr", (channels, header))
    ((_, _, old),) = read_raw(source)
    assert any(not same_bits(old[name], channels[name]) for name in "RGB"), "the source must have lost something"
    image = read_exr(source)
    fresh = rng.random((37, 41)).astype(np.float32)
    image.parts[0].channels["dx.R"] = fresh
    ((_, new_header, new),) = read_raw(write_exr(tmp_path / "b.exr", image))
    assert all(same_bits(new[name], old[name]) for name in "RGB") and same_bits(new["dx.R"], fresh)
    assert new_header["compression"] == OpenEXR.ZIP_COMPRESSION and new_header["owner"] == "me"
    assert new_header["type"] == (OpenEXR.tiledimage if tiled else OpenEXR.scanlineimage)


@pytest.mark.parametrize("rip", [False, True])
def test_of_mipmaps_the_full_size_level_is_kept(tmp_path, rip):
    pixels = np.random.default_rng(4).random((4, 4, 3)).astype(np.float32)
    image = read_exr(write_levels(tmp_path / "a.exr", pixels, rip))
    assert image.parts[0].header["tiles"].mode == (OpenEXR.RIPMAP_LEVELS if rip else OpenEXR.MIPMAP_LEVELS)
    ((_, header, channels),) = read_raw(write_exr(tmp_path / "b.exr", image))
    tiles = header["tiles"]
    assert (tiles.mode, tiles.xSize, tiles.ySize) == (OpenEXR.ONE_LEVEL, 4, 4)
    assert header["type"] == OpenEXR.tiledimage
    for index, name in enumerate("RGB"):
        assert same_bits(channels[name], pixels[..., index])


@pytest.mark.parametrize(
    ("part", "expected"),
    [
        (ExrPart("", {}, {"R": np.zeros((2, 3))}), "channel 'R' is float64 (2, 3); OpenEXR stores"),
        (ExrPart("", {}, {"R": np.zeros((2, 3), np.uint8)}), "channel 'R' is uint8 (2, 3)"),
        (ExrPart("", {}, {"R": np.zeros((2, 3, 1), np.float32)}), "channel 'R' is float32 (2, 3, 1)"),
        (ExrPart("", {}, {**PIXELS, "A": np.zeros((2, 3), np.float32)}), "cannot be written as OpenEXR"),
        (ExrPart("", {"dataWindow": window(0, 0, 9, 9)}, PIXELS), "cannot be written as OpenEXR"),
        (ExrPart("", {"lineOrder": OpenEXR.RANDOM_Y}, PIXELS), "cannot be written as OpenEXR"),
        (ExrPart("", {}, {}), "cannot be written as OpenEXR"),
        (ExrPart("", {}, {"R": np.zeros((0, 3), np.float32)}), "cannot be written as OpenEXR"),
    ],
)
def test_what_openexr_cannot_hold_leaves_no_file(tmp_path, part, expected):
    message = not_written(tmp_path, part)
    assert expected in message and str(tmp_path / "a.exr") in message


def deep(path):
    samples = np.empty((1, 2), object)
    samples[0, 0], samples[0, 1] = np.ones(1, np.float32), np.ones(2, np.float32)
    write_header = {"type": OpenEXR.deepscanline, "compression": OpenEXR.ZIPS_COMPRESSION}
    OpenEXR.File(write_header, {"Z": samples}).write(str(path))


def subsampled(path):
    chroma = OpenEXR.Channel(np.ones((6, 8), np.float32), 2, 2)
    OpenEXR.File({"type": OpenEXR.scanlineimage}, {"Y": np.ones((6, 8), np.float32), "RY": chroma}).write(str(path))


@pytest.mark.parametrize(
    ("make", "expected"),
    [
        (lambda path: None, "not found; check the name"),
        (lambda path: path.mkdir(), "is a directory"),
        (lambda path: path.touch(), "is empty"),
        (
            lambda path: path.write_bytes(b"\x93NUMPY"),
            "PFM, Radiance HDR, PNG, TIFF or JPEG (it starts with b'\\x93NUM')",
        ),
        (lambda path: path.write_bytes(b"\x76\x2f"), "not an OpenEXR file"),
        (lambda path: path.write_bytes(b"\x76\x2f\x31\x01\x02\0\0\0nonsense"), "its header ends early"),
        (deep, "part 0 is a deep image; flatten it, or"),
        (subsampled, "channel 'RY' of part 0 is subsampled 2x2"),
    ],
)
def test_files_that_cannot_be_read(tmp_path, make, expected):
    path = tmp_path / "a.exr"
    make(path)
    with pytest.raises(NgptError) as caught:
        read_exr(path)
    assert str(caught.value).startswith(f"{path}: ") and expected in str(caught.value) and "\n" not in str(caught.value)
