"""PFM, Radiance HDR, PNG, TIFF and JPEG: right values, wherever an image is read; damage and bombs are one line."""

import struct
import tracemalloc
import zlib

import numpy as np
import pytest

import ngpt
from ngpt.errors import NgptError
from ngpt.io import header
from ngpt.io.exr import read, read_image
from ngpt.io.foreign.pfm import write_pfm
from ngpt.system.limits import memory


def linear(codes, most):
    x = np.asarray(codes, np.float64) / most
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)


def chunk(kind, data):
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(pixels, colour, depth=8, filters=(0,), interlaced=False, more=b""):
    """(H, W, C) as a PNG; row i is filtered by ``filters[i % n]``, the slow way of the standard's words."""
    height, width = pixels.shape[:2]
    passes = [(0, 0, 1, 1)]
    if interlaced:
        passes = [(0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2), (0, 1, 1, 2)]
    data = b""
    for x, y, step, rise in passes:
        part = pixels[y::rise, x::step]
        if part.size:
            data += filtered(part, depth, filters)
    start = struct.pack(">2I5B", width, height, depth, colour, 0, 0, interlaced)
    body = chunk(b"IHDR", start) + more + chunk(b"IDAT", zlib.compress(data)) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + body


def filtered(part, depth, filters):
    step = max(part.shape[2] * depth // 8, 1)
    data, before = b"", None
    for i, row in enumerate(part):
        if depth == 16:
            line = row.astype(">u2").tobytes()
        elif depth == 8:
            line = row.astype(np.uint8).tobytes()
        else:
            bits = (row.reshape(-1, 1) >> np.arange(depth)[::-1]) & 1
            line = np.packbits(bits.ravel().astype(np.uint8)).tobytes()
        before = before or bytes(len(line))
        kind, coded = filters[i % len(filters)], bytearray()
        for k, byte in enumerate(line):
            left = line[k - step] if k >= step else 0
            above, corner = before[k], before[k - step] if k >= step else 0
            p = left + above - corner
            paeth = min((left, above, corner), key=lambda value, p=p: abs(p - value))
            coded.append((byte - (0, left, above, (left + above) // 2, paeth)[kind]) % 256)
        data, before = data + bytes([kind]) + bytes(coded), line
    return data


def smooth(rng, height, width, channels, most):
    ramp = np.add.outer(np.arange(height) * 3, np.arange(width) * 5)[..., None]
    return (ramp + rng.integers(0, 20, (height, width, channels))) % (most + 1)


# Pairs that are left out differ from these in nothing but their numbers of channels and bytes.
@pytest.mark.parametrize("size", [(11, 7), (1, 9), (13, 1)])
@pytest.mark.parametrize("interlaced", [False, True])
@pytest.mark.parametrize(("colour", "depth"), [(0, 1), (0, 2), (0, 4), (0, 8), (2, 16), (4, 16), (6, 8)])
def test_png_is_srgb_and_its_alpha_is_multiplied_in(tmp_path, colour, depth, interlaced, size):
    channels, most = {0: 1, 2: 3, 4: 2, 6: 4}[colour], 2**depth - 1
    pixels = smooth(np.random.default_rng(depth), *size, channels, most)
    path = tmp_path / "a.png"
    path.write_bytes(png(pixels, colour, depth, (4, 3, 0, 1, 2, 4, 4, 3), interlaced))
    stack = read(path)
    alpha = pixels[..., -1:] / most if colour & 4 else np.ones((*size, 1))
    light = linear(pixels[..., : 3 if colour & 2 else 1], most)
    assert np.allclose(stack["primal"], np.broadcast_to(light * alpha, (*size, 3)), atol=1e-6)
    assert ("alpha" in stack) == bool(colour & 4) and stack.attributes["ngpt:from"] == f"PNG, {depth} bits of sRGB"
    if colour & 4:
        assert np.allclose(stack["alpha"], alpha, atol=1e-6)


def test_png_with_a_palette_and_with_a_clear_colour(tmp_path):
    table = np.array([[255, 0, 0], [0, 128, 0], [7, 7, 255]], np.uint8)
    places = np.array([[0, 1, 2], [2, 1, 0]])[..., None]
    more = chunk(b"PLTE", table.tobytes()) + chunk(b"tRNS", bytes([0, 51]))
    (tmp_path / "p.png").write_bytes(png(places, 3, 2, more=more))
    alpha = np.array([0, 0.2, 1])[places]
    assert np.allclose(read_image(tmp_path / "p.png"), linear(table[places[..., 0]], 255) * alpha, atol=1e-6)
    (tmp_path / "c.png").write_bytes(png(table[places[..., 0]], 2, more=chunk(b"tRNS", bytes([0, 0, 0, 128, 0, 0]))))
    assert np.array_equal(read(tmp_path / "c.png")["alpha"][..., 0], [[1, 0, 1], [1, 0, 1]])


@pytest.mark.parametrize("order", ["<f4", ">f4"])
def test_pfm_is_bottom_up_and_its_scale_counts(tmp_path, order):
    image = np.random.default_rng(0).normal(size=(5, 4, 3)).astype(np.float32)
    for scale, name, values in ((1, "PF", image), (2.5, "PF", image), (1, "Pf", image[..., :1])):
        head = f"{name}\n4 5\n{'-' if order[0] == '<' else ''}{scale}\n".encode()
        (tmp_path / "a.pfm").write_bytes(head + values[::-1].astype(order).tobytes())
        want = np.broadcast_to(values * np.float32(scale), image.shape)
        assert np.array_equal(read_image(tmp_path / "a.pfm"), want)
    assert np.array_equal(read_image(write_pfm(tmp_path / "b.pfm", image)), image)


def rgbe(rng, height, width):
    pixels = rng.integers(0, 256, (height, width, 4)).astype(np.uint8)
    pixels[..., 3] = rng.integers(120, 140, (height, width))
    pixels[:, width // 2 :] = pixels[:, width // 2, None]  # something to repeat
    pixels[0, 0] = (9, 9, 9, 0)
    return pixels, np.where(pixels[..., 3:] > 0, pixels[..., :3] * 2.0 ** (pixels[..., 3:].astype(int) - 136), 0)


def new_runs(pixels):
    data, width = b"", pixels.shape[1]
    for row in pixels:
        data += bytes((2, 2, width >> 8, width & 255))
        for values in row.T:
            half = width // 2
            data += bytes([half]) + values[:half].tobytes() + bytes([128 + width - half, int(values[half])])
    return data


def old_runs(pixels):
    """The first half as it is; 1 1 1 n for the rest, over two pixels where it is longer than 255."""
    data = b""
    for row in pixels:
        half = len(row) // 2
        times = len(row) - half - 1
        data += row[: half + 1].tobytes() + bytes((1, 1, 1, times & 255))
        data += bytes((1, 1, 1, times >> 8)) if times > 255 else b""
    return data


@pytest.mark.parametrize(("width", "body"), [(20, new_runs), (20, old_runs), (600, old_runs), (5, np.ndarray.tobytes)])
@pytest.mark.parametrize("order", ["-Y {} +X {}", "+Y {} +X {}", "-Y {} -X {}"])
def test_radiance_in_either_run_length_with_its_exposure(tmp_path, width, body, order):
    pixels, light = rgbe(np.random.default_rng(0), 3, width)
    text = "#?RADIANCE\n# made by hand\nEXPOSURE=2.0\nEXPOSURE= 0.25\nFORMAT=32-bit_rle_rgbe\n\n"
    (tmp_path / "a.hdr").write_bytes((text + order.format(3, width)).encode() + b"\n" + body(pixels))
    want = light[:: 1 if "-Y" in order else -1, :: 1 if "+X" in order else -1] / 0.5
    assert np.allclose(read_image(tmp_path / "a.hdr"), want, rtol=1e-6)


@pytest.mark.parametrize("kind", ["u1", "u2", "f2", "f8"])
@pytest.mark.parametrize("extra", [None, "unassalpha", "assocalpha"])
def test_tiff_of_whole_numbers_is_srgb_and_of_floats_linear(tmp_path, kind, extra):
    tifffile = pytest.importorskip("tifffile")
    rng, most = np.random.default_rng(0), {"u1": 255, "u2": 65535}.get(kind, 1)
    image = (rng.random((9, 7, 4 if extra else 3)) * most).astype(kind)
    colours, alpha = image[..., :3], image[..., 3:] / most if extra == "unassalpha" else 1.0
    want = (linear(colours, most) if kind[0] == "u" else colours.astype(np.float32)) * alpha
    for options in ({}, {"compression": "zlib"}, {"tile": (16, 16)}, {"byteorder": ">"}, {"planarconfig": "separate"}):
        written = np.moveaxis(image, -1, 0) if "planarconfig" in options else image
        options = options | {"photometric": "rgb", "extrasamples": [extra] if extra else None}
        tifffile.imwrite(tmp_path / "a.tif", written, **options)
        assert np.allclose(read_image(tmp_path / "a.tif"), want, atol=1e-6), options
        assert ("alpha" in read(tmp_path / "a.tif")) == bool(extra)


def test_jpeg_is_srgb_and_turned_as_its_camera_says(tmp_path):
    image = pytest.importorskip("PIL.Image")
    codes = np.zeros((16, 32, 3), np.uint8)
    codes[:, :16] = 200
    exif = image.Exif()
    exif[0x112] = 6  # to be turned clockwise
    image.fromarray(codes).save(tmp_path / "a.jpg", quality=100, subsampling=0, exif=exif)
    found = read_image(tmp_path / "a.jpg")
    assert found.shape == (32, 16, 3)
    assert np.allclose(found, linear(np.rot90(codes, -1), 255), atol=0.02)


def test_what_is_made_linear_is_said_once_and_floats_are_not(tmp_path, command):
    (tmp_path / "a.png").write_bytes(png(np.full((4, 5, 3), 128), 2))
    write_pfm(tmp_path / "a.pfm", np.ones((4, 5, 3), np.float32))
    line = "a.png: is PNG, 8 bits, as displays take it; made scene-linear by the sRGB formula"
    for options, said in (("", 1), ("--untrusted", 1), ("-q", 0)):
        assert command(f"denoise -m primal a.png --force {options}").err.count(line) == said
    assert np.allclose(ngpt.read_image("a_denoised.exr"), linear(128, 255))
    assert "sRGB" not in command("denoise -m primal a.pfm -o b.exr").err


def test_the_habits_of_oidn_denoise(tmp_path, command):
    """--hdr color.pfm --alb albedo.pfm --nrm normal.pfm -o out.pfm"""
    image = np.random.default_rng(0).random((12, 16, 3)).astype(np.float32)
    for name in ("color", "albedo", "normal"):
        write_pfm(tmp_path / f"{name}.pfm", image)
    command("denoise color.pfm --albedo albedo.pfm --normal normal.pfm -m nfor -o new/out.pfm --ref color.pfm")
    expected = ngpt.denoise(image, "nfor", albedo=image, normal=image)
    assert np.array_equal(read_image("new/out.pfm"), expected)
    (tmp_path / "n.png").write_bytes(png(np.full((12, 16, 3), 128), 2))
    told = command("denoise color.pfm --normal n.png -o x.exr", 1).err
    assert "n.png: normal is not a colour to display, and this is PNG, 8 bits of sRGB" in told


@pytest.mark.parametrize(
    ("name", "data", "expected"),
    [
        ("a.pfm", b"PF\n4 5\n-1.0\n" + bytes(100), "only 25 of its 60 numbers"),
        ("a.pfm", b"PF\n4 5\nx\n" + bytes(240), "its header is not: PF, width and height, scale"),
        ("a.pfm", b"Pf\n60000 60000\n-1\n" + bytes(99), "is 60000x60000 pixels, and 256 million are read at most"),
        ("a.hdr", b"#?RADIANCE\nFORMAT=32-bit_rle_xyze\n\n-Y 1 +X 1\n" + bytes(4), "32-bit_rle_xyze and no RGB"),
        ("a.hdr", b"#?RADIANCE\n\n+X 1 -Y 1\n" + bytes(4), "has columns for rows"),
        ("a.hdr", b"#?RADIANCE\n\n-Y 2 +X 9\n\2\2\0\x09\x8a", "row 0 breaks off or is too long"),
        ("a.png", png(np.zeros((4, 4, 3), int), 2)[:-20], "it ends before all"),
        ("a.png", png(np.full((1, 1, 1), 3), 3, 2, more=chunk(b"PLTE", bytes(6))), "its palette has 2 colours"),
        ("a.tif", b"II*\0" + bytes(20), "a.tif: "),
        ("a.jpg", b"\xff\xd8\xff" + bytes(20), "a.jpg: "),
        ("a.npy", b"\x93NUMPY", "not an OpenEXR file, nor PFM, Radiance HDR, PNG, TIFF or JPEG"),
    ],
)  # fmt: skip
def test_damage_is_one_line(tmp_path, name, data, expected):
    path = tmp_path / name
    path.write_bytes(data)
    with pytest.raises(NgptError) as caught:
        read(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ") and expected in message and len(message) < 400


def test_bombs_are_refused_before_they_are_unpacked(tmp_path, monkeypatch):
    """A PNG and a TIFF that inflate to far more than their sizes, and a size that is more than half of the memory."""
    tifffile = pytest.importorskip("tifffile")
    rows = zlib.compress(bytes(2**26))
    data = png(np.zeros((4, 4, 3), int), 2)
    (tmp_path / "a.png").write_bytes(data[:33] + chunk(b"IDAT", rows) + chunk(b"IEND", b""))
    tracemalloc.start()
    try:
        assert not read_image(tmp_path / "a.png").any()
        assert tracemalloc.get_traced_memory()[1] < 2**22
    finally:
        tracemalloc.stop()
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, np.zeros((4, 4, 3), np.float32), photometric="rgb", compression="zlib")
    with tifffile.TiffFile(path, mode="r+b") as file:
        file.pages[0].tags["StripOffsets"].overwrite(path.stat().st_size)
        file.pages[0].tags["StripByteCounts"].overwrite(len(rows))
    path.write_bytes(path.read_bytes() + rows)
    with pytest.raises(NgptError, match="it unpacks to more than its size"):
        read_image(path)
    monkeypatch.setattr(header, "memory", lambda: 300)
    with pytest.raises(NgptError, match="more than half of the"):
        read_image(tmp_path / "a.png")
    assert memory() > 300
