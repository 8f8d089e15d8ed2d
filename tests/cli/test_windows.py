"""Files whose pixels are a part of a picture, or reach beyond it: they are compared and shown where they lie."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from shots import SIZE, frame_of, part_of, view

import ngpt
from ngpt.io.exr import read_picture
from ngpt.stack import GradientStack
from ngpt.windows import Place, Window

HEIGHT, WIDTH = SIZE
WHOLE = Window(0, 0, WIDTH, HEIGHT)


@pytest.fixture
def stack(rng):
    return frame_of(*view(), rng, **{"ngpt:spp": 4, "ngpt:seed": "1", "ngpt:sampler": "gpt"})


@pytest.fixture
def write(tmp_path, stack):
    """Writes a part of the stack, or of another."""

    def written(name, *window, of=stack):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        ngpt.write(tmp_path / name, part_of(of, *window) if window else of)

    return written


def test_a_place_survives_files_and_results(write, tmp_path, command):
    write("part.exr", 16, 8, 24, 20)
    part = ngpt.read(tmp_path / "part.exr")
    assert part.place == Place(Window(16, 8, 24, 20), WHOLE) == read_picture(tmp_path / "part.exr").place
    for other in (part.replace(alpha=np.ones((20, 24))), part):
        assert ngpt.read(ngpt.write(tmp_path / "again.exr", other, overwrite=True)).place == part.place
    command("denoise part.exr -o result.exr -m primal")
    assert ngpt.read("result.exr").place == part.place
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
def test_diff_compares_where_both_have_pixels(one, other, common, write, command):
    write("a.exr", *one)
    write("b.exr", *other)
    output, errors = command("diff a.exr b.exr --json")
    assert json.loads(output)["metrics"]["max |x - r|"] == 0
    assert errors.strip() == (f"compared are the pixels that all images have: {common}" if common else "")


def test_a_file_that_lost_its_place_lies_where_one_of_its_size_does(write, tmp_path, command):
    """As programs write it that know no windows: Mitsuba's crops, PNG."""
    write("part.exr", 16, 8, 24, 20)
    write("lost.exr", of=GradientStack({"primal": ngpt.read_image(tmp_path / "part.exr")}))
    assert not command("diff part.exr lost.exr").err and not command("diff lost.exr part.exr").err


def test_errors_of_results_are_those_of_the_place(write, stack, command):
    clean = frame_of(*view(), np.random.default_rng(0), sigma=0)
    write("ref.exr", 10, 4, 40, 30, of=clean)
    for x in (12, 0):
        write(f"{x}.exr", x, 8, 24, 20)
    output, errors = command("denoise 12.exr 0.exr -o out/ -m primal --ref ref.exr --json")
    for report, window in zip(json.loads(output)["files"], (Window(12, 8, 24, 20), Window(10, 8, 14, 20)), strict=True):
        there = window.within(WHOLE)
        expected = np.mean(np.square(stack["primal"][there] - clean["primal"][there]))
        assert report["metrics"]["MSE"] == pytest.approx(expected, rel=1e-5)
        assert report["compared"] == str(window) and f"of the pixels that both have: {window}" in errors


def test_a_report_of_a_shot_shows_display_windows(write, tmp_path, command):
    """The subject rests and is cut in another way in each frame: nothing changes, and nothing is wrong."""
    for i in range(3):
        write(f"shot/f.{i}.exr", 3 * i, i, 30 + i, 30)
        write(f"refs/f.{i}.exr")
    output, errors = command("report shot --ref refs -o page.html")
    assert "3 of 3 frames: only the pixels that all images have are compared" in errors
    assert re.search(r"shot +0 +0 ", output) and output.split()[-1] == "0"
    assert f"{WIDTH}x{HEIGHT}" in (tmp_path / "page.html").read_text()


def test_films_show_display_windows(write, command):
    image = pytest.importorskip("PIL.Image")
    for i, window in enumerate([(0, 0, WIDTH, HEIGHT), (4, 2, 30, 20), (20, 10, 36, 30)]):
        write(f"shot/f.{i}.exr", *window)
    command("picture shot -o frames")
    frames = [np.asarray(image.open(path)) for path in sorted(Path("frames").iterdir())]
    assert all(frame.shape == (HEIGHT, WIDTH, 3) for frame in frames) and len(frames) == 3
    there = Window(4, 2, 30, 20).within(WHOLE)
    assert np.array_equal(frames[1][there], frames[0][there]) and not frames[1][:2].any()


def test_a_display_window_out_of_all_proportion_fills_no_memory(write, stack, command):
    huge = Place(stack.place.data, Window(0, 0, 2**29, 2**29))
    write("shot/a.exr", of=GradientStack(stack.layers, place=huge))
    for line in ("picture shot -o f.webp", "report shot -o page.html"):
        assert "display window is 536870912x536870912" in command(line, 1).err
    command("picture shot/a.exr -o a.png")
