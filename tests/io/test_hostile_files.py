"""OpenEXR files that are made to do harm, or are none: one error each, at once, and before anything is decoded."""

import os
import struct
import time
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from exr_files import comparable, same_bits, window, write_raw
from exr_structure import Attribute, parse

import ngpt
from ngpt.errors import NgptError
from ngpt.io import header, isolated, openexr
from ngpt.io.isolated import read_exr_isolated
from ngpt.io.openexr import read_exr

PIXELS = {name: np.arange(80, dtype=np.float32).reshape(8, 10) for name in "RGB"}


def refused(path, read=read_exr):
    """The error's message, which comes soon."""
    begun = time.perf_counter()
    with pytest.raises(NgptError) as caught:
        read(path)
    assert time.perf_counter() - begun < 5
    message = str(caught.value)
    assert message.startswith(f"{path}: ") and "\n" not in message and len(message) < 1000
    return message


def changed(tmp_path, change, *parts):
    path = write_raw(tmp_path / "a.exr", *(parts or [(PIXELS,)]))
    exr = parse(path.read_bytes())
    change(exr)
    path.write_bytes(exr.pack())
    return path


def setting(name, data, kind=None):
    def change(exr):
        for part in exr.parts:
            for attribute in part:
                if attribute.name == name:
                    attribute.data, attribute.kind = data, kind or attribute.kind

    return change


def chlist(*names, kind=2, step=1):
    return b"".join(n + b"\0" + struct.pack("<i4x2i", kind, step, step) for n in names) + b"\0"


def in_tiles(width, height):
    def change(exr):
        others = [attribute for attribute in exr.parts[0] if attribute.name != b"type"]
        tiles = Attribute(b"tiles", b"tiledesc", struct.pack("<2IB", width, height, 0))
        exr.parts[0][:] = [*others, Attribute(b"type", b"string", b"tiledimage"), tiles]

    return change


def box(*numbers):
    return struct.pack("<4i", *numbers)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (setting(b"dataWindow", box(0, 0, 65534, 65534)), "is 65535x65535 pixels, and 256 million are read at most"),
        (setting(b"dataWindow", box(0, 0, 2**27 - 1, 0)), "bytes cannot hold 3 channels of 134217728x1 pixels"),
        (setting(b"dataWindow", box(5, 5, 4, 9)), "part 0 is 0x5 pixels"),
        (setting(b"channels", chlist(*(b"c%05d" % i for i in range(100_000)))), "part 0 has more than 4096 channels"),
        (setting(b"channels", chlist(b"B", b"G", b"R", b"R")), "part 0 has two channels b'R'"),
        (setting(b"channels", b"\0"), "part 0 has no channels"),
        (setting(b"channels", b"B" * 300), "its header ends early"),
        (setting(b"channels", chlist(b"B", b"G", b"R"), b"list"), "part 0 has no 'channels' of type chlist"),
        (setting(b"compression", b"\x63"), "part 0 has compression 99"),
        (lambda exr: setattr(exr, "flags", 3), "is of OpenEXR version 3"),
        (lambda exr: exr.parts[0].append(exr.parts[0][0]), "attribute b'channels' comes twice"),
        (lambda exr: exr.parts[0].append(Attribute(b"x", b"int", b"", 2**31 - 1)), "its header is longer than 16 MiB"),
        (lambda exr: exr.parts[0].append(Attribute(b"x", b"int", b"", -5)), "attribute b'x' has -5 bytes"),
        (
            lambda exr: exr.parts[0].extend(Attribute(b"x%d" % i, b"int", bytes(4)) for i in range(10_000)),
            "its header has more than 10000 attributes",
        ),
        (in_tiles(8, 4194312), "pixels in tiles of 8x4194312"),
    ],
)  # fmt: skip
def test_headers_that_ask_for_too_much_or_contradict_themselves(tmp_path, monkeypatch, change, expected):
    path = changed(tmp_path, change)
    monkeypatch.setattr(OpenEXR, "File", lambda *args, **kwargs: pytest.fail("OpenEXR has seen it"))
    assert expected in refused(path)


def test_more_than_half_of_the_memory_is_not_decoded(tmp_path, monkeypatch):
    path = write_raw(tmp_path / "a.exr", (PIXELS,))
    need = 3 * 80 * 4
    monkeypatch.setattr(header, "memory", lambda: 2 * need)
    read_exr(path)
    monkeypatch.setattr(header, "memory", lambda: 2 * need - 2)
    assert "its 3 channels take 0.0 GiB, more than half of" in refused(path)


@pytest.mark.parametrize("name", [name for name in OpenEXR.Compression.__members__ if not name.startswith("NUM")])
def test_what_compresses_best_is_no_bomb(tmp_path, name):
    """Bounds on how much a byte may stand for hold for black images, which are the smallest."""
    header = {"compression": getattr(OpenEXR, name)}
    for dtype in (np.float16, np.float32, np.uint32):
        black = {channel: np.zeros((512, 512), dtype) for channel in "RGB"}
        image = read_exr(write_raw(tmp_path / "a.exr", (black, header)))
        assert all(same_bits(pixels, black["R"]) for pixels in image.parts[0].channels.values())


@pytest.mark.parametrize(
    ("name", "make", "expected"),
    [
        ("a.exr", os.mkfifo, "is a pipe or a device"),
        ("a.exr", lambda path: path.symlink_to("/dev/zero"), "is a pipe or a device"),
        ("a.exr", lambda path: path.symlink_to(path), "cannot be read: Too many levels of symbolic links"),
        ("a\0.exr", None, "embedded null byte"),
        ("a" * 300, None, "File name too long"),
    ],
    ids=["fifo", "device", "loop", "zero", "long"],
)
def test_what_is_no_file_ends_at_once(tmp_path, name, make, expected):
    path = tmp_path / name
    if make:
        make(path)
    assert expected in refused(path)


def test_names_that_are_not_utf8(tmp_path, command):
    path = Path(os.fsdecode(os.fsencode(tmp_path) + b"/\xff\xfe.exr"))
    write_raw(tmp_path / "a.exr", (PIXELS,)).rename(path)
    assert read_exr(path).parts[0].channels.keys() == set("RGB")
    result = path.with_name(f"{path.stem}_denoised.exr")
    command(f"denoise -m primal {path}")
    assert read_exr(result)
    path.write_bytes(b"")
    assert "is empty" in command(f"denoise -m primal --force {path}", 1).err


@pytest.mark.parametrize("size", [600, 9999])
def test_a_file_that_changes_while_it_is_read_is_named(tmp_path, monkeypatch, size):
    path, original = write_raw(tmp_path / "a.exr", (PIXELS,)), OpenEXR.File

    def meanwhile(*args, **kwargs):
        os.truncate(path, size)
        return original(*args, **kwargs)

    monkeypatch.setattr(openexr.OpenEXR, "File", meanwhile)
    assert "changed while it was read; wait until its writer is done" in refused(path)


@pytest.mark.parametrize("compression", ["NO", "DWAA"])
def test_isolated_is_the_same(tmp_path, compression):
    rng, red = np.random.default_rng(1), np.random.default_rng(1).random((9, 7)).astype("f4")
    one = {"R": red, "G": rng.random((9, 7)).astype("f2"), "id": np.arange(63, dtype="u4").reshape(9, 7)}
    header = {"compression": getattr(OpenEXR, f"{compression}_COMPRESSION"), "owner": "Zoë"}
    header |= {"dataWindow": window(-3, 4, 7, 9)}
    tiles = {"type": OpenEXR.tiledimage, "tiles": OpenEXR.TileDescription(), "lineOrder": OpenEXR.RANDOM_Y}
    path = write_raw(tmp_path / "a.exr", (one, header, "first"), ({"Z": red}, tiles, "second"))
    here, there = read_exr(path), read_exr_isolated(path)
    assert [part.name for part in there.parts] == ["first", "second"]
    for expected, part in zip(here.parts, there.parts, strict=True):
        assert part.channels.keys() == expected.channels.keys() and part.header.keys() == expected.header.keys()
        assert all(same_bits(part.channels[name], expected.channels[name]) for name in part.channels)
        for name in expected.header.keys() - {"channels", "chunkCount"}:
            assert comparable(part.header[name]) == comparable(expected.header[name]), name


@pytest.fixture
def decoder(tmp_path, monkeypatch):
    """Puts a module in the place of OpenEXR, for processes that are started."""

    def put(body):
        (tmp_path / "lib").mkdir()
        (tmp_path / "lib" / "OpenEXR.py").write_text(body)
        monkeypatch.syspath_prepend(tmp_path / "lib")

    return put


@pytest.mark.parametrize(
    ("body", "expected"),
    [
        ("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)", "decoding it failed (killed by SIGSEGV)"),
        ("import os; os._exit(7)", "decoding it failed (exit status 7)"),
        ("import time; time.sleep(60)", "not decoded after 1 s"),
    ],
)
def test_a_decoder_that_crashes_or_stalls_is_an_error(tmp_path, monkeypatch, decoder, body, expected):
    path = write_raw(tmp_path / "a.exr", (PIXELS,))
    decoder(body)
    if "sleep" in body:
        monkeypatch.setattr(isolated, "_SECONDS", 1.0)
    assert expected in refused(path, read_exr_isolated)


def test_the_command_line_isolates_on_request(tmp_path, decoder, command):
    write_raw(tmp_path / "a.exr", (PIXELS,))
    decoder("import os, signal; os.kill(os.getpid(), signal.SIGBUS)")
    assert "killed by SIGBUS" in command("denoise -m primal --untrusted a.exr", 1).err
    command("denoise -m primal a.exr")


def test_programs_beside_the_file_are_not_run(tmp_path, monkeypatch):
    path = write_raw(tmp_path / "a.exr", (PIXELS,))
    (tmp_path / "numpy.py").write_text("raise SystemExit('run')")
    monkeypatch.chdir(tmp_path)
    assert read_exr_isolated(path).parts[0].channels.keys() == set("RGB")


def test_names_that_collide_with_layers_keep_their_channels(tmp_path):
    """OpenEXR's own grouping of channels has had memory errors on these."""
    names = ("R", "G", "B", "left", "left.R", "left.G", "left.B", "left.R.R", "A.B", "A")
    channels = {name: np.full((4, 5), i, np.float32) for i, name in enumerate(names)}
    stack = ngpt.read(write_raw(tmp_path / "a.exr", (channels,)))
    assert np.array_equal(stack["primal"][0, 0], [0, 1, 2])
    assert ngpt.read(ngpt.write(tmp_path / "b.exr", stack)).source.image.parts[0].channels.keys() == channels.keys()
