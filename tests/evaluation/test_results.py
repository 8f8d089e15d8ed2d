"""Means, quartiles and the Pareto set of cells whose order is known."""

import pytest

from bench.common import measure
from bench.frontier import Point, pareto
from ngpt.evaluation.results import as_csv, summarised
from ngpt.measure.averages import geometric_mean

CLOCKS = ("render", "reconstruct", "total", "reconstruct wall")


def make_results(errors: dict[str, list[float]]) -> dict:
    """Two scenes, one spp, with these errors by method, one for each seed; the second scene's are a hundred times."""
    results = {
        "primary": "relMSE",
        "metrics": {"relMSE": {"better": "lower"}, "PSNR": {"better": "higher"}},
        "settings": {"spp": [16], "seeds": 3},
        "methods": {m: {} for m in errors},
        "scenes": {"a": {}, "b": {}},
        "cells": [],
    }
    for scene, factor in (("a", 1), ("b", 100)):
        for method, values in errors.items():
            for seed, value in enumerate(values):
                cell = {"scene": scene, "spp": 16, "method": method, "seed": seed, "spp used": 20, "absent": None}
                cell["seconds"] = dict(zip(CLOCKS, (2.0, seed + 1.0, seed + 3.0, 0.5), strict=True))
                cell["metrics"] = {"relMSE": value * factor, "PSNR": 10.0 * factor}
                results["cells"].append(cell)
    results["summary"] = summarised(results)
    return results


def test_medians_and_means():
    results = make_results({"l1": [0.01, 0.02, 0.09], "oidn": [0.03, 0.03, 0.03]})
    rows = {(row["scene"], row["method"]): row for row in results["summary"]}
    assert rows["a", "l1"]["error"] == 0.02 and rows["a", "l1"]["seeds"] == 3
    assert rows["a", "l1"]["metrics"]["relMSE"] == pytest.approx({"median": 0.02, "low": 0.015, "high": 0.055})
    assert rows["a", "l1"]["seconds"] == dict(zip(CLOCKS, (2.0, 2.0, 4.0, 0.5), strict=True))
    # Geometric for errors, arithmetic for decibels.
    assert rows[None, "l1"]["error"] == pytest.approx(0.2)
    assert rows[None, "l1"]["metrics"]["PSNR"]["median"] == pytest.approx(505)
    assert rows["a", "l1"]["pareto"] and not rows["a", "oidn"]["pareto"]


def test_csv_has_a_line_for_each_cell():
    head, line, *others = as_csv(make_results({"l1": [0.01, 0.02]})).splitlines()
    assert head == "scene,spp,method,seed,spp used,render s,reconstruct s,total s,reconstruct wall s,relMSE,PSNR,absent"
    assert line == "a,16,l1,0,20,2.0,1.0,3.0,0.5,0.01,10.0," and len(others) == 3


def test_the_pareto_set():
    points = [Point("a", 4, 1, 3), Point("a", 8, 2, 2), Point("b", 4, 2, 2.5), Point("b", 8, 3, 1), Point("c", 4, 3, 3)]
    assert pareto(points) == [True, True, False, True, False]


def test_benchmarks_have_the_same_averages():
    """An error of 0 has no logarithm, and no quartile lies beyond what was measured."""
    assert geometric_mean(iter([1.0, 4.0])) == pytest.approx(2) and geometric_mean([0.0, 1.0]) == pytest.approx(1e-15)
    clock = iter([0.0, 9.0, 10.0, 11.0, 13.0]).__next__
    assert measure({"a": lambda: None}, 2, clock) == {"a": {"median": 1.5, "low": 1.25, "high": 1.75}}


def test_a_mean_is_of_methods_that_are_on_all_scenes():
    results = make_results({"l1": [0.01], "oidn": [0.03]})
    results["cells"] = [c for c in results["cells"] if (c["scene"], c["method"]) != ("b", "oidn")]
    assert {row["method"] for row in summarised(results) if row["scene"] is None} == {"l1"}
