"""Files of frames: their order, what does not belong to them, and what is said of gaps and mixtures."""

import numpy as np
import pytest

from ngpt.errors import NgptError
from ngpt.io.exr import write
from ngpt.io.frames import in_order, input_files, natural, remarks, series, shot_files
from ngpt.stack import GradientStack


def files(folder, *names, frames=None):
    """Small images of these names; ``frames``: the attribute ``ngpt:frame`` of each."""
    folder.mkdir(exist_ok=True)
    for i, name in enumerate(names):
        write(folder / name, GradientStack({"primal": np.ones((2, 3, 3))}, {"ngpt:frame": frames[i]} if frames else {}))
    return folder


def names(paths):
    return [path.name for path in paths]


@pytest.mark.parametrize(
    "ordered",
    [
        ["f.-10.exr", "f.-2.exr", "f.-1.exr", "f.0.exr", "f.1.exr"],
        ["f-1.exr", "f-2.exr", "f-10.exr"],  # a dash, no minus
        ["-3.exr", "-2.exr", "7.exr"],
        ["f_9.exr", "f_010.exr", "f_11.exr"],
        ["a.exr", "a1.exr", "a2.exr", "b.exr"],
        ["v2_f9.exr", "v2_f10.exr", "v10_f1.exr"],
    ],
)
def test_names_are_in_the_order_of_their_numbers(tmp_path, ordered):
    assert sorted(sorted(ordered), key=natural) == ordered
    assert names(shot_files(str(files(tmp_path / "shot", *sorted(ordered))))) == ordered
    assert names(shot_files(str(tmp_path / "shot/*.exr"))) == ordered


def test_frames_that_the_files_name_win_over_names(tmp_path):
    folder = files(tmp_path / "shot", "a.exr", "b.exr", "c.exr", frames=[7, -3, 2])
    assert names(shot_files(str(folder))) == ["b.exr", "c.exr", "a.exr"]
    # Two shots of the same frames stay apart.
    files(folder, "x1.exr", "x2.exr", "y1.exr", "y2.exr", frames=[2, 1, 2, 1])
    paths = [path for path in folder.iterdir() if path.name[0] in "xy"]
    assert names(in_order(paths)) == ["x2.exr", "x1.exr", "y2.exr", "y1.exr"]
    # A file without a frame, or a damaged one: the names count.
    (folder / "x1.exr").write_bytes(b"not an image")
    assert names(in_order(paths)) == ["x1.exr", "x2.exr", "y2.exr", "y1.exr"]


def test_the_last_number_that_differs_counts_the_frames(tmp_path):
    found = series(tmp_path / name for name in ("t2.f1.v3.exr", "t1.f10.v3.exr", "t1.f9.v3.exr", "t2.f2.v3.exr"))
    assert [(one.name, names(one.files), one.numbers) for one in found] == [
        ("t1.f#.v3.exr", ["t1.f9.v3.exr", "t1.f10.v3.exr"], [9, 10]),
        ("t2.f#.v3.exr", ["t2.f1.v3.exr", "t2.f2.v3.exr"], [1, 2]),
    ]


def test_results_and_hidden_files_are_no_frames(tmp_path):
    folder = files(tmp_path / "shot", "f.1.exr", "f.2.exr", "f.10.exr", "f.1_denoised.exr", "f.10_denoised.exr")
    for hidden in ("._f.1.exr", ".f.3.exr"):
        (folder / hidden).write_bytes(b"of macOS")
    expected = ["f.1.exr", "f.2.exr", "f.10.exr"]
    for name in (str(folder), f"{folder}/*.exr", f"{folder}/*"):
        assert names(shot_files(name)) == expected and names(input_files(name)) == expected
    said = remarks(str(folder), shot_files(str(folder)))
    assert said[0] == f"{folder}: 2 results beside their inputs are left out; '{folder}/*_denoised.exr' names them"
    # What is asked for by name is shown, and never denoised again.
    assert names(shot_files(f"{folder}/*_denoised.exr")) == ["f.1_denoised.exr", "f.10_denoised.exr"]
    with pytest.raises(NgptError, match=r"no \.exr files to denoise there"):
        input_files(f"{folder}/*_denoised.exr")
    with pytest.raises(NgptError, match=r"no \.exr files there"):
        shot_files(str(tmp_path / "shot/*.png"))


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (["f.0.exr", "f.2.exr", "f.4.exr"], []),
        (["a.exr", "b.exr"], []),
        (["f.1.exr", "f.2.exr", "f.9.exr", "f.11.exr"], ["f.#.exr goes from 1 to 11 without 3 to 8, 10"]),
        (
            ["f.1.exr", "f.2.exr", "f.999999999999.exr"],
            ["f.#.exr goes from 1 to 999999999999 without 3 to 999999999998"],
        ),
        (["a.1.exr", "a.2.exr", "b.1.exr"], ["2 series of frames, one after the other: a.#.exr (2), b.1.exr (1)"]),
    ],
)
def test_gaps_and_mixed_series_are_said(tmp_path, given, expected):
    folder = str(files(tmp_path / "shot", *given))
    assert remarks(folder, shot_files(folder)) == [f"{folder}: {line}" for line in expected]
