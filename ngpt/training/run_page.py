"""Makes the page of a training run, and the page that compares several runs, without PyTorch.

A page is made from ``log.jsonl`` in the folder of a run, and from ``settings.json``, ``run.json`` and the last
``validation-STEP`` if they exist. So a page can be made of any run at any time.
"""

import base64
import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ngpt.errors import NgptError
from ngpt.network.training_log import LOG, entries_of
from ngpt.report.curves import curves
from ngpt.report.document import document
from ngpt.report.markup import plain_table, plots_html
from ngpt.system.console import span
from ngpt.system.records import read_json
from ngpt.system.text import markup
from ngpt.system.writing import write_text
from ngpt.training.run_summary import PAGE, SETTINGS
from ngpt.training.settings_text import difference, flat

RECORD = "run.json"
# Seconds after which an open page of an unfinished run reloads itself.
REFRESH = 30
COLUMNS = ("input", "result", "reference")

STYLE = """
.views { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(400px, 100%), 1fr)); gap: 12px; }
.strip { background-repeat: no-repeat; background-size: 100% auto; image-rendering: pixelated; width: 100%; }
.heads { display: grid; grid-template-columns: repeat(3, 1fr); color: var(--soft); font-size: 12px; }
.heads span { padding: 3px 8px; }
.wide figcaption { display: block; } main h3:first-child { margin-top: 8px; } td { vertical-align: top; }
.settings table { width: auto; } .settings .scroll { width: fit-content; max-width: 100%; }
.settings th, .settings td { text-align: left; white-space: normal; overflow-wrap: anywhere; }
"""


@dataclass(frozen=True)
class Run:
    """The contents of a run's folder: the ``entries`` of its log, and ``settings`` and ``record``, {} if missing."""

    folder: Path
    name: str
    entries: list[dict[str, float]]
    settings: dict[str, Any] = field(default_factory=dict)
    record: dict[str, Any] = field(default_factory=dict)

    @property
    def steps(self) -> int:
        """The planned number of steps; 0 if it is not known."""
        return int(self.settings.get("run", {}).get("steps", 0))

    @property
    def done(self) -> int:
        return int(self.entries[-1]["step"]) if self.entries else 0

    @property
    def scores(self) -> list[dict[str, float]]:
        """The entries with the results of validations."""
        return [entry for entry in self.entries if "relMSE" in entry]

    @property
    def best(self) -> dict[str, float]:
        """The entry of the validation with the least error; {} before the first validation."""
        return min(self.scores, key=lambda entry: entry["relMSE"], default={})

    def line(self, name: str) -> list[tuple[float, float]]:
        """The points (step, value) of the number ``name``."""
        return [(entry["step"], entry[name]) for entry in self.entries if name in entry]

    def last(self, name: str) -> float:
        """The last value of the number ``name``; NaN if there is none."""
        return next((entry[name] for entry in reversed(self.entries) if name in entry), math.nan)


def read_run(folder: str | Path, name: str = "") -> Run:
    """The run in a folder. Raises NgptError if it has no log, or if a file cannot be read."""
    folder = Path(folder)
    if not (folder / LOG).is_file():
        raise NgptError(f"{folder}: holds no {LOG}; name the folder that `ngpt train --out` wrote")
    others = [read_json(folder / file) if (folder / file).is_file() else {} for file in (SETTINGS, RECORD)]
    for file, value in zip((SETTINGS, RECORD), others, strict=True):
        if not isinstance(value, dict):
            raise NgptError(f"{folder / file}: is no record of a training run")
    return Run(folder, name or folder.absolute().name, entries_of(folder / LOG), *others)


def write_run(folder: str | Path) -> None:
    """Writes ``run.html`` into the folder of a run, unless it has no log yet."""
    folder = Path(folder)
    if not (folder / LOG).is_file():
        return
    write_text(folder / PAGE, page([read_run(folder)]))


def page(runs: list[Run], command: str = "") -> str:
    """The page of one run, or the comparison of several, as HTML."""
    alone = runs[0] if len(runs) == 1 else None
    going = alone is not None and alone.done < alone.steps
    parts = ["<h3>Runs</h3>", plain_table(_overview(runs))]
    parts += [f'<p class="hint">{markup(_state(alone))}</p>' if alone else ""]
    parts += [_pictures(run) for run in runs]
    parts += ["<h3>Curves</h3>", plots_html(_plots(runs))]
    if not alone:
        values = [flat(run.settings) for run in runs]
        differing = _side_by_side("setting", runs, values, difference(*values))
        parts.append(_settings("Settings that differ", differing))
    for run in runs:
        parts.append(_settings(f"{run.name}: what differs from {run.record.get('base', '?')}", _own(run)))
    facts = [flat(run.record.get("system", {})) for run in runs]
    names = list(dict.fromkeys(name for fact in facts for name in fact))
    parts.append(_settings("System", _side_by_side("system", runs, facts, names)))
    if alone:
        rows = [["setting", "value"], *([key, _text(value)] for key, value in flat(alone.settings).items())]
        parts.append(f"<details><summary>All settings</summary>{_settings('', rows)}</details>")
    title = f"Training run {alone.name}" if alone else f"{len(runs)} training runs"
    return document(title, "\n".join(parts), command=command, style=_style(runs), refresh=REFRESH if going else 0)


def _overview(runs: list[Run]) -> list[list[str]]:
    """A row for each run: progress, error, speed."""
    head = ["run", "steps", "best relMSE", "at step", "over the input's", "over the base's", "last relMSE", "time"]
    rows = [[*head, "steps/s", "memory, MiB", "parameters"]]
    least = min((run.best["relMSE"] for run in runs if run.best), default=math.nan)
    for run in runs:
        best, score = run.best, run.best.get("relMSE", math.nan)
        mark = " (least)" if len(runs) > 1 and score == least else ""
        row = [run.name, f"{run.done:,} of {run.steps:,}" if run.steps else f"{run.done:,}"]
        row += [_number(score) + mark, _number(best.get("step", math.nan))]
        row += [_number(score / best[f"relMSE {of}"]) if best.get(f"relMSE {of}") else "-" for of in ("primal", "base")]
        row += [_number(run.last("relMSE")), _time(run.last("seconds"))]
        row += [_number(run.last("steps/s")), _number(run.last("memory MiB"))]
        rows.append([*row, f"{run.record['parameters']:,}" if "parameters" in run.record else "-"])
    return rows


def _state(run: Run) -> str:
    """The steps that are left, and their time at the latest rate."""
    if not run.steps:
        return ""
    if run.done >= run.steps:
        return "Finished. The weights with the least error are in best.safetensors, the last in weights.safetensors."
    left, rate = run.steps - run.done, run.last("steps/s")
    time = f", about {span(left / rate)} at {rate:.3g} steps/s" if rate > 0 else ""
    return f"{left:,} steps to go{time}. This page is read again every {REFRESH} seconds while it is open."


def _plots(runs: list[Run]) -> dict[str, str]:
    """Curves over the steps. For several runs, each plot has a line for each run."""
    plots: dict[str, str] = {}
    if len(runs) == 1:
        for title, name in (("relMSE of the views held out", "relMSE"), ("flicker of the shots held out", "flicker")):
            lines = {"network": name, "base": f"{name} base", "input": f"{name} primal"}
            plots[title] = curves("steps", {whose: runs[0].line(entry) for whose, entry in lines.items()})
    else:
        plots = {"relMSE of the views held out": curves("steps", {run.name: run.line("relMSE") for run in runs})}
        unit, seconds = ("hours", 3600.0) if any(run.last("seconds") >= 3600 for run in runs) else ("minutes", 60.0)
        plots[f"the same over {unit}"] = curves(unit, {run.name: _over_time(run, seconds) for run in runs})
    for title, name in (
        ("loss", "loss"),
        ("norm of the gradient", "gradient norm"),
        ("learning rate", "learning rate"),
        ("steps a second", "steps/s"),
        ("memory, MiB", "memory MiB"),
    ):
        plots[title] = curves("steps", {run.name: run.line(name) for run in runs})
    return {title: svg for title, svg in plots.items() if svg}


def _over_time(run: Run, unit: float) -> list[tuple[float, float]]:
    seconds, points = 0.0, []
    for entry in run.entries:
        seconds = entry.get("seconds", seconds)
        if "relMSE" in entry:
            points.append((seconds / unit, entry["relMSE"]))
    return points


def _time(seconds: float) -> str:
    return span(seconds) if math.isfinite(seconds) else "-"


def _drawn(run: Run) -> tuple[Path, dict[str, Any]] | None:
    """The picture of the last validation with captions, and the captions; None without any."""
    for path in sorted(run.folder.glob("validation-*.json"), reverse=True):
        captions = read_json(path)
        if path.with_suffix(".png").is_file() and isinstance(captions, dict) and captions.get("views"):
            return path.with_suffix(".png"), captions
    return None


def _pictures(run: Run) -> str:
    """The views of the last validation: for each, a strip of three pictures, its scene, samples and errors."""
    found = _drawn(run)
    if found is None:
        return ""
    path, captions = found
    heads = '<div class="heads">' + "".join(f"<span>{name}</span>" for name in COLUMNS) + "</div>"
    strips = []
    for row, view in enumerate(captions["views"]):
        text = f"{markup(str(view['scene']))}, {view['spp']} spp"
        given, made = (_number(view.get(name, math.nan)) for name in ("relMSE primal", "relMSE"))
        errors = f"relMSE {given} &rarr; {made}"
        strip = f'<div class="strip {_key(run)} row{row}"></div>'
        strips.append(
            f'<figure class="wide"><div class="{_key(run)}-box">{heads}{strip}</div>'
            f"<figcaption><b>{text}</b> <small>{errors}</small></figcaption></figure>"
        )
    step = int(path.stem.rpartition("-")[2])
    return f'<h3>{markup(run.name)}, step {step:,}: views held out</h3><div class="views">{"".join(strips)}</div>'


def _key(run: Run) -> str:
    """The class of a run's pictures in the style sheet."""
    return "of-" + run.folder.absolute().as_posix().encode().hex()[-48:]


def _style(runs: list[Run]) -> str:
    """The style sheet. It holds each picture once, as a background, of which each strip shows one row."""
    rules = [STYLE]
    for run in runs:
        if (found := _drawn(run)) is not None:
            path, captions = found
            data = base64.b64encode(path.read_bytes()).decode()
            width, height = captions["size"]
            # A pixel is at most two pixels of the screen wide.
            rules.append(f".{_key(run)}-box {{ max-width: {6 * width}px; }}")
            rules.append(
                f".{_key(run)} {{ background-image: url(data:image/png;base64,{data}); "
                f"aspect-ratio: {3 * width} / {height}; }}"
            )
            count = len(captions["views"])
            rules += [
                f".{_key(run)}.row{i} {{ background-position-y: {round(100 * i / max(count - 1, 1), 4)}%; }}"
                for i in range(count)
            ]
    return "\n".join(rules)


def _settings(title: str, rows: list[list[str]]) -> str:
    """A table with its title; "" if it has only a header."""
    head = f"<h3>{markup(title)}</h3>" if title else ""
    return f'{head}<div class="settings">{plain_table(rows)}</div>' if len(rows) > 1 else ""


def _own(run: Run) -> list[list[str]]:
    """The settings of a run that differ from its configuration."""
    changed = run.record.get("changed", {})
    rows = [[name, *map(_text, values)] for name, values in changed.items()]
    return [["setting", str(run.record.get("base", "?")), "this run"], *rows]


def _side_by_side(title: str, runs: list[Run], values: list[dict[str, Any]], names: list[str]) -> list[list[str]]:
    """A table with a column for each run and a row for each of ``names``."""
    head = [title, *(run.name for run in runs)]
    return [head, *([name, *(_text(value.get(name)) for value in values)] for name in names)]


def _text(value: Any) -> str:
    if value is None:
        return "-"
    return value if isinstance(value, str) else json.dumps(value)


def _number(value: float) -> str:
    return f"{value:.4g}" if math.isfinite(value) else "-"
