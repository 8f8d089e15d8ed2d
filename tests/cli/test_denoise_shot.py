"""``ngpt denoise --temporal``: frames of a shot, in order, by history or by windows."""

import json
import shutil

import numpy as np
import pytest
from exr_files import write_raw
from shots import wall, without

import ngpt
from ngpt.io.exr import read_image, with_channels
from ngpt.io.openexr import read_exr
from ngpt.sequence.wcv_windows import LENGTH, reconstruct_shot
from ngpt.stack import GradientStack


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    rng, folder = np.random.default_rng(20261121), tmp_path_factory.mktemp("frames")
    rest = [without(stack, "dt", "dt_var") for stack in wall(rng, 5, growth=0)]
    for name, stacks in (("rest", rest), ("shot", wall(rng, LENGTH + 4))):
        (folder / name).mkdir()
        for i, stack in enumerate(stacks):
            ngpt.write(folder / name / f"w.{i:04d}.exr", stack)
    return folder


@pytest.fixture
def frames(written, tmp_path):
    """Five frames at rest without differences in time, ``rest``, and a shot of more than one window, ``shot``."""
    return shutil.copytree(written, tmp_path, dirs_exist_ok=True)


@pytest.fixture
def denoised(frames, command):
    """Calls the command for a shot."""

    def call(shot, out, more="", status=0):
        return command(f"denoise {shot} -o {out}/ --temporal -m {'wcv' if shot == 'shot' else 'primal'} {more}", status)

    return call


def made_by(folder):
    """The attribute that says which way a frame went, of each."""
    return [read_exr(path).parts[0].header["ngpt:temporal"] for path in sorted(folder.iterdir())]


def test_history_is_what_the_class_does(frames, denoised):
    output, errors = denoised("rest", "clean", "--json")
    temporal, reports = ngpt.Temporal(), json.loads(output)["files"]
    for report in reports:
        stack = ngpt.read(report["input"])
        assert np.array_equal(read_image(report["output"]), temporal.next(stack, stack["primal"]))
        header = read_exr(report["output"]).parts[0].header
        assert report["history"] == temporal.share and np.isclose(header["ngpt:history"], temporal.share)
        assert temporal.corrections is None or header["ngpt:historyWeights"].startswith("temporal.onnx sha256:")
    assert reports[0]["history"] == 0 and reports[4]["history"] > 0.6 and reports[4]["temporal"] == "history"
    assert "--temporal: history" in errors and "% history" in errors


def test_windows_are_what_the_function_does(frames, denoised):
    output, errors = denoised("shot", "clean", "--json")
    results = reconstruct_shot(ngpt.read(path) for path in sorted((frames / "shot").iterdir()))
    for report, (_, stack, result) in zip(json.loads(output)["files"], results, strict=True):
        assert np.array_equal(read_image(report["output"]), result.image) and stack.path.endswith(report["input"])
        assert (report["method"], report["temporal"], report["options"]) == ("wcv", "windows", {})
    assert f"--temporal: windows of {LENGTH} frames" in errors


@pytest.mark.parametrize("shot", ["rest", "shot"])
def test_going_on_gives_the_same_bits(shot, frames, denoised):
    denoised(shot, "parts")
    whole = {path.name: read_image(path) for path in (frames / "parts").iterdir()}
    for gone in (3, 1):
        (frames / f"parts/w.{gone:04d}.exr").unlink()
    kept = (frames / "parts/w.0002.exr").stat().st_mtime_ns
    told = denoised(shot, "parts", "--skip-existing").err
    assert f"{len(whole) - 2} of {len(whole)} stacks were skipped" in told
    assert (frames / "parts/w.0002.exr").stat().st_mtime_ns == kept
    assert all(np.array_equal(read_image(frames / "parts" / name), image) for name, image in whole.items())
    assert "--temporal" not in denoised(shot, "parts", "--skip-existing").err


@pytest.mark.parametrize("damaged", [0, LENGTH + 3, pytest.param(3, marks=pytest.mark.slow)])
def test_a_file_that_cannot_be_read_is_a_cut_and_changes_no_other_frame(frames, damaged, denoised):
    """Above all not their method: it is chosen by all files that can be read."""
    (frames / f"shot/w.{damaged:04d}.exr").write_bytes(b"nothing")
    told = denoised("shot", "clean", status=1).err
    assert f"w.{damaged:04d}.exr" in told and "--temporal: windows" in told
    assert made_by(frames / "clean") == ["windows"] * (LENGTH + 3)


def test_one_frame_without_differences_in_time_makes_it_history_and_is_named(frames, denoised):
    """Wherever it is, but for the first, which needs none."""
    first, fifth = (frames / f"shot/w.{i:04d}.exr" for i in (0, 4))
    ngpt.write(first, without(ngpt.read(first), "dt"), overwrite=True)
    denoised("shot", "windows")
    ngpt.write(fifth, without(ngpt.read(fifth), "dt_var"), overwrite=True)
    assert "shot/w.0004.exr lacks some" in denoised("shot", "history").err
    assert {*made_by(frames / "windows")} == {"windows"} and {*made_by(frames / "history")} == {"history"}


def test_frames_are_blended_in_the_order_of_their_numbers(frames, denoised):
    """Names of Houdini and of scripts: f.1 to f.12, without ``ngpt:frame``."""
    plain = ngpt.GradientStack(ngpt.read(frames / "rest/w.0000.exr").layers)
    (frames / "houdini").mkdir()
    for name in ("1", "2", "10", "11", "2_denoised"):
        ngpt.write(frames / f"houdini/f.{name}.exr", plain)
    output, errors = denoised("houdini", "clean", "--json")
    reports = json.loads(output)["files"]
    assert [report["input"] for report in reports] == [f"houdini/f.{i}.exr" for i in (1, 2, 10, 11)]
    assert reports[0]["history"] == 0 < reports[1]["history"] < reports[3]["history"]
    assert "houdini: f.#.exr goes from 1 to 11 without 3 to 9" in errors


def layers_named(stack, names):
    """The channels of a file that holds layers under other names: layer -> name."""
    return {f"{other}{c}": stack[k][..., i] for k, other in names.items() for i, c in enumerate("RGB")}


def test_why_history_is_nothing_is_said_and_a_layer_of_motion_is_proposed(frames, denoised):
    (frames / "odd").mkdir()
    for path in (frames / "rest").iterdir():
        stack, nought = ngpt.read(path), np.zeros((16, 20), np.float32)
        stack = GradientStack({name: stack[name] for name in ("primal", "primal_var")})
        ngpt.write(frames / "odd" / path.name, with_channels(stack, {f"motionvector.{c}": nought for c in "RGB"}))
    option = "--layer motion=-motionvector.R,motionvector.G"
    for more, reason in (("", "no layer 'motion'"), (f"{option} --force", "")):
        output, errors = denoised("odd", "clean", f"--json {more}")
        files = json.loads(output)["files"]
        assert [f.get("why no history", "") for f in files] == ["the first frame", *[reason] * 4]
        assert files[0]["history"] == 0 and (files[4]["history"] > 0.5) == (not reason)
        for said in ("without the layer 'motion' each frame is", "0% history (no layer 'motion')", f"y up: {option}"):
            assert (said in errors) == bool(reason), said


def test_each_view_has_a_history_of_its_own(frames, denoised):
    (frames / "stereo").mkdir()
    for path in (frames / "rest").iterdir():
        stack = ngpt.read(path)
        channels = layers_named(stack, {"primal": "", "primal_var": "primal_var."})
        right = {"primal": 3 * stack["primal"], "primal_var": 9 * stack["primal_var"]}
        channels |= layers_named(right, {"primal": "right.", "primal_var": "right.primal_var."})
        channels |= {f"{view}motion.{c}": stack["motion"][..., 0] for view in ("", "right.") for c in "XY"}
        write_raw(frames / "stereo" / path.name, (channels, {"multiView": ["left", "right"]}))
    files = json.loads(denoised("stereo", "clean", "--json").out)["files"]
    assert all(f["views"] == ["left", "right"] for f in files) and files[-1]["history"] > 0.5
    for view in ("left", "right"):
        temporal = ngpt.Temporal()
        for file in files:
            stack = ngpt.read(file["input"], view=view)
            image = temporal.next(stack, stack["primal"])
        assert np.array_equal(read_image(files[-1]["output"], view=view), image)
