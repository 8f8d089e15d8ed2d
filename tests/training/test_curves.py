"""Pictures of learning curves."""

import json
from xml.etree import ElementTree

import pytest

from bench.curves import draw, read_curve
from ngpt.errors import NgptError


def test_curves_are_drawn_from_logs(tmp_path):
    lines = [{"step": 50, "loss": 1.0}]
    lines += [{"step": s, "relMSE": 10 / s, "relMSE primal": 1.0, "relMSE base": 0.1} for s in (100, 200, 400)]
    (tmp_path / "log.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    curve = read_curve(tmp_path)
    assert curve == ([(100, 0.1), (200, 0.05), (400, 0.025)], 0.1)
    svg = ElementTree.fromstring(draw({"a run": curve}))
    texts = [element.text for element in svg.iter("{http://www.w3.org/2000/svg}text")]
    assert {"a run", "its base", "0.05", "200"} <= set(texts)
    solid = next(p for p in svg.iter("{http://www.w3.org/2000/svg}path") if p.get("stroke-width") == "2")
    points = [tuple(map(float, point.split())) for point in solid.get("d")[1:].split("L")]
    # Halving twice over doubling twice: a straight line downwards on these axes.
    assert points[1][0] - points[0][0] == pytest.approx(points[2][0] - points[1][0], abs=0.2)
    assert (
        points[1][1] - points[0][1] == pytest.approx(points[2][1] - points[1][1], abs=0.2)
        and points[1][1] > points[0][1]
    )


def test_runs_without_validation_are_explained(tmp_path):
    with pytest.raises(NgptError, match="no such file"):
        read_curve(tmp_path)
    (tmp_path / "log.jsonl").write_text('{"step": 1}\n')
    with pytest.raises(NgptError, match=r"data\.validation"):
        read_curve(tmp_path)
