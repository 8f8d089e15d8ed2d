"""Pictures of curves."""

from xml.etree import ElementTree

import pytest

from bench.curves import draw


def test_a_power_law_is_a_straight_line():
    svg = ElementTree.fromstring(draw({"a method": [(100, 0.1), (200, 0.05), (400, 0.025)]}, "samples", "error"))
    texts = [element.text for element in svg.iter("{http://www.w3.org/2000/svg}text")]
    assert {"a method", "samples", "error", "0.05", "200"} <= set(texts)
    line = next(p for p in svg.iter("{http://www.w3.org/2000/svg}path") if p.get("stroke-width") == "2")
    points = [tuple(map(float, point.split())) for point in line.get("d")[1:].split("L")]
    # Halving twice over doubling twice: a straight line downwards on these axes.
    assert points[1][0] - points[0][0] == pytest.approx(points[2][0] - points[1][0], abs=0.2)
    assert points[1][1] - points[0][1] == pytest.approx(points[2][1] - points[1][1], abs=0.2)
    assert points[1][1] > points[0][1]
