"""The contact sheet in blind order: what it draws, what it counts, and what the key says."""

import json

import numpy as np
import pytest

from ngpt.errors import NgptError
from ngpt.io.exr import write

sheet = pytest.importorskip("bench.sheet", reason="needs Pillow")


@pytest.fixture
def evaluation(tmp_path):
    """Results of two scenes at two sample counts: method "good" is the reference, "bad" twice as bright."""
    rng = np.random.default_rng(3)
    results = {"scenes": {}, "cells": []}
    for scene in ("one", "two"):
        reference = rng.uniform(0.1, 1, (20, 30, 3)).astype(np.float32)
        results["scenes"][scene] = {
            "size": [30, 20],
            "exposure": 0.0,
            # As ngpt/evaluation/run.py writes it; the sheet once looked for these a level higher.
            "reference": {"image": f"{scene}.exr", "images of halves": [f"{scene}.exr", f"{scene}.exr"]},
        }
        write(tmp_path / f"{scene}.exr", reference)
        for spp in (4, 16):
            for method, image in {"good": reference, "bad": 2 * reference}.items():
                name = f"{scene}-{spp}-{method}.exr"
                write(tmp_path / name, image)
                results["cells"].append({"scene": scene, "spp": spp, "method": method, "seed": 0, "image": name})
    (tmp_path / "results.json").write_text(json.dumps(results))
    return tmp_path


def run(monkeypatch, *arguments):
    monkeypatch.setattr("sys.argv", ["sheet", *(str(a) for a in arguments)])
    sheet.main()


def test_every_cell_is_drawn_as_often_and_the_order_is_of_each_row(evaluation, monkeypatch):
    run(monkeypatch, evaluation, "--methods", "good", "bad", "--rows", 12, "--size", 8, "-o", evaluation / "out")
    key = json.loads((evaluation / "out" / "key.json").read_text())
    cells = [(row["scene"], row["spp"]) for row in key]
    assert {cells.count(cell) for cell in cells} == {3}
    assert 0 < sum(row["order"][0] == "good" for row in key) < 12
    for row in key:
        assert 0 <= row["corner"][0] <= 22 and 0 <= row["corner"][1] <= 12
        assert row["errors"]["good"] == pytest.approx({"FLIP": 0, "relMSE trimmed": 0}, abs=1e-6)
        assert row["errors"]["bad"]["FLIP"] > 0.05 and row["errors"]["bad"]["relMSE trimmed"] > 0.5
    from PIL import Image

    with Image.open(evaluation / "out" / "sheet.png") as picture:
        assert picture.size[0] == 3 * sheet.TILE + 2 * 8 and picture.size[1] > 12 * sheet.TILE


def test_few_rows_are_of_any_scenes(evaluation):
    """Not of the first ones: eight rows of fourteen scenes once were bedroom and classroom alone."""
    results = json.loads((evaluation / "results.json").read_text())
    drawn = [sheet.draw(results, ["good", "bad"], 2, 8, seed) for seed in range(20)]
    assert {(row["scene"], row["spp"]) for rows in drawn for row in rows} == {
        (scene, spp) for scene in ("one", "two") for spp in (4, 16)
    }
    assert all(len({(row["scene"], row["spp"]) for row in rows}) == 2 for rows in drawn)


def test_answers_are_counted_by_the_key(evaluation, monkeypatch, capsys):
    out = evaluation / "out"
    run(monkeypatch, evaluation, "--methods", "good", "bad", "--rows", 6, "--size", 8, "-o", out)
    key = json.loads((out / "key.json").read_text())
    right = ["AB"[row["order"].index("good")] for row in key]
    capsys.readouterr()
    run(monkeypatch, evaluation, "--answers", "".join([*right[:5], "-"]), "-o", out)
    assert capsys.readouterr().out.split() == ["good", "5", "none", "1"]
    with pytest.raises(NgptError, match="2 answers to 6 rows"):
        sheet.count(key, "AB")
    with pytest.raises(NgptError, match="answer 6 is 'C'"):
        sheet.count(key, "ABABAC")


def test_what_no_scene_has(evaluation):
    with pytest.raises(NgptError, match="no scene has kept images of all of good, oidn"):
        sheet.draw(json.loads((evaluation / "results.json").read_text()), ["good", "oidn"], 4, 8, 0)
