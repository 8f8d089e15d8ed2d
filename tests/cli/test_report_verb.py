"""``ngpt report``: images of any renderers on one page, their names, their errors, and what cannot be compared."""

import json
import re

import numpy as np
import pytest

from ngpt.cli import main
from ngpt.io.exr import read, with_channels, write, write_exr
from ngpt.io.openexr import ExrImage, ExrPart
from ngpt.measure.metrics import METRICS
from ngpt.stack import GradientStack


@pytest.fixture
def image(rng):
    return rng.gamma(2.0, 0.5, (24, 32, 3)).astype(np.float32)


def facts(page):
    """What the page's script is told of its scene."""
    return json.loads(re.search(r'id="page">(.*?)</script>', page.read_text()).group(1))["scenes"][0]


def test_images_of_two_renderers_on_one_page(tmp_path, image, capfd):
    pytest.importorskip("skimage")
    pytest.importorskip("flip_evaluator")
    channels = {f"ViewLayer.Combined.{c}": image[:, :, i] * np.float32(1.2) for i, c in enumerate("RGB")}
    write_exr(tmp_path / "cycles.exr", ExrImage([ExrPart("", {}, channels)]))
    write(tmp_path / "mine.exr", image * np.float32(1.1))
    write(tmp_path / "truth.exr", image)
    page = tmp_path / "page.html"
    words = [str(tmp_path / name) for name in ("cycles.exr", "mine.exr")]
    assert main(["report", *words, "--ref", str(tmp_path / "truth.exr"), "-o", str(page)]) == 0
    output, messages = capfd.readouterr()
    shown = facts(page)
    assert shown["pictures"] == ["cycles", "mine", "reference"] and shown["maps"] == ["SSIM", "FLIP"]
    assert (shown["a"], shown["b"], shown["width"], shown["height"]) == ("cycles", "mine", 32, 24)
    table = {line.split()[0]: [float(word) for word in line.split()[1:]] for line in output.splitlines()[1:]}
    for name, factor in (("cycles", np.float32(1.2)), ("mine", np.float32(1.1))):
        expected = METRICS["relMSE"].function(image * factor, image)
        assert table[name][0] == pytest.approx(expected, rel=1e-3)
    assert table["cycles"][5] > table["mine"][5] > 0  # FLIP
    assert METRICS["FLIP"].formula in page.read_text() and "data-map=" in page.read_text()
    assert messages.endswith(f"{page}: open it in a browser\n") and "errors: 2/2 images" in messages


def test_of_one_file_all_layers_are_shown(tmp_path, image, rng):
    stack = GradientStack.from_arrays(primal=image, dx=image, albedo=image / 9, motion=image[..., :2])
    stack = with_channels(stack, {"diagnostics.discarded": image[..., 0]})
    write(tmp_path / "stack.exr", stack)
    write(tmp_path / "result.exr", image / 2, like=read(tmp_path / "stack.exr"))
    expected = {"stack": ["stack"], "result": ["result", "primal"]}
    for name, pictures in expected.items():
        assert main(["report", "-q", str(tmp_path / f"{name}.exr"), "-o", str(tmp_path / f"{name}.html")]) == 0
        shown = facts(tmp_path / f"{name}.html")
        assert shown["pictures"] == pictures
        assert shown["layers"] == ["dx", "albedo", "motion", "diagnostics.discarded"]
    assert (shown["a"], shown["b"]) == ("primal", "result")


def test_files_of_one_name_are_told_apart_by_their_folders(tmp_path, image):
    for folder in ("spp16", "spp64"):
        (tmp_path / folder).mkdir()
        write(tmp_path / folder / "reference.exr", image)
    words = [str(tmp_path / folder / "reference.exr") for folder in ("spp16", "spp64")]
    assert main(["report", *words, "--ref", words[1], "-o", str(tmp_path / "page.html")]) == 0
    assert facts(tmp_path / "page.html")["pictures"] == ["spp16/reference", "spp64/reference", "reference"]


def test_folders_of_frames_are_shots(tmp_path, rng, capsys):
    image = rng.gamma(2.0, 0.5, (24, 32, 3)).astype(np.float32)
    still = np.zeros((24, 32, 2), np.float32)
    for folder in ("steady", "flickers", "truth"):
        (tmp_path / folder).mkdir()
    for i in range(3):
        noise = 0.1 * rng.normal(size=image.shape).astype(np.float32)
        write(tmp_path / f"steady/{i}.exr", GradientStack({"primal": 1.1 * image, "motion": still}))
        write(tmp_path / f"flickers/{i}.exr", image + noise)
        write(tmp_path / f"truth/{i}.exr", image)
    words = ["report", *(str(tmp_path / folder) for folder in ("steady", "flickers"))]
    page = tmp_path / "page.html"
    assert main([*words, "--ref", str(tmp_path / "truth"), "-o", str(page), "-q"]) == 0
    rows = {line.split()[0]: line.split() for line in capsys.readouterr().out.splitlines()}
    assert float(rows["steady"][-1]) < 1e-10 and float(rows["flickers"][-1]) > 0.001
    assert float(rows["steady"][1]) > 0.005  # relMSE, which sees no difference
    text = page.read_text()
    assert "Means over 3 frames" in text and "along motion" in text
    played = json.loads(re.search(r'id="page">(.*?)</script>', text).group(1))
    assert played["shot"] and all(scene["maps"][-2:] == ["change", "flicker"] for scene in played["scenes"])
    assert len({scene["stops"] for scene in played["scenes"]}) == 1
    assert main([*words, "-o", str(tmp_path / "plain.html"), "-q"]) == 0
    assert facts(tmp_path / "plain.html")["maps"] == ["change"]
    (tmp_path / "flickers/1.exr").unlink()
    assert main([*words, "-o", str(tmp_path / "other.html"), "-q"]) == 1
    assert "has 1.exr and" in capsys.readouterr().err
    assert main([words[0], words[1], str(tmp_path / "truth/0.exr"), "-o", str(tmp_path / "other.html")]) == 1
    assert "is no folder, and others are" in capsys.readouterr().err


def test_frames_play_in_the_order_of_numbers_and_results_beside_them_are_compared(tmp_path, rng):
    image = rng.gamma(2.0, 0.5, (24, 32, 3)).astype(np.float32)
    folder = tmp_path / "shot"
    folder.mkdir()
    for i in (1, 2, 10):
        write(folder / f"f.{i}.exr", image * np.float32(i))
        write(folder / f"f.{i}_denoised.exr", image * np.float32(2 * i))
    (folder / "._f.1.exr").write_bytes(b"of macOS")
    page = tmp_path / "page.html"
    for words, count in (([str(folder)], 1), ([str(folder), f"{folder}/*_denoised.exr"], 2)):
        assert main(["report", *words, "-o", str(page), "--force", "-q"]) == 0
        text = page.read_text()
        assert list(dict.fromkeys(re.findall(r"f\.\d+", text))) == ["f.1", "f.2", "f.10"]
        played = json.loads(re.search(r'id="page">(.*?)</script>', text).group(1))
        assert [len(scene["pictures"]) for scene in played["scenes"]] == [count] * 3
