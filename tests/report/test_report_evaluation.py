"""From the results folder of an evaluation to its page."""

import json
import re

import numpy as np
import pytest

from ngpt.errors import NgptError
from ngpt.io.exr import write
from ngpt.report.evaluation import write_evaluation_report
from ngpt.stack import GradientStack


def results_folder(folder):
    """Two methods and an absent one, two sample counts, two seeds."""
    (folder / "images").mkdir()
    rng = np.random.default_rng(0)
    cells, summary = [], []
    for name in ("reference", "4-primal", "16-primal", "4-l1", "16-l1"):
        write(folder / f"images/{name}.exr", GradientStack({"primal": rng.random((6, 8, 3), dtype=np.float32)}))
    for spp in (4, 16):
        for method in ("primal", "l1", "oidn"):
            for seed in (0, 1):
                cell = {"scene": "room", "spp": spp, "method": method, "seed": seed, "absent": None}
                image = None if seed else f"images/{spp}-{method}.exr"
                cell |= {"image": image, "metrics": {"PSNR": 30.0, "relMSE": (seed + 1) / spp}}
                if method == "oidn":
                    cell |= {"image": None, "metrics": {}, "absent": "not <installed>"}
                cells.append(cell)
        value = {"median": 1.5 / spp, "low": 1 / spp, "high": 2 / spp}
        row = {"spp": spp, "method": "l1", "metrics": {"relMSE": value}, "seconds": {"total": 2.5}, "pareto": spp == 4}
        summary += [row | {"scene": "room"}, row | {"scene": None, "pareto": False}]
    metrics = {"PSNR": {"formula": "of what", "better": "higher"}, "relMSE": {"formula": "mean", "better": "lower"}}
    reference = {"image": "images/reference.exr", "spp": 99, "doubt": 0.2}
    results = {"format": 2, "title": "Evaluation", "command": "eval.py", "date": "today", "primary": "relMSE"}
    results |= {"metadata": {"versions": {"ngpt": "0.1"}, "cpu": "a cpu"}, "metrics": metrics, "cells": cells}
    results |= {
        "methods": {name: {"absent": None, "render": "path", "stack": "path"} for name in ("primal", "l1", "oidn")},
        "summary": summary,
    }
    results |= {"scenes": {"room": {"size": [8, 6], "reference": reference, "absent": None}}}
    (folder / "results.json").write_text(json.dumps(results))
    return results


def test_the_page_shows_every_number_and_says_what_is_absent(tmp_path):
    results_folder(tmp_path)
    text = write_evaluation_report(tmp_path, tmp_path / "report.html").read_text()
    assert re.findall(r"<h2>([^<]*)", text) == ["room, 4 spp", "room, 16 spp"]
    # What the reference can tell is 0.2: the errors at 16 spp are less.
    assert text.count("0.09375 ~ (") == 1 and text.count("0.375 ~ (") == 0
    assert text.count("0.375 (0.25 to 0.5), 2.5 s ●") == 1 and text.count("0.375 (0.25 to 0.5), 2.5 s<") == 1
    assert "<small>relMSE 0.375</small>" in text and '<small class="spread">0.25 &hellip; 0.5</small>' in text
    assert text.count("without oidn (not &lt;installed&gt;)") == 2
    assert "<dt>relMSE</dt><dd>mean (lower is better)</dd>" in text


def test_what_is_not_a_result_is_refused(tmp_path):
    with pytest.raises(NgptError, match=r"results.json: cannot be read"):
        write_evaluation_report(tmp_path, tmp_path / "report.html")
    results = results_folder(tmp_path)
    (tmp_path / "results.json").write_text(json.dumps(results | {"format": 1}))
    with pytest.raises(NgptError, match="format 2"):
        write_evaluation_report(tmp_path, tmp_path / "report.html")
    (tmp_path / "results.json").write_text(json.dumps(results | {"cells": []}))
    with pytest.raises(NgptError, match="no cell has a picture"):
        write_evaluation_report(tmp_path, tmp_path / "report.html")
    assert not (tmp_path / "report.html").exists()
