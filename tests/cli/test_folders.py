"""Folders of frames: the same images and reports as one by one, whatever happens to some of them."""

import json
import os
import subprocess
import sys
import threading
import weakref

import numpy as np
import pytest
from full_stack import full_stack
from processes import ENVIRONMENT, ROOT, complete, timeless

import ngpt
from ngpt.cli import main

NGPT = (sys.executable, "-m", "ngpt")


@pytest.fixture
def frames(tmp_path):
    """A folder of six frames of several sizes."""
    folder = tmp_path / "frames"
    folder.mkdir()
    for i in range(6):
        ngpt.write(folder / f"{i}.exr", full_stack(24 + 4 * i, 40 - 3 * i, seed=i))
    return folder


@pytest.mark.parametrize("method", ["wcv", "ngpt-fast", "nfor"])
def test_a_folder_gives_the_bits_of_its_frames(frames, tmp_path, method):
    assert main(["denoise", str(frames), "-o", str(tmp_path / "all"), "-m", method, "-q"]) == 0
    for path in sorted(frames.iterdir()):
        alone = tmp_path / path.name
        assert main(["denoise", str(path), "-o", str(alone), "-m", method, "-q"]) == 0
        assert timeless(alone) == timeless(tmp_path / "all" / path.name)


def test_all_reports_arrive_in_order(frames, tmp_path):
    """A process that really shares its standard error with the reader of OpenEXR files, which hushes number 2."""
    (frames / "3.exr").write_bytes(b"not an image")
    run = complete([*NGPT, "denoise", frames, "-o", tmp_path / "out", "-m", "l2", "--json"])
    assert run.returncode == 1
    told = [line for line in run.stderr.splitlines() if not line.startswith("denoise: ")]
    assert [line[:5] for line in told[:3]] == ["[1/6]", "[2/6]", "[3/6]"] and [line[:5] for line in told[4:6]] == [
        "[5/6]",
        "[6/6]",
    ]
    assert told[3].startswith("ngpt: error: ") and "3.exr: not an OpenEXR file" in told[3]
    assert told[6:] == ["ngpt: error: 1 of 6 stacks were not reconstructed"]
    assert run.stderr.startswith("denoise: 0/6 frames\n") and "denoise: 6/6 frames, " in run.stderr
    files = json.loads(run.stdout)["files"]
    assert [os.path.basename(f["input"]) for f in files] == [f"{i}.exr" for i in range(6)]
    assert ["error" in f for f in files] == [False, False, False, True, False, False]


def test_three_frames_are_in_memory_at_most(frames, tmp_path, monkeypatch):
    alive, most, lock = set(), [], threading.Lock()

    def counted(*arguments):
        stack = ngpt.read(arguments[0])
        with lock:
            alive.add(id(stack))
            most.append(len(alive))
        weakref.finalize(stack, alive.discard, id(stack))
        return [stack]

    monkeypatch.setattr("ngpt.cli.denoise.read_views", counted)
    (frames / "2.exr").write_bytes(b"not an image")
    assert main(["denoise", str(frames), "-o", str(tmp_path / "out"), "-m", "l2", "-q"]) == 1
    assert len(most) == 5 and max(most) <= 3 and not alive


def test_a_folder_goes_on_past_existing_results(frames, tmp_path, capsys):
    out = tmp_path / "out"
    words = ["denoise", str(frames), "-o", str(out), "-m", "l2"]
    assert main([*words, "-q"]) == 0
    before = {path.name: path.stat().st_mtime_ns for path in out.iterdir()}
    (out / "2.exr").unlink()
    capsys.readouterr()
    assert main(words) == 1
    assert "--force" in capsys.readouterr().err and not (out / "2.exr").exists()
    assert main([*words, "--skip-existing", "--json"]) == 0
    told = capsys.readouterr()
    files = json.loads(told.out)["files"]
    assert [f.get("skipped", False) for f in files] == [True, True, False, True, True, True]
    assert "5.exr: skipped, exists already" in told.err and "5 of 6 stacks were skipped" in told.err
    after = {path.name: path.stat().st_mtime_ns for path in out.iterdir()}
    assert after.keys() == before.keys() and {n for n in after if after[n] != before[n]} == {"2.exr"}
    assert np.array_equal(ngpt.read_image(out / "2.exr"), ngpt.denoise(ngpt.read(frames / "2.exr"), "l2"))
    # What a full disk left of a result is none.
    for cut in (b"", (out / "2.exr").read_bytes()[:-9]):
        (out / "2.exr").write_bytes(cut)
        assert main([*words, "--skip-existing", "--json"]) == 0
        told = capsys.readouterr()
        skipped = [f.get("skipped", False) for f in json.loads(told.out)["files"]]
        assert skipped == [True, True, False, True, True, True]
        assert "2.exr: l2, " in told.err and "in place of a file that was not whole" in told.err
        assert np.array_equal(ngpt.read_image(out / "2.exr"), ngpt.denoise(ngpt.read(frames / "2.exr"), "l2"))
    # One of the two, not both.
    with pytest.raises(SystemExit):
        main([*words, "--skip-existing", "--force"])


def on_terminal(*words):
    """What a command writes to a terminal that is its standard error, and its status."""
    ours, its = os.openpty()
    environment = ENVIRONMENT | {"TERM": "xterm", "COLUMNS": "200", "NO_COLOR": "1"}
    process = subprocess.Popen([*NGPT, *words], stderr=its, stdout=subprocess.DEVNULL, env=environment, cwd=ROOT)
    os.close(its)
    seen = b""
    try:
        while piece := os.read(ours, 1 << 16):
            seen += piece
    except OSError:  # the end, where a terminal is concerned
        pass
    os.close(ours)
    return seen.decode(), process.wait(60)


def test_on_a_terminal_there_is_a_bar_and_above_it_a_line_for_each_frame(frames, tmp_path):
    pytest.importorskip("rich")
    seen, status = on_terminal("denoise", frames, "-o", tmp_path / "out", "-m", "l2")
    assert status == 0 and "6/6" in seen and "frames" in seen and "0:00:0" in seen
    assert all(f"[{i}/6] " in seen for i in range(1, 7)) and "denoise: " not in seen
    assert on_terminal("denoise", frames, "-o", tmp_path / "quiet", "-m", "l2", "-q") == ("", 0)
    seen, status = on_terminal("denoise", frames / "0.exr", "-o", tmp_path / "one.exr", "-m", "l2")
    assert status == 0 and "1/1" in seen


@pytest.mark.parametrize(
    ("name", "output", "found"),
    [
        ("shot.%d.exr", "c.%03d.exr", {"c.001.exr", "c.002.exr", "c.010.exr"}),
        ("shot.$F.exr", "new/c.$F2.exr", {"c.01.exr", "c.02.exr", "c.10.exr"}),
        ("shot.<frame>.exr", "new/", {"shot.1.exr", "shot.2.exr", "shot.10.exr"}),
        ("pad.%04d.exr", "c.####.exr", {"c.0001.exr", "c.0002.exr", "c.12345.exr"}),
        ("pad.####.exr", "new/", {"pad.0001.exr", "pad.0002.exr", "pad.12345.exr"}),
        ("pad.$F4.exr", "c.%d.pfm", {"c.1.pfm", "c.2.pfm", "c.12345.pfm"}),
        ("pad.{frame:04d}.exr", "c.<frame>.exr", {"c.1.exr", "c.2.exr", "c.12345.exr"}),
        ("%02d/beauty.%02d.exr", "c.%d.exr", {"c.7.exr", "c.8.exr"}),
    ],
)
def test_names_of_frames_are_the_frames_there_are(tmp_path, monkeypatch, capsys, name, output, found):
    monkeypatch.chdir(tmp_path)
    image = np.ones((4, 5, 3), np.float32)
    names = [f"shot.{i}.exr" for i in (10, 1, 2)] + [f"pad.{i:04d}.exr" for i in (12345, 1, 2)]
    for file in (*names, "shot.2_denoised.exr", "pad.01.exr", "other.0001.exr"):
        ngpt.write(file, image)
    for frame, other in ((7, 7), (8, 8), (9, 10)):
        os.makedirs(f"{frame:02d}")
        ngpt.write(f"{frame:02d}/beauty.{other:02d}.exr", image)
    assert main(["denoise", name, "-o", output, "-m", "primal"]) == 0
    told = [line.split()[1] for line in capsys.readouterr().err.splitlines() if line.startswith("[")]
    number = [int("".join(filter(str.isdigit, os.path.basename(path)))) for path in told]
    assert number == sorted(number) and len(told) == len(found)
    written = {path.name for path in (tmp_path / "new" if output.startswith("new") else tmp_path).glob("*")}
    assert found <= written


def test_names_of_frames_that_are_not_there_or_have_no_number(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    image = np.ones((12, 14, 3), np.float32)
    for name in ("a.exr", "b.%04d.exr", "c.0001.exr", "c.0002.exr", "d.1.exr", "d.2.exr"):
        ngpt.write(name, image)
    for words, status, said in (
        (["denoise", "no.%04d.exr"], 1, "no.%04d.exr: no frames of that name are there; check the name"),
        (["picture", "no.####.exr", "-o", "f.webp"], 1, "no.####.exr: no frames of that name"),
        (["denoise", "a.exr", "-o", "x.%04d.exr"], 2, "a.exr: has no number, which x.%04d.exr asks for"),
        (["denoise", "b.%04d.exr", "-m", "primal"], 0, "[1/1] b.%04d.exr -> b.%04d_denoised.exr"),
        (["picture", "c.####.exr", "-o", "pics/p.%d.png"], 0, "c.####.exr -> pics/p.%d.png: 2 frames"),
        (["report", "c.%04d.exr", "--ref", "d.%d.exr"], 0, "flicker is nan: no frame after the first has motion"),
        (["report", "c.%04d.exr", "d.%d.exr", "--force"], 0, "report.html: open it"),
        (["report", "c.%04d.exr", "a.exr", "--force"], 1, "a.exr: is no folder, and others are"),
    ):
        assert main(words) == status, words
        assert said in capsys.readouterr().err
    assert {path.name for path in (tmp_path / "pics").iterdir()} == {"p.1.png", "p.2.png"}


def test_folders_win_over_patterns_by_their_names(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    image = np.ones((4, 5, 3), np.float32)
    for file in ("dir[1]/a.exr", "dir[1]/x[2]/b.exr", "dir1/c.exr"):
        os.makedirs(os.path.dirname(file), exist_ok=True)
        ngpt.write(file, image)
    for pattern, found in (
        ("dir[1]/*.exr", {"a.exr"}),
        ("dir[1]/x[2]/?.exr", {"b.exr"}),
        ("dir[1]/**/*.exr", {"a.exr", "b.exr"}),
        ("dir[2-9]*/../dir?/c.exr", None),
        (str(tmp_path / "dir[1]" / "*.exr"), {"a.exr"}),
    ):
        assert main(["denoise", pattern, "-o", "out", "-m", "primal", "--force"]) == (1 if found is None else 0)
        if found is not None:
            assert {path.name for path in (tmp_path / "out").iterdir()} == found
            for path in (tmp_path / "out").iterdir():
                path.unlink()


def test_a_file_that_is_there_names_both_ways_out_and_single_outputs_get_their_folder(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    ngpt.write("a.exr", full_stack(12, 14))
    for words in (
        ["denoise", "a.exr", "-m", "primal", "-o", "1/2/a.exr"],
        ["picture", "a.exr", "-o", "2/a.png"],
        ["report", "a.exr", "-o", "3/a.html"],
        ["train", "--config", "tiny", "--init", "5/a.toml"],
    ):
        assert main(words) == 0
        capsys.readouterr()
        assert main(words) == 1
        said = capsys.readouterr().err
        assert "exists already; pass --force" in said
        assert ("or --skip-existing" in said) == (words[0] == "denoise")
