"""``ngpt denoise --temporal``: frames of a shot, in order, by history or by windows."""

import json

import numpy as np
import pytest
from exr_files import write_raw
from shots import wall, without

import ngpt
from ngpt.cli import main
from ngpt.io.exr import read_exr, read_image
from ngpt.sequence.wcv_windows import LENGTH, reconstruct_shot


def written(folder, stacks):
    folder.mkdir()
    for i, stack in enumerate(stacks):
        ngpt.write(folder / f"w.{i:04d}.exr", stack)
    return folder


@pytest.fixture
def rest(tmp_path, rng):
    """Five frames at rest, without differences in time."""
    return written(tmp_path / "rest", [without(stack, "dt", "dt_var") for stack in wall(rng, 5, growth=0)])


@pytest.fixture
def shot(tmp_path, rng):
    """Frames of more than one window."""
    return written(tmp_path / "shot", wall(rng, LENGTH + 4))


def denoised(shot, out, *more):
    """The exit status of the command for a shot."""
    return main(["denoise", str(shot), "-o", f"{out}/", "--temporal", *more])


def made_by(folder):
    """The attribute that says which way a frame went, of each."""
    return [read_exr(path).parts[0].header["ngpt:temporal"] for path in sorted(folder.iterdir())]


def test_history_is_what_the_class_does(rest, tmp_path, capsys):
    assert denoised(rest, tmp_path / "clean", "-m", "primal", "--json") == 0
    told = capsys.readouterr()
    temporal = ngpt.Temporal()
    reports = json.loads(told.out)["files"]
    for path, report in zip(sorted(rest.iterdir()), reports, strict=True):
        stack = ngpt.read(path)
        assert np.array_equal(read_image(tmp_path / "clean" / path.name), temporal.next(stack, stack["primal"]))
        header = read_exr(tmp_path / "clean" / path.name).parts[0].header
        assert report["history"] == temporal.share and np.isclose(header["ngpt:history"], temporal.share)
        if temporal.corrections is not None:
            assert header["ngpt:historyWeights"].startswith("temporal.onnx sha256:")
    assert reports[0]["history"] == 0 and reports[4]["history"] > 0.6 and reports[4]["temporal"] == "history"
    assert "--temporal: history" in told.err and "% history" in told.err


def test_windows_are_what_the_function_does(shot, tmp_path, capsys):
    assert denoised(shot, tmp_path / "clean", "-m", "wcv", "--json") == 0
    told = capsys.readouterr()
    results = reconstruct_shot(ngpt.read(path) for path in sorted(shot.iterdir()))
    for report, (_, stack, result) in zip(json.loads(told.out)["files"], results, strict=True):
        assert np.array_equal(read_image(report["output"]), result.image) and report["input"] == stack.path
        assert (report["method"], report["temporal"], report["options"]) == ("wcv", "windows", {})
    assert f"--temporal: windows of {LENGTH} frames" in told.err


@pytest.mark.parametrize(("which", "method"), [("rest", "primal"), ("shot", "wcv")])
def test_going_on_gives_the_same_bits(which, method, request, tmp_path, capsys):
    frames, parts = request.getfixturevalue(which), tmp_path / "parts"
    assert denoised(frames, tmp_path / "whole", "-m", method) == denoised(frames, parts, "-m", method) == 0
    for gone in (3, 1):
        (parts / f"w.{gone:04d}.exr").unlink()
    kept = (parts / "w.0002.exr").stat().st_mtime_ns
    capsys.readouterr()
    assert denoised(frames, parts, "-m", method, "--skip-existing") == 0
    count = len(list(frames.iterdir()))
    assert f"{count - 2} of {count} stacks were skipped" in capsys.readouterr().err
    assert (parts / "w.0002.exr").stat().st_mtime_ns == kept
    for path in parts.iterdir():
        assert np.array_equal(read_image(path), read_image(tmp_path / "whole" / path.name))
    assert denoised(frames, parts, "-m", method, "--skip-existing") == 0
    assert "--temporal" not in capsys.readouterr().err


@pytest.mark.parametrize("damaged", [0, 3, LENGTH + 3])
def test_a_file_that_cannot_be_read_is_a_cut_and_changes_no_other_frame(shot, tmp_path, damaged, capsys):
    """Above all not their method: it is chosen by all files that can be read."""
    (shot / f"w.{damaged:04d}.exr").write_bytes(b"nothing")
    assert denoised(shot, tmp_path / "clean", "-m", "wcv") == 1
    told = capsys.readouterr().err
    assert f"w.{damaged:04d}.exr" in told and "--temporal: windows" in told
    assert made_by(tmp_path / "clean") == ["windows"] * (LENGTH + 3)


def test_one_frame_without_differences_in_time_makes_it_history_and_is_named(shot, tmp_path, capsys):
    """Wherever it is, but for the first, which needs none."""
    first = shot / "w.0000.exr"
    ngpt.write(first, without(ngpt.read(first), "dt"), overwrite=True)
    assert denoised(shot, tmp_path / "windows", "-m", "wcv") == 0
    fifth = shot / "w.0004.exr"
    ngpt.write(fifth, without(ngpt.read(fifth), "dt_var"), overwrite=True)
    capsys.readouterr()
    assert denoised(shot, tmp_path / "history", "-m", "wcv") == 0
    assert f"{fifth} lacks some" in capsys.readouterr().err
    assert {*made_by(tmp_path / "windows")} == {"windows"} and {*made_by(tmp_path / "history")} == {"history"}


def test_frames_are_blended_in_the_order_of_their_numbers(rest, tmp_path, capsys):
    """Names of Houdini and of scripts: f.1 to f.12, without ``ngpt:frame``."""
    plain, folder = ngpt.read(next(rest.iterdir())), tmp_path / "houdini"
    folder.mkdir()
    for i in (1, 2, 10, 11):
        ngpt.write(folder / f"f.{i}.exr", ngpt.GradientStack(plain.layers))
    (folder / "._f.1.exr").write_bytes(b"of macOS")
    ngpt.write(folder / "f.2_denoised.exr", ngpt.GradientStack(plain.layers))
    assert denoised(folder, tmp_path / "clean", "-m", "primal", "--json") == 0
    told = capsys.readouterr()
    reports = json.loads(told.out)["files"]
    assert [report["input"] for report in reports] == [str(folder / f"f.{i}.exr") for i in (1, 2, 10, 11)]
    assert reports[0]["history"] == 0 < reports[1]["history"] < reports[3]["history"]
    assert f"{folder}: f.#.exr goes from 1 to 11 without 3 to 9" in told.err


def test_why_history_is_nothing_is_said(rest, tmp_path, capsys):
    """By Cycles' names of motion, by others that have to be chosen, and without any."""
    stacks = [ngpt.read(path) for path in sorted(rest.iterdir())]
    names = {"primal": "ViewLayer.Combined", "primal_var": "primal_var"}
    for name, suffixes in (("Vector", "XYZW"), ("motionvector", "RGB"), ("nothing", "")):
        (tmp_path / name).mkdir()
        for path, stack in zip(sorted(rest.iterdir()), stacks, strict=True):
            channels = {f"{other}.{c}": stack[k][..., i] for k, other in names.items() for i, c in enumerate("RGB")}
            still = np.zeros(stack["primal"].shape[:2], np.float32)
            channels |= {f"ViewLayer.{name}.{c}": still for c in suffixes}
            write_raw(tmp_path / name / path.name, (channels,))

    def shares(folder, *more):
        out = tmp_path / f"{folder.name}{len(more)}"
        assert denoised(folder, out, "-m", "primal", "--json", *more) == 0
        told = capsys.readouterr()
        files = json.loads(told.out)["files"]
        return [f["history"] for f in files], [f.get("why no history", "") for f in files], told.err

    found, why, _ = shares(tmp_path / "Vector")
    assert found[0] == 0 and found[-1] > 0.5 and why == ["the first frame", "", "", "", ""]
    found, why, told = shares(tmp_path / "motionvector")
    assert found == [0] * 5 and why == ["the first frame"] + ["no layer 'motion'"] * 4
    assert "0% history (no layer 'motion')" in told
    remedy = "motion=-ViewLayer.motionvector.R,ViewLayer.motionvector.G"
    assert f"y up: --layer {remedy}" in told
    assert shares(tmp_path / "motionvector", "--layer", remedy)[0][-1] > 0.5
    _, _, told = shares(tmp_path / "nothing")
    assert "without the layer 'motion' each frame is denoised by itself; see" in told


def test_each_view_has_a_history_of_its_own(rest, tmp_path, capsys):
    folder = tmp_path / "stereo"
    folder.mkdir()
    for i, path in enumerate(sorted(rest.iterdir())):
        stack = ngpt.read(path)
        channels = {}
        for view, scale in (("", 1), ("right.", 3)):
            channels |= {f"{view}{c}": scale * stack["primal"][..., k] for k, c in enumerate("RGB")}
            channels |= {f"{view}primal_var.{c}": scale**2 * stack["primal_var"][..., k] for k, c in enumerate("RGB")}
            channels |= {f"{view}motion.{c}": stack["motion"][..., k] for k, c in enumerate("XY")}
        write_raw(folder / f"f.{i}.exr", (channels, {"multiView": ["left", "right"]}))
    assert denoised(folder, tmp_path / "clean", "-m", "primal", "--json") == 0
    files = json.loads(capsys.readouterr().out)["files"]
    assert all(f["views"] == ["left", "right"] for f in files) and files[-1]["history"] > 0.5
    for view in ("left", "right"):
        temporal = ngpt.Temporal()
        for path in sorted(folder.iterdir()):
            stack = ngpt.read(path, view=view)
            image = temporal.next(stack, stack["primal"])
        channels = read_exr(tmp_path / "clean" / path.name).parts[0].channels
        assert np.array_equal(channels["right.G" if view == "right" else "G"], image[..., 1])
    words = ["denoise", str(folder / "f.0.exr"), "-o"]
    for target, more in (("a.png", []), ("a.exr", ["--ref", str(folder / "f.1.exr")])):
        assert main([*words, str(tmp_path / target), *more, "-m", "primal"]) == 1
        assert "has several views, and" in capsys.readouterr().err
        assert main([*words, str(tmp_path / target), *more, "-m", "primal", "--view", "right"]) == 0
