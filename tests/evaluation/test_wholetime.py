"""Errors over rivals' at equal whole time: curves and envelopes of hand-made numbers, and folders of stacks."""

import xml.etree.ElementTree as ElementTree

import pytest
from folders import evaluated, read, write_scene

from bench import evaluated as tables
from bench.wholetime import against_rivals
from ngpt.evaluation import cells


def made(rows: dict[str, list[tuple[float, float, float]]], scenes=("a",), **settings) -> dict:
    """Results of scenes that are alike, by column: (seconds, error, FLIP) at 4, 16, 64 spp."""
    results = {
        "primary": "relMSE",
        "settings": {"spp": [4, 16], "groups": {}, "against": {"oidn": ["oidn", "oidn-fast"]}} | settings,
        "methods": {name: {} for name in rows},
        "scenes": {name: {} for name in scenes},
        "summary": [],
    }
    for scene in scenes:
        for method, values in rows.items():
            for spp, (seconds, error, flip) in zip((4, 16, 64), values, strict=False):
                metrics = {"relMSE": {"median": error}, "FLIP": {"median": flip}}
                place = {"scene": scene, "spp": spp, "method": method, "error": error, "metrics": metrics}
                results["summary"].append(place | {"seconds": {"total": seconds}})
    return results


RIVALS = {
    # Errors 8 / seconds after a slow start, and 16 / seconds: the quick setting is ahead until 16 seconds.
    "oidn": [(16, 0.5, 0.2), (32, 0.25, 0.1), (64, 0.125, 0.05)],
    "oidn-fast": [(2, 2.0, 0.8), (8, 1.0, 0.4), (32, 0.5, 0.2)],
}


def test_a_rival_has_the_least_error_of_its_settings_at_our_time():
    results = made({"ours": [(4, 0.7, 0.9), (24, 0.25, 0.1)], **RIVALS})
    early, late = against_rivals(results)["rows"]
    assert (early["spp"], early["seconds"], early["setting"], early["mark"]) == (4, 4, "oidn-fast", "")
    assert early["error"] == pytest.approx(0.7 / 2**0.5) and early["FLIP"] == pytest.approx(0.9 / (0.8 / 2**0.5))
    assert (late["setting"], late["mark"]) == ("oidn", "")
    assert late["error"] == pytest.approx(0.25 / (8 / 24)) and late["FLIP"] == pytest.approx(0.1 / (0.2 * 16 / 24))
    # Before its first cell a setting does not count where another was measured: 8/12 would be less.
    (between,) = against_rivals(made({"ours": [(12, 0.7, 0.9)], **RIVALS}))["rows"]
    assert between["setting"] == "oidn-fast" and between["error"] == pytest.approx(0.7 / (2 / 6**0.5))
    # The rival's own settings are not held against it.
    assert {row["method"] for row in against_rivals(results)["rows"]} == {"ours"}


def test_means_and_counts_are_of_what_was_measured():
    results = made({"ours": [(4, 0.7, 0.9), (24, 0.25, 0.1)], **RIVALS}, ("a", "b", "c"), groups={"first": ["a", "z"]})
    for row in results["summary"]:
        if row["method"] == "ours" and row["scene"] == "b":
            row["error"] = 4 * row["error"]
        if row["method"] == "ours" and row["scene"] == "c":
            # What is not there, has no time or no positive error makes no cell; FLIP may be missing alone.
            row["metrics"].pop("FLIP")
            row["error"] = -0.1 if row["spp"] == 16 else row["error"]
    found = {(m["group"], m["spp"]): m for m in against_rivals(results)["means"]}
    assert list(found) == [("first", 4), ("first", 16), ("all", 4), ("all", 16)]
    assert (found["first", 16]["scenes"], found["first", 16]["less"]) == (1, 1)
    every = found["all", 4]
    assert (every["scenes"], every["less"], every["scenes FLIP"], every["less FLIP"]) == (3, 2, 2, 0)
    assert every["error"] == pytest.approx(0.7 / 2**0.5 * 4 ** (1 / 3))
    assert found["all", 16]["scenes"] == 2


CONFIG = """
scenes = ["{folder}"]
spp = [4, 16]
rival_spp = [4, 16, 64]
seeds = 1
methods = ["l2", "nfor", "primal", "raw"]
metrics = ["relMSE", "relMSE trimmed"]

[against]
path = ["primal", "raw"]

[groups]
rooms = ["room"]

[variants.raw]
method = "primal"
stack = "features"
"""


def test_an_evaluation_holds_its_methods_against_rivals(tmp_path, rng, capsys, monkeypatch):
    """Rivals have counts of their own; tables and plots say what they are at equal whole time.

    The clock counts the processor seconds of all threads.
    """
    write_scene(tmp_path / "room", rng, spp=(4, 16, 64), seeds=1)
    ticks = iter(range(100))
    monkeypatch.setattr(cells.time, "process_time", lambda: 3.0 * next(ticks))
    config = read('time = "processor"' + CONFIG.format(folder=tmp_path / "room"), tmp_path)
    results = evaluated(config, tmp_path / "out")
    measured = {(cell["method"], cell["spp"]) for cell in results["cells"]}
    assert ("primal", 64) in measured and ("l2", 64) not in measured and ("nfor", 64) not in measured
    rows = {(row["method"], row["spp"]): row for row in against_rivals(results)["rows"]}
    assert set(rows) == {(method, spp) for method in ("l2", "nfor") for spp in (4, 16)}
    cell = next(c for c in results["cells"] if (c["method"], c["spp"]) == ("l2", 16))
    row = rows["l2", 16]
    assert cell["seconds"]["reconstruct"] == 3 != cell["seconds"]["reconstruct wall"]
    assert cell["seconds"]["total"] == row["seconds"] == pytest.approx(1.6 + 3) and not row["mark"]
    assert row["error"] < 0.5
    tables.main(tmp_path / "out")
    page = capsys.readouterr().out
    assert "| rooms (1) | 16 | l2 | 4.6" in page and "at equal whole time, scene by scene:" in page
    plot = ElementTree.parse(tmp_path / "out" / "frontier-rooms.svg")
    texts = [element.text for element in plot.iter("{http://www.w3.org/2000/svg}text")]
    assert {"path", "l2", "nfor"} <= set(texts) and "raw" not in texts
