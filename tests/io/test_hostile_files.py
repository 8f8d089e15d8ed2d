"""OpenEXR files that are made to do harm, or are none: one error each, at once, and before anything is decoded."""

import os
import struct
import threading
import time
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from campaigns.fuzz.exr_structure import Attribute, parse
from exr_files import comparable, same_bits, window, write_raw

import ngpt
import ngpt.cli
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
        (setting(b"dataWindow", box(-(2**31), 0, 2**31 - 1, 0)), "is 4294967296x1 pixels"),
        (setting(b"dataWindow", box(0, 0, 2**27 - 1, 0)), "bytes cannot hold 3 channels of 134217728x1 pixels"),
        (setting(b"dataWindow", box(0, 0, 0, 2**27 - 1)), "bytes cannot hold 3 channels of 1x134217728 pixels"),
        (setting(b"dataWindow", box(5, 5, 4, 9)), "part 0 is 0x5 pixels"),
        (setting(b"channels", chlist(*(b"c%05d" % i for i in range(100_000)))), "part 0 has more than 4096 channels"),
        (setting(b"channels", chlist(b"B", b"G", b"R", b"R")), "part 0 has two channels b'R'"),
        (setting(b"channels", chlist(b"B", kind=7)), "channel b'B' of part 0 is of type 7"),
        (setting(b"channels", b"\0"), "part 0 has no channels"),
        (setting(b"channels", b"B" * 300), "its header ends early"),
        (setting(b"channels", chlist(b"B", b"G", b"R"), b"list"), "part 0 has no 'channels' of type chlist"),
        (setting(b"compression", b"\x63"), "part 0 has compression 99"),
        (lambda exr: setattr(exr, "flags", 3), "is of OpenEXR version 3"),
        (lambda exr: setattr(exr, "flags", 2 | 0x800), "part 0 is a deep image"),
        (lambda exr: exr.parts[0].append(exr.parts[0][0]), "attribute b'channels' comes twice"),
        (lambda exr: exr.parts[0].append(Attribute(b"x", b"string", bytes(2**24))), "its header is longer than 16 MiB"),
        (lambda exr: exr.parts[0].append(Attribute(b"x", b"int", b"", 2**31 - 1)), "its header is longer than 16 MiB"),
        (lambda exr: exr.parts[0].append(Attribute(b"x", b"int", b"", -5)), "attribute b'x' has -5 bytes"),
        (
            lambda exr: exr.parts[0].extend(Attribute(b"x%d" % i, b"int", bytes(4)) for i in range(10_000)),
            "its header has more than 10000 attributes",
        ),
        (in_tiles(8, 4194312), "pixels in tiles of 8x4194312"),
        (lambda exr: exr.parts[0].clear(), "damaged or incomplete"),
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


@pytest.mark.parametrize(
    "name", ["RLE", "ZIPS", "ZIP", "PIZ", "PXR24", "B44", "B44A", "DWAA", "DWAB", "HTJ2K256", "HTJ2K32"]
)
@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.uint32])
def test_what_compresses_best_is_no_bomb(tmp_path, name, dtype):
    """Bounds on how much a byte may stand for hold for black images, which are the smallest."""
    header = {"compression": getattr(OpenEXR, f"{name}_COMPRESSION")}
    black = {channel: np.zeros((1024, 512), dtype) for channel in "RGB"}
    path = write_raw(tmp_path / "a.exr", (black, header))
    assert all(same_bits(pixels, black["R"]) for pixels in read_exr(path).parts[0].channels.values())


def test_a_part_that_openexr_reads_otherwise_than_its_header_is_refused(tmp_path, monkeypatch):
    path = write_raw(tmp_path / "a.exr", (PIXELS,))
    fewer = OpenEXR.File(str(write_raw(tmp_path / "b.exr", ({"R": PIXELS["R"]},))), separate_channels=True)
    monkeypatch.setattr(openexr.OpenEXR, "File", lambda *args, **kwargs: fewer)
    assert "damaged or incomplete" in refused(path)


@pytest.mark.parametrize("kind", ["fifo", "device", "loop", "zero", "long"])
def test_what_is_no_file_ends_at_once(tmp_path, kind):
    path = tmp_path / "a.exr"
    if kind == "fifo":
        os.mkfifo(path)
        assert "is a pipe or a device" in refused(path)
    elif kind == "device":
        path.symlink_to("/dev/zero")
        assert "is a pipe or a device" in refused(path)
    elif kind == "loop":
        path.symlink_to(path)
        assert "cannot be read: Too many levels of symbolic links" in refused(path)
    elif kind == "zero":
        assert "embedded null byte" in refused(tmp_path / "a\0.exr")
    else:
        assert "File name too long" in refused(tmp_path / ("a" * 300 + ".exr"))


def test_names_that_are_not_utf8(tmp_path, capfd):
    path = Path(os.fsdecode(os.fsencode(tmp_path) + b"/\xff\xfe.exr"))
    write_raw(tmp_path / "a.exr", (PIXELS,)).rename(path)
    assert read_exr(path).parts[0].channels.keys() == set("RGB")
    result = path.with_name(f"{path.stem}_denoised.exr")
    assert ngpt.cli.main(["denoise", "-m", "primal", str(path)]) == 0 and read_exr(result)
    path.write_bytes(b"")
    assert ngpt.cli.main(["denoise", "-m", "primal", "--force", str(path)]) == 1
    assert "is empty" in capfd.readouterr().err


@pytest.mark.parametrize("how", ["cut", "longer", "another"])
def test_a_file_that_changes_while_it_is_read_is_named(tmp_path, monkeypatch, how):
    path, other = write_raw(tmp_path / "a.exr", (PIXELS,)), write_raw(tmp_path / "b.exr", ({"Z": PIXELS["R"]},))
    original = OpenEXR.File

    def meanwhile(*args, **kwargs):
        if how == "cut":
            os.truncate(path, 600)
        elif how == "longer":
            with open(path, "ab") as file:
                file.write(b"more")
        else:  # a new file under the old name: the old one is read to its end
            other.rename(path)
        return original(*args, **kwargs)

    monkeypatch.setattr(openexr.OpenEXR, "File", meanwhile)
    if how == "another":
        assert set(read_exr(path).parts[0].channels) == set("RGB")
    else:
        assert "changed while it was read; wait until its writer is done" in refused(path)


def test_many_threads_cut_and_write_while_others_read(tmp_path):
    """Neither a crash nor a hang, and never an image that is not one of those written."""
    path, stop, seen = tmp_path / "a.exr", threading.Event(), []
    versions = []
    for value in (1, 2):
        channels = {name: np.full((64, 64), value, np.float32) for name in "RGB"}
        versions.append(write_raw(tmp_path / "v.exr", (channels, {"compression": OpenEXR.NO_COMPRESSION})).read_bytes())

    def write():
        while not stop.is_set():
            for data in versions:
                path.write_bytes(data)
                time.sleep(0.002)

    path.write_bytes(versions[0])
    writer = threading.Thread(target=write)
    writer.start()
    try:
        for _ in range(100):
            try:
                pixels = read_exr(path).parts[0].channels["R"]
            except NgptError as error:
                seen.append(str(error))
            else:
                assert pixels.min() == pixels.max()
    finally:
        stop.set()
        writer.join()
    assert all(message.startswith(str(path)) for message in seen)


# In a process of its own


@pytest.mark.parametrize("compression", ["NO", "PIZ", "ZIP", "DWAA"])
def test_isolated_is_the_same(tmp_path, compression):
    rng = np.random.default_rng(1)
    one = {
        "R": rng.random((9, 7)).astype("f4"),
        "G": rng.random((9, 7)).astype("f2"),
        "id": np.arange(63, dtype="u4").reshape(9, 7),
    }
    header = {
        "compression": getattr(OpenEXR, f"{compression}_COMPRESSION"),
        "dataWindow": window(-3, 4, 7, 9),
        "owner": "Zoë",
    }
    tiles = {"type": OpenEXR.tiledimage, "tiles": OpenEXR.TileDescription(), "lineOrder": OpenEXR.RANDOM_Y}
    path = write_raw(tmp_path / "a.exr", (one, header, "first"), ({"Z": one["R"]}, tiles, "second"))
    here, there = read_exr(path), read_exr_isolated(path)
    assert [part.name for part in there.parts] == ["first", "second"]
    for expected, part in zip(here.parts, there.parts, strict=True):
        assert part.channels.keys() == expected.channels.keys() and part.header.keys() == expected.header.keys()
        assert all(same_bits(part.channels[name], expected.channels[name]) for name in part.channels)
        for name in expected.header.keys() - {"channels", "chunkCount"}:
            assert comparable(part.header[name]) == comparable(expected.header[name]), name


@pytest.mark.parametrize(
    ("body", "expected"),
    [
        ("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)", "decoding it failed (killed by SIGSEGV)"),
        ("import os; os._exit(7)", "decoding it failed (exit status 7)"),
        ("import time; time.sleep(60)", "not decoded after 1 s"),
    ],
)
def test_a_decoder_that_crashes_or_stalls_is_an_error(tmp_path, monkeypatch, body, expected):
    path = write_raw(tmp_path / "a.exr", (PIXELS,))
    (tmp_path / "lib").mkdir()
    (tmp_path / "lib" / "OpenEXR.py").write_text(body)
    monkeypatch.syspath_prepend(tmp_path / "lib")
    if "sleep" in body:
        monkeypatch.setattr(isolated, "_SECONDS", 1.0)
    assert expected in refused(path, read_exr_isolated)


def test_the_command_line_isolates_on_request(tmp_path, monkeypatch, capsys):
    path = write_raw(tmp_path / "a.exr", (PIXELS,))
    (tmp_path / "lib").mkdir()
    (tmp_path / "lib" / "OpenEXR.py").write_text("import os, signal; os.kill(os.getpid(), signal.SIGBUS)")
    monkeypatch.syspath_prepend(tmp_path / "lib")
    assert ngpt.cli.main(["denoise", "-m", "primal", "--untrusted", str(path)]) == 1
    assert "killed by SIGBUS" in capsys.readouterr().err
    assert ngpt.cli.main(["denoise", "-m", "primal", str(path)]) == 0


def test_names_that_collide_with_layers_keep_their_channels(tmp_path):
    """OpenEXR's own grouping of channels has had memory errors on these."""
    names = ("R", "G", "B", "left", "left.R", "left.G", "left.B", "left.R.R", "A.B", "A")
    channels = {name: np.full((4, 5), i, np.float32) for i, name in enumerate(names)}
    stack = ngpt.read(write_raw(tmp_path / "a.exr", (channels,)))
    assert np.array_equal(stack["primal"][0, 0], [0, 1, 2])
    assert ngpt.read(ngpt.write(tmp_path / "b.exr", stack)).source.image.parts[0].channels.keys() == channels.keys()


def test_programs_beside_the_file_are_not_run(tmp_path, monkeypatch):
    path = write_raw(tmp_path / "a.exr", (PIXELS,))
    (tmp_path / "numpy.py").write_text("raise SystemExit('run')")
    monkeypatch.chdir(tmp_path)
    assert read_exr_isolated(path).parts[0].channels.keys() == set("RGB")
