"""W and C: curves and stacks whose worth is known."""

import numpy as np
import pytest
from folders import evaluated, read, smooth_image, write_halves

import ngpt
from bench.worth import _means, worth_of_gradients, worth_tables
from ngpt.stack import GradientStack

WORTH = 3.0
CONFIG = """
scenes = ["{folder}"]
spp = [4, 16, 64]
seeds = 2
methods = ["ours", "ours-worse", "primal", "theirs-worse"]
metrics = ["relMSE"]
primary = "relMSE"

[groups]
rooms = ["room"]

[variants.ours]
method = "primal"
stack = "gradients"
sampler = "gpt"

[variants.ours-worse]
method = "primal"
stack = "gradients"
sampler = "slow"

[variants.theirs-worse]
method = "primal"
stack = "features"
"""


def write_room(folder, rng):
    """Noise in all pixels: with gradients of a third of the variance of that without, for the same samples."""
    folder.mkdir()
    clean = smooth_image()
    for n in (4, 16, 64):
        for seed in range(2):
            for kind, variance in (
                ("gradients-gpt", 0.25 / n / WORTH),
                ("gradients-slow", 0.5 / n / WORTH),
                ("features", 1.0 / n),
                ("path", 0.25 / n),
            ):
                noisy = clean + rng.normal(0, variance**0.5, clean.shape)
                layers = {"primal": noisy, "primal_var": np.full_like(clean, variance)}
                if kind.startswith("gradients"):
                    layers |= {name: np.zeros_like(clean) for name in ("dx", "dy")}
                    layers |= {name: np.ones_like(clean) for name in ("dx_var", "dy_var")}
                stack = GradientStack.from_arrays(attributes={"ngpt:seconds": 0.1 * n, "ngpt:spp": n}, **layers)
                ngpt.write(folder / f"{kind}-{n}-{seed}.exr", stack)
    write_halves(folder, rng, 0.05)


def test_stacks_of_known_worth(tmp_path, rng):
    write_room(tmp_path / "room", rng)
    results = evaluated(read(CONFIG.format(folder=tmp_path / "room"), tmp_path), tmp_path / "out")
    worth = worth_of_gradients(results)
    best = [row for row in worth["rows"] if row["best"]]
    assert [(row["spp"], row["method"], row["rival"]) for row in best] == [(n, "ours", "primal") for n in (4, 16, 64)]
    assert [row["W"] for row in best] == pytest.approx([WORTH] * 3, rel=0.15)
    assert [row["mark"] for row in best] == ["", "", "~"]  # three times 64 samples were not measured
    worse = [row["W"] for row in worth["rows"] if row["method"] == "ours-worse"]
    assert worse == pytest.approx([WORTH / 2] * 3, rel=0.15)
    # Samples take the same time with gradients, and copying an image takes none: worth over cost is the worth.
    assert all(row["C"] == pytest.approx(1) for row in worth["rows"])
    assert all(row["W/C"] == pytest.approx(row["W"], rel=0.05) for row in best)
    means, scenes = worth_tables(results).values()
    assert ["room", "16", "ours", "primal", f"{best[1]['W']:.2f}"] == scenes[2][:5]
    assert ["rooms (1)", "64", f"~{best[2]['W']:.2f}", "1.00"] == means[3][:4]


def rows_of(**costs: tuple[float, float]) -> dict:
    """Rows of one scene: errors 1/n, with gradients 1/(WORTH n); whole seconds of a method by (begin, a sample)."""
    results = {
        "settings": {"spp": [4, 16], "groups": {}},
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
    return {(row["method"], row["spp"]): row for row in worth_of_gradients(results)["rows"]}


@pytest.mark.parametrize(("begins", "ratio"), [(0, 1), (48.0, 0.5)])
def test_the_whole_time_makes_the_difference(begins, ratio):
    """W/C is the seconds without over those with, both whole; C that of further samples, whatever a method takes."""
    rows = rows_of(ours=(begins, 3.0), theirs=(0, 1.0))
    assert (rows["ours", 16]["W"], rows["ours", 16]["C"], rows["ours", 16]["W/C"]) == pytest.approx((3, 3, ratio))
    assert rows["ours", 4]["W/C"] == pytest.approx(12 / (begins + 12)) and rows["ours", 4]["seconds"] == begins + 12
    # Of two rivals the one that is done first counts: the quick samples of the other wait for a slow method.
    row = rows_of(ours=(0, 3.0), slow_begin=(100.0, 0.5), slow_samples=(0.0, 1.0))["ours", 4]
    assert row["rival"] == "slow_samples" and row["rival seconds"] == pytest.approx(12)


def test_means_over_scenes_are_geometric_and_carry_marks():
    results = {"settings": {"spp": [4], "groups": {"rooms": ["b", "c"]}}, "methods": {"ours": {}}}
    row = {"spp": 4, "method": "ours", "sampler": "gpt", "best": True, "error": 1.0, "rival": "primal", "C": 2.0}
    rows = [row | {"scene": s, "W": w, "W/C": w / 2, "mark": m} for s, w, m in (("a", 1.0, ""), ("b", 4.0, ">"))]
    one, best = [mean for mean in _means(results, rows) if mean["method"] is None]
    assert (one["group"], one["scenes"], one["W"]) == ("rooms", 1, pytest.approx(4.0))
    assert (best["group"], best["scenes"], best["mark"]) == ("all", 2, ">")
    assert (best["W"], best["C"], best["W/C"]) == pytest.approx((2.0, 2.0, 1.0))
