"""Files whose pixels are a part of a picture, or reach beyond it: they are compared and shown where they lie."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from exr_files import write_raw
from shots import SIZE, frame_of, part_of, view

import ngpt
from ngpt.cli import main
from ngpt.io.exr import read_picture
from ngpt.io.foreign.pfm import write_pfm
from ngpt.io.frames import shot_files
from ngpt.stack import GradientStack
from ngpt.windows import Place, Window

HEIGHT, WIDTH = SIZE
WHOLE = Window(0, 0, WIDTH, HEIGHT)


@pytest.fixture
def stack(rng):
    return frame_of(*view(), rng, **{"ngpt:spp": 4, "ngpt:seed": "1", "ngpt:sampler": "gpt"})


def written(path, stack, *window, **at):
    """The file of a part of a stack; ``at`` replaces windows of its place."""
    part = part_of(stack, *window) if window else stack
    if at:
        place = {"data": part.place.data, "display": part.place.display} | at
        part = GradientStack(part.layers, part.attributes, place=Place(**place))
    return str(ngpt.write(path, part, overwrite=True))


def pixels(path):
    from PIL import Image

    return np.asarray(Image.open(path))


def test_a_place_survives_files_and_results(stack, tmp_path):
    path = written(tmp_path / "part.exr", stack, 16, 8, 24, 20)
    part = ngpt.read(path)
    assert part.place == Place(Window(16, 8, 24, 20), WHOLE) == read_picture(path).place
    for other in (part.replace(alpha=np.ones((20, 24))), part):
        assert ngpt.read(ngpt.write(tmp_path / "again.exr", other, overwrite=True)).place == part.place
    assert main(["denoise", path, "-o", str(tmp_path / "result.exr"), "-m", "primal"]) == 0
    assert ngpt.read(tmp_path / "result.exr").place == part.place
    # The layers are cut and the place is not: nothing is known of where they lie.
    assert GradientStack({"primal": part["primal"][:5]}, place=part.place).place == Place.whole(24, 5)


@pytest.mark.parametrize(
    ("one", "other", "common"),
    [
        ((0, 0, 40, 30), (16, 8, 40, 30), "24x22 at (16, 8)"),
        ((0, 0, WIDTH, HEIGHT), (16, 8, 24, 20), "24x20 at (16, 8)"),
        ((3, 5, 30, 30), (3, 5, 30, 30), ""),
    ],
)
def test_diff_compares_where_both_have_pixels(one, other, common, stack, tmp_path, capfd):
    files = [written(tmp_path / name, stack, *window) for name, window in (("a.exr", one), ("b.exr", other))]
    assert main(["diff", *files, "--json"]) == 0
    out, err = capfd.readouterr()
    assert json.loads(out)["metrics"]["max |x - r|"] == 0
    assert err.strip() == (f"compared are the pixels that all images have: {common}" if common else "")


def test_a_file_that_lost_its_place_lies_where_one_of_its_size_does(stack, tmp_path, capfd):
    """As programs write it that know no windows: Mitsuba's crops, PNG."""
    part = written(tmp_path / "part.exr", stack, 16, 8, 24, 20)
    lost = written(tmp_path / "lost.exr", GradientStack({"primal": ngpt.read_image(part)}))
    for pair in ([part, lost], [lost, part]):
        assert main(["diff", *pair]) == 0 and not capfd.readouterr().err


def test_errors_of_results_are_those_of_the_place(stack, tmp_path, capfd):
    clean = frame_of(*view(), np.random.default_rng(0), sigma=0)
    reference = written(tmp_path / "ref.exr", clean, 10, 4, 40, 30)
    parts = [written(tmp_path / f"{x}.exr", stack, x, 8, 24, 20) for x in (12, 0)]
    (tmp_path / "out").mkdir()
    command = ["denoise", *parts, "-o", str(tmp_path / "out"), "-m", "primal", "--ref", reference, "--json"]
    assert main(command) == 0
    out, err = capfd.readouterr()
    inside, partly = json.loads(out)["files"]
    truth = clean["primal"]
    for report, window in ((inside, Window(12, 8, 24, 20)), (partly, Window(10, 8, 14, 20))):
        there = window.within(WHOLE)
        expected = np.mean(np.square(stack["primal"][there] - truth[there]))
        assert report["metrics"]["MSE"] == pytest.approx(expected, rel=1e-5)
        assert report["compared"] == str(window) and f"of the pixels that both have: {window}" in err


def test_a_report_of_a_shot_shows_display_windows(stack, tmp_path, capfd):
    """The subject rests and is cut in another way in each frame: nothing changes, and nothing is wrong."""
    shot, refs = tmp_path / "shot", tmp_path / "refs"
    for folder in (shot, refs):
        folder.mkdir()
    for i in range(3):
        written(shot / f"f.{i}.exr", stack, 3 * i, i, 30 + i, 30)
        written(refs / f"f.{i}.exr", stack)
    page = tmp_path / "page.html"
    assert main(["report", str(shot), "--ref", str(refs), "-o", str(page)]) == 0
    out, err = capfd.readouterr()
    assert "3 of 3 frames: compared are the pixels that all images have" in err
    assert re.search(r"shot +0 +0 ", out) and out.split()[-1] == "0" and f"{WIDTH}x{HEIGHT}" in page.read_text()


@pytest.mark.parametrize("target", ["film.webp", "frames"])
def test_films_show_display_windows(target, stack, tmp_path):
    shot = tmp_path / "shot"
    shot.mkdir()
    for i, window in enumerate([(0, 0, WIDTH, HEIGHT), (4, 2, 30, 20), (20, 10, 36, 30)]):
        written(shot / f"f.{i}.exr", stack, *window)
    assert main(["picture", str(shot), "-o", str(tmp_path / target)]) == 0
    if target == "film.webp":
        from PIL import Image, ImageSequence

        frames = [np.asarray(frame.convert("RGB")) for frame in ImageSequence.Iterator(Image.open(tmp_path / target))]
    else:
        frames = [pixels(path) for path in sorted((tmp_path / target).iterdir())]
    assert all(frame.shape == (HEIGHT, WIDTH, 3) for frame in frames) and len(frames) == 3
    there = Window(4, 2, 30, 20).within(WHOLE)
    assert np.array_equal(frames[1][there], frames[0][there]) and not frames[1][:2].any()


def test_views_windows_other_formats_and_names_of_frames_go_together(stack, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    noisy, image = stack["primal"], np.ones((4, 6), np.float32)
    write_raw("eyes.exr", ({f"{eye}.{c}": image * (eye == "right") for eye in ("left", "right") for c in "RGB"},))
    for frame in (-2, -1, 0, 1, 2, 10):
        written(f"a.{frame:03d}.exr", stack, *((4, 2, 30, 20) if frame == 1 else ()))
        write_pfm(Path(f"b.{frame}.pfm"), noisy * 2, True)
    cropped, left_taken = "30x20 at (4, 2)", "eyes.exr: of the views left, right, left is taken"
    for words, status, said in (
        (
            "denoise eyes.exr -m primal -o eye.pfm",
            1,
            "has several views, and eye.pfm is of one; choose one, as in --view left",
        ),
        ("denoise eyes.exr -m primal -o eye.pfm --view right", 0, "eye.pfm: primal"),
        ("denoise a.%03d.exr -m primal -o new/c.$F3.exr", 0, "new/c.-02.exr"),
        ("report new/c.%03d.exr b.%d.pfm", 0, "1 of 6 frames: compared are the pixels that all images have"),
        (
            "denoise a.001.exr --ref b.1.pfm -m primal",
            0,
            f"relMSE trimmed 0.24975 of the pixels that both have: {cropped}",
        ),
        ("diff a.001.exr b.1.pfm", 1, f"compared are the pixels that all images have: {cropped}"),
        ("picture new/c.%03d.exr -o film/", 0, "without 3 to 9"),
        ("report eyes.exr -o eyes.html", 0, left_taken),
        ("picture eyes.exr -o eye.png --view right", 0, "6x4"),
    ):
        assert main(words.split()) == status, words
        told = capfd.readouterr().err
        assert told.count(said) == 1 and told.count(left_taken) == (said == left_taken)
    assert read_picture("eye.pfm").pixels.all() and pixels("eye.png").all()
    assert [path.name for path in shot_files("new/c.%03d.exr")][:3] == ["c.-02.exr", "c.-01.exr", "c.000.exr"]
    assert len(list(Path("film").iterdir())) == 6


def test_a_display_window_out_of_all_proportion_fills_no_memory(stack, tmp_path, capfd):
    (tmp_path / "shot").mkdir()
    written(tmp_path / "shot" / "a.exr", stack, display=Window(0, 0, 2**29, 2**29))
    for command in (["picture", "-o", str(tmp_path / "f.webp")], ["report", "-o", str(tmp_path / "page.html")]):
        assert main([*command, str(tmp_path / "shot")]) == 1
        assert "536870912x536870912 pixels is to be filled" in capfd.readouterr().err
    assert main(["picture", str(tmp_path / "shot" / "a.exr"), "-o", str(tmp_path / "a.png")]) == 0
