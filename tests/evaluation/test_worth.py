"""W and C of results whose worth is known."""

import pytest

from bench.worth import worth_of_gradients, worth_tables

WORTH = 3.0


def results_of(**costs: tuple[float, float]) -> dict:
    """Results of one scene: errors 1/n, with gradients 1/(WORTH n); whole seconds of a method by (begin, a sample)."""
    results = {
        "settings": {"spp": [4, 16, 256], "groups": {"rooms": ["room"]}},
        "methods": {m: {"stack": "gradients" if "ours" in m else "features", "sampler": "any"} for m in costs},
        "scenes": {"room": {}},
        "cells": [],
        "summary": [],
    }
    for method, (begins, sample) in costs.items():
        for n in (4, 16, 64, 256):
            place = {"scene": "room", "method": method, "spp": n}
            seconds = {"render": n * sample, "reconstruct": begins, "total": begins + n * sample}
            results["cells"].append(place | {"spp used": n, "seconds": seconds, "absent": None})
            error = 1 / n / (WORTH if "ours" in method else 1)
            results["summary"].append(place | {"error": error, "seconds": seconds})
    return results


def rows_of(**costs: tuple[float, float]) -> dict:
    return {(row["method"], row["spp"]): row for row in worth_of_gradients(results_of(**costs))["rows"]}


@pytest.mark.parametrize(("begins", "ratio"), [(0, 1), (48.0, 0.5)])
def test_the_whole_time_makes_the_difference(begins, ratio):
    """W/C is the seconds without over those with, both whole; C that of further samples, whatever a method takes."""
    rows = rows_of(ours=(begins, 3.0), theirs=(0, 1.0))
    assert (rows["ours", 16]["W"], rows["ours", 16]["C"], rows["ours", 16]["W/C"]) == pytest.approx((3, 3, ratio))
    assert rows["ours", 4]["W/C"] == pytest.approx(12 / (begins + 12)) and rows["ours", 4]["seconds"] == begins + 12
    # Of two rivals the one that is done first counts: the quick samples of the other wait for a slow method.
    row = rows_of(ours=(0, 3.0), slow_begin=(100.0, 0.5), slow_samples=(0.0, 1.0))["ours", 4]
    assert row["rival"] == "slow_samples" and row["rival seconds"] == pytest.approx(12)


def test_tables_have_means_and_marks():
    means, scenes = worth_tables(results_of(ours=(0, 1.0), theirs=(0, 1.0))).values()
    assert scenes[2][:5] == ["room", "16", "ours", "theirs", "3.00"]
    # Three times 256 samples were not measured.
    assert means[3][:4] == ["rooms (1)", "256", "~3.00", "1.00"]
