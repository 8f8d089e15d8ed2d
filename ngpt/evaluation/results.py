"""Writes results.json and results.csv from the cells of an evaluation."""

from pathlib import Path
from typing import Any

import numpy as np

from ngpt.measure.averages import geometric_mean, median, summary
from ngpt.system.writing import csv_text, write_json, write_text

_SECONDS = ("render", "reconstruct", "total", "reconstruct wall")


def write_results(results: dict[str, Any], out: Path) -> None:
    """Adds ``summary`` to the results, and writes results.json and results.csv."""
    results["summary"] = summarised(results)
    write_json(out / "results.json", results)
    write_text(out / "results.csv", as_csv(results))


def shared_scenes(results: dict[str, Any]) -> list[str]:
    """The scenes that have results, over which means are taken."""
    return [name for name, entry in results["scenes"].items() if not entry.get("absent")]


def summarised(results: dict[str, Any]) -> list[dict[str, Any]]:
    """A row for each scene, spp and method: median and quartiles over seeds; then means over scenes, with scene None.

    ``error`` is the median of the primary metric. A method has means only if it has results for all scenes. Means of
    errors are geometric; means of metrics that are no errors (PSNR, SSIM) are arithmetic. An error below 0 has no
    geometric mean: the halves of the reference cannot distinguish such an error from 0. ``pareto`` says that no other
    row of the scene is ahead in time and error (``_is_ahead``).
    """
    rows: list[dict[str, Any]] = []
    groups: dict[tuple, list[dict[str, Any]]] = {}
    for cell in results["cells"]:
        if not cell["absent"]:
            groups.setdefault((cell["scene"], cell["spp"], cell["method"]), []).append(cell)
    for (scene, spp, method), cells in groups.items():
        scores = {}
        for name in cells[0]["metrics"]:
            values = [cell["metrics"][name] for cell in cells if cell["metrics"].get(name) is not None]
            if values:
                scores[name] = summary(values)
        seconds = {key: median(cell["seconds"][key] for cell in cells) for key in _SECONDS}
        rows.append(_row(results, scene, spp, method, scores, seconds, len(cells)))
    scenes = shared_scenes(results)
    for spp in sorted({row["spp"] for row in rows}):
        for method in results["methods"]:
            parts = [row for row in rows if (row["spp"], row["method"]) == (spp, method)]
            if scenes and len(parts) == len(scenes):
                scores = {}
                for name in parts[0]["metrics"]:
                    found = [row["metrics"][name] for row in parts if name in row["metrics"]]
                    lower = results["metrics"][name]["better"] == "lower"
                    if len(found) == len(parts) and not (lower and min(value["median"] for value in found) < 0):
                        average = geometric_mean if lower else np.mean
                        ends = ("median", "low", "high")
                        scores[name] = {key: float(average([value[key] for value in found])) for key in ends}
                times: dict[str, float | None] = {}
                for key in _SECONDS:
                    known = [row["seconds"][key] for row in parts if row["seconds"][key] is not None]
                    times[key] = geometric_mean(known) if len(known) == len(parts) else None
                rows.append(_row(results, None, spp, method, scores, times, min(row["seeds"] for row in parts)))
    for row in filter(_is_timed, rows):
        row["pareto"] = not any(_is_ahead(other, row) for other in rows if other["scene"] == row["scene"])
    return rows


def _is_timed(row: dict[str, Any]) -> bool:
    """Whether the row has a time and an error above 0."""
    return (row["error"] or 0) > 0 and bool(row["seconds"]["total"])


def _is_ahead(a: dict[str, Any], b: dict[str, Any]) -> bool:
    """Whether ``a`` is at least as fast and at least as good as ``b``, and also faster or better."""
    pairs = ((a["seconds"]["total"], b["seconds"]["total"]), (a["error"], b["error"]))
    return _is_timed(a) and all(x <= y for x, y in pairs) and any(x < y for x, y in pairs)


def _row(
    results: dict[str, Any],
    scene: str | None,
    spp: int,
    method: str,
    scores: dict[str, dict[str, float]],
    seconds: dict[str, float | None],
    seeds: int,
) -> dict[str, Any]:
    error = scores.get(results["primary"], {}).get("median")
    row: dict[str, Any] = {"scene": scene, "spp": spp, "method": method, "error": error, "metrics": scores}
    return row | {"seconds": seconds, "seeds": seeds, "pareto": False}


def as_csv(results: dict[str, Any]) -> str:
    place, names = ("scene", "spp", "method", "seed", "spp used"), list(results["metrics"])
    rows = [[*place, *(f"{key} s" for key in _SECONDS), *names, "absent"]]
    for cell in results["cells"]:
        seconds = [(cell["seconds"] or {}).get(key) for key in _SECONDS]
        metrics = [cell["metrics"].get(name) for name in names]
        rows.append([*map(cell.get, place), *seconds, *metrics, cell["absent"]])
    return csv_text(rows)
