"""Writes the report of an evaluation: one HTML file from the folder of results."""

import json
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ngpt.errors import NgptError
from ngpt.io.exr import read_image
from ngpt.report.content import Overview, ReportEntry, Scene
from ngpt.report.page import write_report

FORMAT = 2
# The most pixels that a page can hold in acceptable quality: 6 scenes with 8 methods and the reference
ROOM = 54 * 1280 * 720


def write_evaluation_report(folder: str | os.PathLike, output: str | os.PathLike, *, overwrite: bool = False) -> Path:
    """Writes the report of ``folder``/results.json to ``output`` and returns its path.

    Tables hold all results. Pictures are shown only for the first seed, and for the lowest sample counts whose pictures
    fit into ROOM; the page names these counts. A method without a picture is listed with the reason. Raises NgptError
    if the folder has no readable results, or no result has a picture.
    """
    folder = Path(folder)
    results = read_results(folder)
    cells = [cell for cell in results["cells"] if cell["image"]]
    counts = sorted({cell["spp"] for cell in cells})
    shown = _fitting(results, cells, counts)
    scenes = []
    for name in results["scenes"]:
        for spp in shown:
            here = [cell for cell in results["cells"] if (cell["scene"], cell["spp"]) == (name, spp)]
            if any(cell["image"] for cell in here):
                scenes.append(_scene(folder, results, name, spp, here))
    if not scenes:
        raise NgptError(f"{folder / 'results.json'}: no cell has a picture, so there is nothing to show")
    versions = results["metadata"].get("versions", {})
    footer = {"date": results["date"], **{key: str(value) for key, value in versions.items()}}
    metadata = results["metadata"]
    footer |= {key: str(metadata[key]) for key in ("cpu", "threads", "commit") if metadata.get(key)}
    footer["pictures"] = f"first seed; {', '.join(map(str, shown))} spp of {', '.join(map(str, counts))}"
    overview = Overview(_tables(results), _formulas(results))
    title, command = results["title"], results["command"]
    return write_report(output, title, scenes, command=command, footer=footer, overview=overview, overwrite=overwrite)


def read_results(folder: Path) -> dict[str, Any]:
    """The results of an evaluation. Raises NgptError if they cannot be read or have another format."""
    path = folder / "results.json"
    try:
        results = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise NgptError(f"{path}: cannot be read ({error}); run eval.py with --out {folder} first") from error
    if not isinstance(results, dict) or results.get("format") != FORMAT:
        raise NgptError(f"{path}: is not of format {FORMAT}; run the eval.py of this version again")
    return results


def _fitting(results: dict, cells: list[dict], counts: list[int]) -> list[int]:
    """The lowest sample counts whose pictures fit into ROOM, at least one. At high counts, all pictures look alike."""
    taken, shown = 0, list[int]()
    for spp in counts:
        drawn = {(cell["scene"], cell["method"]) for cell in cells if cell["spp"] == spp}
        names = [name for name, _ in drawn] + list({name for name, _ in drawn})  # one reference per scene
        taken += sum(math.prod(results["scenes"][name]["size"]) for name in names)
        if shown and taken > ROOM:
            break
        shown.append(spp)
    return shown


def _scene(folder: Path, results: dict, name: str, spp: int, cells: list[dict]) -> Scene:
    """The tab of a scene at a sample count. ``cells`` has one result for each method and seed."""
    scene = results["scenes"][name]
    entries, absent = [], []
    for method in results["methods"]:
        mine = [cell for cell in cells if cell["method"] == method]
        pictured = next((cell for cell in mine if cell["image"]), None)
        if pictured is None:
            why = results["methods"][method]["absent"] or next((c["absent"] for c in mine if c["absent"]), "no result")
            absent.append(f"{method} ({why})")
            continue
        seconds = _row(results, name, spp, method)["seconds"]["total"]
        metrics: dict[str, float | Sequence[float]] = {}
        for metric in results["metrics"]:
            found = [cell["metrics"].get(metric) for cell in mine if not cell["absent"]]
            values = [math.nan if value is None else value for value in found]
            metrics[metric] = values[0] if len(values) == 1 else values
        entries.append(ReportEntry(method, read_image(folder / pictured["image"]), seconds, metrics))
    # The first metric is shown below the pictures and decides which method is best.
    for entry in entries:
        entry.metrics = dict(sorted(entry.metrics.items(), key=lambda item: item[0] != results["primary"]))
    reference = scene["reference"] or {"image": None}
    image = read_image(folder / reference["image"]) if reference["image"] else None
    clock = f"sampler {results['settings']['clock']}" if several_samplers(results) else "gradients"
    size = f"{scene['size'][0]}x{scene['size'][1]}"
    facts = [f"{size}, equal rendering time to {spp} spp of {clock}; times are render and method"]
    # The number of samples of a reference from elsewhere may be unknown.
    samples = f"reference {reference['spp']:g} spp" if reference.get("spp") else "reference"
    facts += [samples] if image is not None else ["no reference"]
    floors = [f"{metric} {value:.3g}" for metric, value in reference.get("floors", {}).items() if value is not None]
    facts += [f"between the reference's halves {', '.join(floors)}"] if floors else []
    facts += ["without " + ", ".join(absent)] if absent else []
    rising = [metric for metric, entry in results["metrics"].items() if entry["better"] == "higher"]
    return Scene(f"{name}, {spp} spp", "; ".join(facts), image, entries, rising=rising)


def _row(results: dict, scene: str | None, spp: int, method: str) -> dict:
    """The row of the summary for a scene, a sample count and a method; an empty row if there is none."""
    found = (row for row in results["summary"] if (row["scene"], row["spp"], row["method"]) == (scene, spp, method))
    return next(found, {"metrics": {}, "seconds": {"total": None}, "pareto": False})


def _tables(results: dict) -> dict[str, list[list[str]]]:
    """Tables of the primary metric by methods and sample counts: one of the mean over scenes, and one for each scene.

    Two more tables have the costs of samplers, if there are several samplers, and the absent results with reasons.
    """
    counts = sorted({row["spp"] for row in results["summary"]})
    tables = {}
    for scene in [None, *results["scenes"]]:
        doubt = (results["scenes"][scene].get("reference") or {}).get("doubt") if scene else None
        rows = [["method", *(f"{spp} spp" for spp in counts)]]
        for method in results["methods"]:
            found = [_row(results, scene, spp, method) for spp in counts]
            if any(row["metrics"] for row in found):
                rows.append([method, *(_cell(row, results["primary"], doubt) for row in found)])
        note = "median (lowest to highest) over seeds, seconds in all; ● on the Pareto front; ~ noise of the reference"
        if len(rows) > 1:
            tables[f"{results['primary']}, {scene or 'geometric mean over scenes'}: {note}"] = rows
    absent = {(cell["scene"], cell["method"], cell["absent"]) for cell in results["cells"] if cell["absent"]} | {
        (name, "all", scene["absent"]) for name, scene in results["scenes"].items() if scene["absent"]
    }
    if several_samplers(results):
        tables |= _costs(results)
    if absent:
        tables["Absent"] = [["scene", "method", "why"], *map(list, sorted(absent))]
    return tables


def several_samplers(results: dict) -> bool:
    """Whether the stacks of any method come from a sampler other than the usual one for its kind of stack."""
    return any(entry["render"] != entry["stack"] for entry in results["methods"].values())


def _costs(results: dict) -> dict[str, list[list[str]]]:
    """The table of the cost of one sample per pixel, in milliseconds for the whole image, by scene and sampler."""
    costs = {name: entry["cost"] for name, entry in results["scenes"].items() if entry.get("cost")}
    renders = list(dict.fromkeys(name for cost in costs.values() for name in cost))
    rows = [["scene", *renders, "auto"]]
    for scene, cost in costs.items():
        times = [f"{cost[name]['median'] * 1e3:.3g}" if name in cost else "-" for name in renders]
        rows.append([scene, *times, cost["gradients"]["sampler"]])
    return {"Milliseconds a sample, by kind of stack and sampler": rows} if costs else {}


def _cell(row: dict, metric: str, doubt: float | None) -> str:
    """The text of a row's numbers, with ~ if the error is below ``doubt``, the noise of the reference."""
    value = row["metrics"].get(metric)
    if not value or value["median"] is None:
        return "-"
    text = f"{value['median']:.4g}{' ~' if value['median'] < (doubt or 0.0) else ''}"
    if None not in (value.get("low"), value.get("high")) and value["low"] != value["high"]:
        text += f" ({value['low']:.3g} to {value['high']:.3g})"
    if row["seconds"] and row["seconds"].get("total") is not None:
        text += f", {row['seconds']['total']:.3g} s"
    return text + (" ●" if row.get("pareto") else "")


def _formulas(results: dict) -> dict[str, str]:
    """The formulas of the metrics, and of r in them if references have two halves."""
    texts = {name: f"{metric['formula']} ({metric['better']} is better)" for name, metric in results["metrics"].items()}
    if any((scene.get("reference") or {}).get("halves") for scene in results["scenes"].values()):
        texts["r"] = (
            "mean of a reference's two independent halves a, b; (x - r)² is (x - a)(x - b), "
            "which has no bias by the reference's noise"
        )
    return texts
