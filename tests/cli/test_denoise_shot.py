"""``ngpt denoise --temporal``: frames of a shot, in order."""

import json

import numpy as np
import pytest

import ngpt
from ngpt.cli import main
from ngpt.io.exr import read_exr, read_image
from ngpt.sequence.history import Temporal
from ngpt.stack import GradientStack


@pytest.fixture
def shot(tmp_path, rng):
    """Five frames at rest of a grey wall with noise."""
    folder = tmp_path / "shot"
    folder.mkdir()
    for i in range(5):
        image = np.ones((20, 24, 3)) + rng.normal(0, 0.2, (20, 24, 3))
        layers = {"primal": image, "primal_var": np.full(image.shape, 0.04), "motion": np.zeros((20, 24, 2))}
        attributes = {"ngpt:frame": i, "ngpt:previousFrame": i - 1}
        ngpt.write(folder / f"w.{i:04d}.exr", GradientStack(layers, attributes))
    return folder


def test_the_command_does_what_the_class_does(shot, tmp_path, capsys):
    out = tmp_path / "clean"
    assert main(["denoise", str(shot), "-o", f"{out}/", "--temporal", "-m", "primal", "--json"]) == 0
    told = capsys.readouterr()
    reports = json.loads(told.out)["files"]
    temporal = Temporal()
    for path, report in zip(sorted(shot.iterdir()), reports, strict=True):
        stack = ngpt.read(path)
        assert np.array_equal(read_image(out / path.name), temporal.next(stack, stack["primal"]))
        assert np.isclose(report["history"], temporal.share)
        header = read_exr(out / path.name).parts[0].header
        assert np.isclose(header["ngpt:history"], temporal.share)
        if temporal.corrections is not None:
            assert header["ngpt:historyWeights"].startswith("temporal.onnx sha256:")
    assert reports[0]["history"] == 0 and reports[4]["history"] > 0.6
    assert "% history" in told.err


def test_going_on_gives_the_same_bits(shot, tmp_path, capsys):
    words = ["denoise", str(shot), "--temporal", "-m", "primal"]
    assert main([*words, "-o", f"{tmp_path / 'whole'}/"]) == 0
    assert main([*words, "-o", f"{tmp_path / 'parts'}/"]) == 0
    for gone in (3, 1):
        (tmp_path / f"parts/w.{gone:04d}.exr").unlink()
    kept = (tmp_path / "parts/w.0002.exr").stat().st_mtime_ns
    capsys.readouterr()
    assert main([*words, "-o", f"{tmp_path / 'parts'}/", "--skip-existing"]) == 0
    assert "3 of 5 stacks were skipped" in capsys.readouterr().err
    assert (tmp_path / "parts/w.0002.exr").stat().st_mtime_ns == kept
    for i in range(5):
        images = [read_image(tmp_path / kind / f"w.{i:04d}.exr") for kind in ("whole", "parts")]
        assert np.array_equal(*images)


@pytest.mark.parametrize("option", [["--error"], ["--groups"], ["--group", "fog*"]])
def test_what_history_does_not_hold_is_refused(shot, option, capsys):
    assert main(["denoise", str(shot), "--temporal", *option]) == 2
    assert "--temporal goes without" in capsys.readouterr().err
