"""What the folder of results holds: results.*, worth.*, against.csv and plots, all from the cells."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ngpt.evaluation.config import groups_of
from ngpt.evaluation.frontier import Point, draw, pareto
from ngpt.evaluation.tables import tables, worth_page
from ngpt.evaluation.wholetime import FIELDS as RIVAL_FIELDS
from ngpt.evaluation.wholetime import against_rivals, against_tables, envelope
from ngpt.evaluation.worth import FIELDS as WORTH_FIELDS
from ngpt.evaluation.worth import worth_of_gradients, worth_tables
from ngpt.evaluation.worthplots import draw_worth, write_map
from ngpt.measure.averages import geometric_mean, mean, median, summary
from ngpt.system.writing import csv_text, write_json, write_text

_SECONDS = ("render", "reconstruct", "total", "reconstruct wall")


def write_results(results: dict[str, Any], out: Path) -> None:
    """Adds ``summary`` and ``plots`` to the results and writes all files of the folder but the pictures."""
    results["summary"] = summarised(results)
    results["plots"] = {"frontier": {}}
    (out / "plots").mkdir(exist_ok=True)
    for scene in [*results["scenes"], None]:
        points = _points(results, [row for row in results["summary"] if row["scene"] == scene and _is_drawn(row)])
        if points:
            name = scene or "mean"
            title = scene or f"geometric mean over {len(shared_scenes(results))} scenes"
            doubt = results["scenes"][scene]["reference"]["doubt"] if scene else None
            _write_frontier(results, out, name, draw(points, title, results["primary"], doubt))
    _write_worth(results, out)
    _write_against(results, out)
    write_json(out / "results.json", results)
    write_text(out / "results.csv", as_csv(results))
    write_text(out / "results.md", tables(results))


def _write_frontier(results: dict[str, Any], out: Path, name: str, plot: str) -> None:
    path = f"plots/frontier-{name.replace(' ', '-')}.svg"
    write_text(out / path, plot)
    results["plots"]["frontier"][name] = path


def _write_against(results: dict[str, Any], out: Path) -> None:
    """Adds ``against`` to the results and writes its files: none where the configuration names no rivals."""
    if not results["settings"]["against"]:
        return
    against = results["against"] = against_rivals(results)
    against["tables"] = against_tables(results)
    write_text(out / "against.csv", _columns(RIVAL_FIELDS, against["rows"]))
    for group, scenes in groups_of(results, shared_scenes(results)).items():
        points = points_against(results, scenes)
        if points:
            title = f"{group}: geometric mean over {len(scenes)} scenes"
            _write_frontier(results, out, f"rivals-{group}", draw(points, title, results["primary"]))


def points_against(results: dict[str, Any], scenes: list[str]) -> list[Point]:
    """Geometric means over the scenes of the columns that are no rival's setting, and each rival at its best."""
    rivals = results["settings"]["against"]
    points = [
        Point(rival, 0, seconds, error, rival)
        for rival in rivals
        for seconds, error in envelope(results, rival, scenes)
    ]
    settings = {column for columns in rivals.values() for column in columns}
    for method in (name for name in results["methods"] if name not in settings):
        for spp in results["settings"]["spp"]:
            here = [r for r in results["summary"] if (r["spp"], r["method"]) == (spp, method) and r["scene"] in scenes]
            if scenes and len(here) == len(scenes) and all(map(_is_drawn, here)):
                seconds = geometric_mean(row["seconds"]["total"] for row in here)
                error = geometric_mean(row["error"] for row in here)
                points.append(Point(method, spp, seconds, error, method))
    return points


def _write_worth(results: dict[str, Any], out: Path) -> None:
    """Adds ``worth`` to the results and writes its files; none where columns with or without gradients are missing."""
    worth = results["worth"] = worth_of_gradients(results)
    if not worth["rows"]:
        return
    plots = results["plots"]["worth"] = {}
    if any(row["best"] and row["W/C"] for row in worth["rows"]):
        write_text(out / "plots/worth.svg", draw_worth(worth))
        plots["samples"] = "plots/worth.svg"
    for scene in dict.fromkeys(row["scene"] for row in worth["rows"]):
        entry = results["scenes"][scene]
        if "worth" not in entry:
            entry["worth"] = write_map(results, scene, out)
        if entry["worth"]:
            plots[scene] = entry["worth"]["map"]
            for row in worth["rows"]:
                if row["best"] and row["scene"] == scene:
                    row["blocks"] = entry["worth"]["blocks"].get(str(row["spp"]))
    worth["tables"] = worth_tables(results)
    write_text(out / "worth.csv", _columns(WORTH_FIELDS, worth["rows"]))
    write_text(out / "worth.md", worth_page(results))


def shared_scenes(results: dict[str, Any]) -> list[str]:
    """The scenes that have results; means are over these."""
    return [name for name, entry in results["scenes"].items() if not entry.get("absent")]


def summarised(results: dict[str, Any]) -> list[dict[str, Any]]:
    """A row for each scene, spp and method: median and quartiles over seeds; then geometric means over scenes.

    ``error`` is the primary metric's median. Means, with scene None, are of methods that are there on all scenes; a
    metric that is not an error (PSNR, SSIM) has its arithmetic mean. An error below 0, which is one that the halves
    of a reference cannot tell from 0, has no geometric mean. ``pareto`` says that no cell of the
    scene is both faster and better.
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
                        scores[name] = {
                            key: mean([value[key] for value in found], geometric=lower)
                            for key in ("median", "low", "high")
                        }
                times: dict[str, float | None] = {}
                for key in _SECONDS:
                    known = [row["seconds"][key] for row in parts if row["seconds"][key] is not None]
                    times[key] = geometric_mean(known) if len(known) == len(parts) else None
                rows.append(_row(results, None, spp, method, scores, times, min(row["seeds"] for row in parts)))
    for scene in {row["scene"] for row in rows}:
        timed = [row for row in rows if row["scene"] == scene and _is_drawn(row)]
        for row, is_best in zip(timed, pareto(_points(results, timed)), strict=True):
            row["pareto"] = is_best
    return rows


def _is_drawn(row: dict[str, Any]) -> bool:
    """Whether there are a time and an error; logarithmic axes know no zero."""
    return (row["error"] or 0) > 0 and bool(row["seconds"]["total"])


def _points(results: dict[str, Any], rows: list[dict[str, Any]]) -> list[Point]:
    families = {name: entry["family"] for name, entry in results["methods"].items()}
    return [Point(r["method"], r["spp"], r["seconds"]["total"], r["error"], families[r["method"]]) for r in rows]


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


def _columns(fields: Sequence[str], rows: list[dict[str, Any]]) -> str:
    return csv_text([fields, *(map(row.get, fields) for row in rows)])
