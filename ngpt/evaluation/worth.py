"""What gradients are worth: W, what they cost: C, and where they pay: W / C > 1.

    n, e    samples of a pipeline with gradients (a sampler and a method), and its error
    m       the samples at which a pipeline without gradients first has the error e
    c       seconds per sample of the one over those of the other, measured in turn on the same scene
    W       m / n, by how many times more samples the best pipeline without gradients needs for the same error
    C       c, with features on both sides
    W / C   the time of the pipeline without gradients over that with them, reconstruction left out

m is read off the error over the samples of the pipeline without gradients: its running minimum, straight between the
measured points in log-log. Outside of them the nearest slope goes on, for a factor of 4 at most (``REACH``): such an m
is marked "~", and where it stops at that factor ">" or "<". The best pipeline without gradients is the one that needs
the least time, of all that the evaluation has.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

from ngpt.evaluation.averages import mean
from ngpt.evaluation.renders import KINDS

REACH = 4.0  # how far a slope is trusted past the measured samples
FIELDS = (
    *("scene", "spp", "method", "sampler", "best", "error", "rival", "rival samples"),
    *("W", "C", "W/C", "mark", "blocks"),
)


def samples_for(error: float, points: Sequence[tuple[float, float]]) -> tuple[float, str] | None:
    """The samples at which a curve of (samples, error) comes down to ``error``, and "", "~", ">" or "<" (see above).

    None where there are fewer than two points, or the error never falls. Errors must be positive.
    """
    curve: list[tuple[float, float]] = []
    for m, e in sorted(points):
        curve.append((math.log(m), min(math.log(e), curve[-1][1] if curve else math.inf)))
    falls = [(a, b) for a, b in pairwise(curve) if b[1] < a[1] and b[0] > a[0]]
    if not falls:
        return None
    target, reach = math.log(error), math.log(REACH)
    (first, _), (_, last) = curve[0], curve[-1]
    if target > curve[0][1]:
        m = first + _slope(falls[0]) * (target - curve[0][1])
        return (math.exp(m), "~") if m >= first - reach else (math.exp(first - reach), "<")
    if target < last:
        m = curve[-1][0] + _slope(falls[-1]) * (target - last)
        limit = curve[-1][0] + reach
        return (math.exp(m), "~") if m <= limit else (math.exp(limit), ">")
    if target == curve[0][1]:
        return math.exp(first), ""
    a, b = next((a, b) for a, b in falls if b[1] <= target)
    return math.exp(a[0] + _slope((a, b)) * (target - a[1])), ""


def _slope(segment: tuple[tuple[float, float], tuple[float, float]]) -> float:
    """Samples over error, both logarithms."""
    (m0, e0), (m1, e1) = segment
    return (m1 - m0) / (e1 - e0)


def worth_of_gradients(results: dict[str, Any]) -> dict[str, Any]:
    """``rows`` for each scene, number of samples and column with gradients (``FIELDS``); ``means`` of them over scenes.

    ``best`` marks the column of least error among those with gradients. C and W/C are None where costs were not
    measured, as for folders of stacks. ``blocks``, the share of blocks where gradients pay, comes with the maps
    (``ngpt.evaluation.worthplots``). Both lists are empty where a column of either kind is missing.
    """
    rows = [row for scene in results["scenes"] for row in _scene_rows(results, scene)]
    return {"rows": rows, "means": _means(results, rows)}


def _scene_rows(results: dict[str, Any], scene: str) -> list[dict[str, Any]]:
    used = {(c["spp"], c["method"]): c["spp used"] for c in results["cells"] if c["scene"] == scene and not c["absent"]}
    found: dict[str, dict[int, float]] = {}
    for row in results["summary"]:
        if row["scene"] == scene and (row["error"] or 0) > 0:
            found.setdefault(row["method"], {})[row["spp"]] = row["error"]
    ours = [name for name in found if results["methods"][name]["stack"] == "gradients"]
    curves = {
        name: [(used[spp, name], error) for spp, error in errors.items()]
        for name, errors in found.items()
        if name not in ours
    }
    cost = results["scenes"][scene].get("cost") or {}
    seconds = {name: _seconds(cost, results["methods"][name]) for name in found}
    rows = []
    for spp in results["settings"]["spp"]:
        errors = {name: found[name][spp] for name in ours if spp in found[name]}
        for name, error in errors.items():
            if worth := _against(error, used[spp, name], seconds[name], curves, seconds):
                place = {"scene": scene, "spp": spp, "method": name, "sampler": results["methods"][name]["sampler"]}
                rows.append(place | {"best": error == min(errors.values()), "error": error} | worth)
    return rows


def _against(
    error: float, n: int, cost: float | None, curves: dict[str, list[tuple[float, float]]], costs: dict
) -> dict[str, Any] | None:
    """The rival that is the first to have that error, and W, C, W/C against it."""
    answers = []
    for name, points in curves.items():
        if answer := samples_for(error, points):
            m, mark = answer
            answers.append((m * (costs[name] or 1.0), m, mark, name))
    if not answers:
        return None
    _, m, mark, rival = min(answers)
    W, rival_cost = m / n, costs[rival]
    C = cost / rival_cost if cost and rival_cost else None
    return {"rival": rival, "rival samples": m, "W": W, "C": C, "W/C": W / C if C else None, "mark": mark}


def _seconds(cost: dict[str, Any], method: dict[str, Any]) -> float | None:
    """Of one sample, for what this column is given."""
    entry = cost.get(method["render"])
    if entry is None:
        # "auto" and the sampler it stands for on this scene are one.
        usual = cost.get(method["stack"])
        entry = usual if usual and usual["sampler"] in (method["sampler"], KINDS[method["stack"]]) else None
    return entry["median"] if entry else None


def _means(results: dict[str, Any], rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Geometric means over all scenes and over each group: of each column, and with method None of the best ones."""
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    groups = {"all": scenes} if len(scenes) > 1 else {}
    groups |= {name: [s for s in scenes if s in listed] for name, listed in results["settings"]["groups"].items()}
    means = []
    for group, members in groups.items():
        for spp in results["settings"]["spp"]:
            for method in (None, *results["methods"]):
                here = [row for row in rows if row["scene"] in members and row["spp"] == spp]
                here = [row for row in here if (row["best"] if method is None else row["method"] == method)]
                if not here:
                    continue
                entry: dict[str, Any] = {"group": group, "spp": spp, "method": method, "scenes": len(here)}
                for key in ("W", "C", "W/C"):
                    values = [row[key] for row in here if row[key] is not None]
                    entry[key] = mean(values, geometric=True) if len(values) == len(here) else None
                marks = {row["mark"] for row in here} - {""}
                bounds = marks & {"<", ">"}
                entry["mark"] = bounds.pop() if len(bounds) == 1 else "~" if marks else ""
                means.append(entry)
    return means


def as_csv(worth: dict[str, Any]) -> str:
    """One line for each row."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(FIELDS)
    for row in worth["rows"]:
        writer.writerow(["" if row.get(name) is None else row[name] for name in FIELDS])
    return text.getvalue()


def worth_tables(results: dict[str, Any]) -> dict[str, list[list[str]]]:
    """Title -> rows of text, the first is the head: W/C of the means, and all that is known of each scene."""
    worth = results["worth"]
    columns = [name for name in results["methods"] if any(row["method"] == name for row in worth["rows"])]
    heads = [f"W/C {name}" for name in columns]
    tables = {}
    means = {(row["group"], row["spp"], row["method"]): row for row in worth["means"]}
    if means:
        table = [["scenes", "spp", "W", "C", "W/C", *heads]]
        for group, spp, method in means:
            if method is None:
                best = means[group, spp, None]
                others = [_marked(means.get((group, spp, name)), "W/C") for name in columns]
                name = f"{group} ({best['scenes']})"
                table.append([name, str(spp), *(_marked(best, key) for key in ("W", "C", "W/C")), *others])
        tables["Worth of gradients, geometric means; best pipelines, then each column with gradients"] = table
    rows = {(row["scene"], row["spp"], row["method"]): row for row in worth["rows"]}
    table = [["scene", "spp", "with gradients", "without", "W", "C", "W/C", "blocks", *heads]]
    for best in worth["rows"]:
        if best["best"]:
            others = [_marked(rows.get((best["scene"], best["spp"], name)), "W/C") for name in columns]
            values = [_marked(best, key) for key in ("W", "C", "W/C")]
            blocks = "" if best.get("blocks") is None else f"{best['blocks']:.0%}"
            table.append([best["scene"], str(best["spp"]), best["method"], best["rival"], *values, blocks, *others])
    if len(table) > 1:
        tables["Worth of gradients, scene by scene"] = table
    return tables


def _marked(row: dict[str, Any] | None, key: str) -> str:
    """A number with its mark; C is measured, whatever W is."""
    if row is None or row[key] is None:
        return ""
    return f"{'' if key == 'C' else row['mark']}{row[key]:.2f}"
