"""The report of all windows so far: what passed, what failed and how, what was rendered, and scores of the networks."""

import json
from pathlib import Path
from typing import Any

from ngpt.errors import NgptError
from ngpt.system.writing import write_json, write_text
from ngpt.training.dataset import read_manifest
from ngpt.training.run_summary import summary


def write_report(work: Path, out: Path, left_out: list[str]) -> None:
    """``out``/report.json and report.md of a working folder; ``left_out`` is what its parcel had no room for."""
    told = gather(work) | {"left out": left_out}
    write_json(out / "report.json", told)
    write_text(out / "report.md", markdown(told))


def gather(work: Path) -> dict[str, Any]:
    checks = [_read(path) for path in sorted(work.glob("checks/*.json"))]
    windows = [_read(path) for path in sorted(work.glob("windows/*.json"))]
    runs = {path.name: _run(path) for path in sorted(work.glob("runs/*")) if path.is_dir()}
    return {"checks": checks, "windows": windows, "crops": crops(work / "data"), "runs": runs}


def crops(folder: Path) -> dict[str, int]:
    """How many crops were rendered there, by the variant that rendered them."""
    found: dict[str, int] = {}
    try:
        entries = read_manifest(folder)["shards"]
    except NgptError:
        return found
    for entry in entries:
        variant = entry.get("versions", {}).get("variant", "?")
        found[variant] = found.get(variant, 0) + len(entry["crops"])
    return found


def scenes(folder: Path) -> set[str]:
    """The names of the scenes whose crops are there."""
    try:
        return {entry["scene"] for entry in read_manifest(folder)["shards"] if entry["crops"]}
    except NgptError:
        return set()


def steps(work: Path) -> int:
    """How many steps all runs together have trained, by their checkpoints."""
    return sum(run.get("checkpoint at step", 0) for run in gather(work)["runs"].values())


def in_words(found: dict[str, int]) -> str:
    return ", ".join(f"{count} by {variant}" for variant, count in found.items()) or "none"


def _read(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text())


def _run(folder: Path) -> dict[str, Any]:
    """What ``ngpt info`` says of a run, and all its scores."""
    try:
        told = summary(folder)
    except NgptError as error:
        return {"error": str(error)}
    lines = (folder / "log.jsonl").read_text().splitlines() if (folder / "log.jsonl").is_file() else []
    entries = [json.loads(line) for line in lines if line.endswith("}")]
    scores = [entry for entry in entries if "relMSE" in entry]
    timed = [entry for entry in entries if "seconds" in entry]
    rate = None
    if len(timed) > 1 and timed[-1]["seconds"] > timed[0]["seconds"]:
        rate = (timed[-1]["step"] - timed[0]["step"]) / (timed[-1]["seconds"] - timed[0]["seconds"])
    return told | {"steps per second": rate, "scores": scores}


def markdown(told: dict[str, Any]) -> str:
    lines = ["# Windows on a GPU", "", "## Checks", "", "| check | | seconds | |", "|---|---|--:|---|"]
    for check in told["checks"]:
        text = check.get("error") or _short(check.get("detail", {}))
        lines.append(f"| {check['check']} | **{check['status']}** | {check['seconds']:.0f} | {_cell(text)} |")
    lines += ["", "## Windows", "", "| window | part | seconds | |", "|---|---|--:|---|"]
    for number, window in enumerate(told["windows"], 1):
        for part in window["parts"]:
            lines.append(f"| {number} | {part['part']} | {part['seconds']:.0f} | {_cell(part['told'])} |")
    lines += ["", f"Crops rendered: {in_words(told['crops'])}.", "", "## Networks", ""]
    lines += ["relMSE, trimmed, geometric means over views that were not trained on.", ""]
    lines += ["| run | step | network | its base | input | steps per second |", "|---|--:|--:|--:|--:|--:|"]
    for name, run in told["runs"].items():
        rate = f"{run['steps per second']:.2f}" if run.get("steps per second") else ""
        for score in run.get("scores", [])[-8:]:
            base = f"{score['relMSE base']:.5f}" if "relMSE base" in score else ""
            values = f"{score['relMSE']:.5f} | {base} | {score['relMSE primal']:.5f}"
            lines.append(f"| {name} | {score['step']} | {values} | {rate} |")
        if not run.get("scores"):
            step = run.get("logged until step", run.get("checkpoint at step", 0))
            lines.append(f"| {name} | {step} | {_cell(run.get('error', ''))} | | | {rate} |")
    if told["left out"]:
        first, count = ", ".join(told["left out"][:5]), len(told["left out"])
        lines += ["", f"No room in the parcel for {count} files: {first}{', ...' if count > 5 else ''}."]
    return "\n".join(lines) + "\n"


def _short(detail: dict[str, Any]) -> str:
    shown = {name: value for name, value in detail.items() if not isinstance(value, list | dict)}
    shown = {name: f"{value:.2g}" if isinstance(value, float) else value for name, value in shown.items()}
    return ", ".join(f"{name} {value}" for name, value in shown.items())


def _cell(text: Any) -> str:
    return str(text).replace("|", "/").replace("\n", " ")[:400]
