"""``ngpt report``: images of any renderers on one page, their names, their errors, and what cannot be compared."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from ngpt.io.exr import read, with_channels, write
from ngpt.io.openexr import ExrImage, ExrPart, write_exr
from ngpt.measure.metrics import METRICS
from ngpt.stack import GradientStack


@pytest.fixture
def image(rng):
    return rng.gamma(2.0, 0.5, (24, 32, 3)).astype(np.float32)


def told(page):
    """What the page's script is told."""
    return json.loads(re.search(r'id="page">(.*?)</script>', Path(page).read_text()).group(1))


def facts(page):
    return told(page)["scenes"][0]


def test_images_of_two_renderers_on_one_page(tmp_path, image, command):
    pytest.importorskip("skimage")
    pytest.importorskip("flip_evaluator")
    channels = {f"ViewLayer.Combined.{c}": image[:, :, i] * np.float32(1.2) for i, c in enumerate("RGB")}
    write_exr(tmp_path / "cycles.exr", ExrImage([ExrPart("", {}, channels)]))
    write(tmp_path / "mine.exr", image * np.float32(1.1))
    write(tmp_path / "truth.exr", image)
    output, messages = command("report cycles.exr mine.exr --ref truth.exr -o page.html")
    shown = facts("page.html")
    assert shown["pictures"] == ["cycles", "mine", "reference"] and shown["maps"] == ["SSIM", "FLIP"]
    assert (shown["a"], shown["b"], shown["width"], shown["height"]) == ("cycles", "mine", 32, 24)
    table = {line.split()[0]: [float(word) for word in line.split()[1:]] for line in output.splitlines()[1:]}
    for name, factor in (("cycles", np.float32(1.2)), ("mine", np.float32(1.1))):
        assert table[name][0] == pytest.approx(METRICS["relMSE"].function(image * factor, image), rel=1e-3)
    assert table["cycles"][5] > table["mine"][5] > 0  # FLIP
    assert METRICS["FLIP"].formula in (tmp_path / "page.html").read_text()
    assert messages.endswith("page.html: open it in a browser\n") and "errors: 2/2 images" in messages


def test_of_one_file_all_layers_are_shown(tmp_path, image, command):
    stack = GradientStack.from_arrays(primal=image, dx=image, albedo=image / 9, motion=image[..., :2])
    stack = with_channels(stack, {"diagnostics.discarded": image[..., 0]})
    write(tmp_path / "stack.exr", stack)
    write(tmp_path / "result.exr", image / 2, like=read(tmp_path / "stack.exr"))
    for name, pictures in (("stack", ["stack"]), ("result", ["result", "primal"])):
        command(f"report -q {name}.exr -o {name}.html")
        shown = facts(f"{name}.html")
        assert shown["pictures"] == pictures
        assert shown["layers"] == ["dx", "albedo", "motion", "diagnostics.discarded"]
    assert (shown["a"], shown["b"]) == ("primal", "result")


def test_files_of_one_name_are_told_apart_by_their_folders(tmp_path, image, command):
    for folder in ("spp16", "spp64"):
        (tmp_path / folder).mkdir()
        write(tmp_path / folder / "reference.exr", image)
    command("report spp16/reference.exr spp64/reference.exr --ref spp64/reference.exr -o page.html")
    assert facts("page.html")["pictures"] == ["spp16/reference", "spp64/reference", "reference"]


def test_folders_of_frames_are_shots(tmp_path, image, rng, command):
    for folder in ("steady", "flickers", "truth"):
        (tmp_path / folder).mkdir()
    for i in range(3):
        steady = GradientStack({"primal": 1.1 * image, "motion": np.zeros((24, 32, 2), np.float32)})
        noise = 0.1 * rng.normal(size=image.shape).astype(np.float32)
        for folder, frame in (("steady", steady), ("flickers", image + noise), ("truth", image)):
            write(tmp_path / folder / f"{i}.exr", frame)
    output = command("report -q steady flickers --ref truth -o page.html").out
    rows = {line.split()[0]: line.split() for line in output.splitlines()}
    assert float(rows["steady"][-1]) < 1e-10 and float(rows["flickers"][-1]) > 0.001
    assert float(rows["steady"][1]) > 0.005  # relMSE, which sees no difference
    page = (tmp_path / "page.html").read_text()
    assert "Means over 3 frames" in page and "along motion" in page
    played = told("page.html")
    assert played["shot"] and all(scene["maps"][-2:] == ["change", "flicker"] for scene in played["scenes"])
    assert len({scene["stops"] for scene in played["scenes"]}) == 1
    command("report -q steady flickers -o plain.html")
    assert facts("plain.html")["maps"] == ["change"]
    (tmp_path / "flickers/1.exr").unlink()
    assert "has 1.exr and" in command("report -q steady flickers -o other.html", 1).err
