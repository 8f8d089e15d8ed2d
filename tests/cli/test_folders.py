"""Folders of frames: the same images and reports as one by one, whatever happens to some of them."""

import json
import os
import re

import numpy as np
import pytest
from full_stack import full_stack
from processes import NGPT, complete

import ngpt


@pytest.fixture
def frames(tmp_path):
    """A folder of six frames of several sizes."""
    folder = tmp_path / "frames"
    folder.mkdir()
    for i in range(6):
        ngpt.write(folder / f"{i}.exr", full_stack(12 + 2 * i, 20 - 2 * i, seed=i))
    return folder


@pytest.mark.parametrize("method", ["wcv", "ngpt-fast"])
def test_a_folder_gives_the_bits_of_its_frames(frames, tmp_path, method, command):
    command(f"denoise frames -o all -m {method} -q")
    for path in frames.iterdir():
        assert np.array_equal(ngpt.read_image(f"all/{path.name}"), ngpt.denoise(ngpt.read(path), method))


def test_all_reports_arrive_in_order(frames, tmp_path):
    """A process that really shares its standard error with the reader of OpenEXR files, which hushes number 2."""
    (frames / "3.exr").write_bytes(b"not an image")
    run = complete([*NGPT, "denoise", frames, "-o", tmp_path / "out", "-m", "l2", "--json"])
    assert run.returncode == 1
    told = [line for line in run.stderr.splitlines() if not line.startswith("denoise: ")]
    assert [line[:5] for line in told] == ["[1/6]", "[2/6]", "[3/6]", "ngpt:", "[5/6]", "[6/6]", "ngpt:"]
    assert told[3].startswith("ngpt: error: ") and "3.exr: not an OpenEXR file" in told[3]
    assert told[6] == "ngpt: error: 1 of 6 stacks were not reconstructed"
    assert run.stderr.startswith("denoise: 0/6 frames\n") and "denoise: 6/6 frames, " in run.stderr
    report = json.loads(run.stdout)
    assert [os.path.basename(f["input"]) for f in report["files"]] == [f"{i}.exr" for i in range(6)]
    assert ["error" in f for f in report["files"]] == [False, False, False, True, False, False] and not report["ok"]


def test_a_folder_goes_on_past_existing_results(frames, tmp_path, command):
    out, line = tmp_path / "out", "denoise frames -o out -m l2"
    command(line)
    data, before = (out / "2.exr").read_bytes(), {path.name: path.stat().st_mtime_ns for path in out.iterdir()}
    expected = ngpt.read_image(out / "2.exr")
    (out / "2.exr").unlink()
    assert "--force" in command(line, 1).err and not (out / "2.exr").exists()
    # What a full disk left of a result is none.
    for left in (None, b"", data[:-9]):
        if left is not None:
            (out / "2.exr").write_bytes(left)
        output, errors = command(f"{line} --skip-existing --json")
        skipped = [f.get("skipped", False) for f in json.loads(output)["files"]]
        assert skipped == [True, True, False, True, True, True]
        assert "5.exr: skipped, exists already" in errors and "5 of 6 stacks were skipped" in errors
        assert ("in place of a file that was not whole" in errors) == (left is not None)
        after = {path.name: path.stat().st_mtime_ns for path in out.iterdir()}
        assert after.keys() == before.keys() and {n for n in after if after[n] != before[n]} == {"2.exr"}
        assert np.array_equal(ngpt.read_image(out / "2.exr"), expected)


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
        ("below.%03d.exr", "c.$F3.exr", {"c.-02.exr", "c.-01.exr"}),
    ],
)
def test_names_of_frames_are_the_frames_there_are(tmp_path, command, name, output, found):
    image = np.ones((4, 5, 3), np.float32)
    names = [f"shot.{i}.exr" for i in (10, 1, 2)] + [f"pad.{i:04d}.exr" for i in (12345, 1, 2)]
    for file in (*names, "shot.2_denoised.exr", "pad.01.exr", "below.-01.exr", "below.-02.exr"):
        ngpt.write(file, image)
    for frame, other in ((7, 7), (8, 8), (9, 10)):
        os.makedirs(f"{frame:02d}")
        ngpt.write(f"{frame:02d}/beauty.{other:02d}.exr", image)
    told = command(f"denoise '{name}' -o '{output}' -m primal").err.splitlines()
    told = [line.split()[1] for line in told if line.startswith("[")]
    number = [int(re.sub(r"[^\d-]", "", os.path.basename(path))) for path in told]
    assert number == sorted(number) and len(told) == len(found)
    written = {path.name for path in (tmp_path / "new" if output.startswith("new") else tmp_path).glob("*")}
    assert found <= written


def test_names_of_frames_in_other_verbs(tmp_path, command):
    for name in ("b.%04d.exr", *(f"c.000{i}.exr" for i in (1, 2, 4)), *(f"d.{i}.exr" for i in (1, 2, 4))):
        ngpt.write(tmp_path / name, np.ones((12, 14, 3), np.float32))
    assert "[1/1] b.%04d.exr -> b.%04d_denoised.exr" in command("denoise b.%04d.exr -m primal").err
    assert "c.####.exr -> pics/p.%d.png: 3 frames" in command("picture c.####.exr -o pics/p.%d.png").err
    assert {path.name for path in (tmp_path / "pics").iterdir()} == {"p.1.png", "p.2.png", "p.4.png"}
    told = command("report c.%04d.exr --ref d.%d.exr").err
    assert "c.#.exr goes from 1 to 4 without 3" in told and "flicker is nan: it needs motion vectors" in told


@pytest.mark.parametrize(
    ("pattern", "found"),
    [
        ("dir[1]/*.exr", {"a.exr"}),
        ("dir[1]/x[2]/?.exr", {"b.exr"}),
        ("dir[1]/**/*.exr", {"a.exr", "b.exr"}),
        ("dir[2-9]*/../dir?/c.exr", None),
        ("dir?/c.exr", {"c.exr"}),
    ],
)
def test_folders_win_over_patterns_by_their_names(tmp_path, command, pattern, found):
    for file in ("dir[1]/a.exr", "dir[1]/x[2]/b.exr", "dir1/c.exr"):
        (tmp_path / file).parent.mkdir(exist_ok=True)
        ngpt.write(tmp_path / file, np.ones((4, 5, 3), np.float32))
    for absolute in ("", f"{tmp_path}/"):
        command(f"denoise '{absolute}{pattern}' -o out/ -m primal --force", 0 if found else 1)
        assert not found or {path.name for path in (tmp_path / "out").iterdir()} == found


@pytest.mark.parametrize(
    "line",
    [
        "denoise a.exr -m primal -o 1/2/a.exr",
        "picture a.exr -o 2/a.png",
        "report a.exr -o 3/a.html",
        "train --config tiny --init 5/a.toml",
    ],
)
def test_single_outputs_get_their_folder_and_are_not_replaced_unasked(line, tmp_path, command):
    ngpt.write(tmp_path / "a.exr", full_stack(12, 14))
    command(line)
    assert "exists already; pass --force" in command(line, 1).err
