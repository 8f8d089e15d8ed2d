"""One HTML file that shows every method on every scene: for judging images, sending to others, keeping.

The page needs no network and no other file. Pictures travel as scene-linear numbers (:mod:`ngpt.report.pixelcodec`), so
the reader can change the exposure and see the error of what was measured, not of a screenshot; what their storage costs
is stated beside them. ``report.html`` holds the markup, the style and the script;
this file fills it. Without JavaScript the tables and the thumbnails remain.
"""

import base64
import hashlib
import json
import math
import os
import re
import statistics
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from html import escape
from importlib.resources import files as package_files
from pathlib import Path

import numpy as np

from ngpt.errors import NgptError
from ngpt.report import display, pixelcodec
from ngpt.report.png import encode_png
from ngpt.system.files import atomic_output

REFERENCE = "reference"  # the name of Scene.reference among the pictures
BASELINE = "primal"  # the method the table compares the others to
THUMBNAIL_WIDTH = 240
NOTHING = "&ndash;"
PAGE_LIMIT = 40e6  # bytes: what mail and a browser still take without complaint


@dataclass
class Entry:
    """What one method made of one scene."""

    name: str  #                  'primal', 'l2', ...: unique in its scene
    image: np.ndarray  #          (H, W, 3) scene-linear, any value, non-finite ones included
    seconds: float | None = None  # reconstruction time
    # e.g. {'relMSE': 0.012}, or one value per seed, of which the table shows the median and the range
    metrics: dict[str, float | Sequence[float]] = field(default_factory=dict)


@dataclass
class Scene:
    """One tab of the report. All arrays have the same height and width."""

    name: str
    caption: str  # one line, e.g. 'diffuse room, 128x128, 16 spp, render 1.2 s'
    reference: np.ndarray | None  # (H, W, 3) scene-linear
    entries: list[Entry]
    # Extra views, (H, W), (H, W, 1) or (H, W, 3): 'dx', 'dy', 'normal' and 'depth' get a map of their own, the others
    # show as colour.
    layers: dict[str, np.ndarray] = field(default_factory=dict)
    rising: Collection[str] = ()  # the metrics of which more is better; every other is an error


@dataclass
class Overview:
    """What comes after the scenes, all optional."""

    tables: dict[str, list[list[str]]] = field(default_factory=dict)  # title -> rows of text, the first is the head
    plots: dict[str, str] = field(default_factory=dict)  # title -> SVG document
    formulas: dict[str, str] = field(default_factory=dict)  # metric -> its formula in plain text


def write_report(
    path: str | os.PathLike,
    title: str,
    scenes: list[Scene],
    *,
    command: str,
    footer: dict[str, str],
    overview: Overview | None = None,
    overwrite: bool = False,
) -> Path:
    """Writes the page to ``path`` and returns it. The same arguments give the same bytes.

    ``command`` is the command line that made the pictures, ``footer`` further facts (versions, device, seed, date).
    Pictures are stored to 0.14 % of their value, or as much coarser as a page of PAGE_LIMIT bytes demands, those of
    most noise first; the page states the worst error of each.
    """
    path = Path(path)
    if not scenes:
        raise NgptError(f"{path}: a report needs at least one scene")
    for scene in scenes:
        _check(path, scene)
    exposures = [
        display.auto_exposure(scene.entries[0].image if scene.reference is None else scene.reference)
        for scene in scenes
    ]
    sections = [_section(number, scene, exposures[number]) for number, scene in enumerate(scenes)]
    after = _overview(overview or Overview())
    taken = len(after) + sum(map(len, sections)) + 60_000  # the template, and a margin for the estimates below
    pixels, steps = _pixels(scenes, exposures, 0.99 * 0.75 * (PAGE_LIMIT - taken))  # base64 adds a third
    facts = [_facts(*each) for each in zip(scenes, exposures, steps, strict=True)]
    table = base64.b64encode(display.heat_table().tobytes()).decode()
    page = {
        "scenes": facts,
        "heat": table,
        "signs": base64.b64encode(display.sign_table().tobytes()).decode(),
        "epsilon": display.ERROR_EPSILON,
        "range": display.ERROR_RANGE,
        "toe": pixelcodec.TOE,
    }
    notes = "".join(f"<div><dt>{escape(key)}</dt><dd>{escape(value)}</dd></div>" for key, value in footer.items())
    text = _filled(
        TITLE=escape(title),
        COMMAND=escape(command),
        OVERVIEW=after,
        SCENES="\n".join(sections),
        FOOTER=notes,
        # '<' as an escape: a name that contains '</script>' must stay a name.
        PAGE=json.dumps(page, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c"),
        PIXELS="\n".join(pixels),
    )
    with atomic_output(path, overwrite) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")
    return path


def _filled(**parts: str) -> str:
    """The template with its marks replaced, in one pass so that no part is searched for the marks of another."""
    text = (package_files("ngpt.report") / "report.html").read_text(encoding="utf-8")
    for tag in ("style", "script"):
        # The policy names the one style and the one script that may run: nothing a name smuggles in does.
        body = text.split(f"<{tag}>")[1].split(f"</{tag}>")[0]
        parts[tag.upper() + "_HASH"] = "sha256-" + base64.b64encode(hashlib.sha256(body.encode()).digest()).decode()
    return re.sub(r"\{\{([A-Z_]+)\}\}", lambda mark: parts[mark.group(1)], text)


def _check(path: Path, scene: Scene) -> None:
    """Raises NgptError for what the page could only show wrongly: pictures of unequal size, two of one name."""
    if not scene.entries:
        raise NgptError(f"{path}: scene '{scene.name}' has no entry; give it at least one method")
    pictures = _pictures(scene)
    size = pictures[0][1].shape[:2]
    for name, image in pictures:
        if image.shape != (*size, 3) or image.size == 0:
            raise NgptError(f"{path}: scene '{scene.name}', '{name}' is {image.shape}, expected {(*size, 3)}")
    for name, layer in scene.layers.items():
        if layer.shape not in (size, (*size, 1), (*size, 3)):
            raise NgptError(f"{path}: scene '{scene.name}', layer '{name}' is {layer.shape}, expected {size} pixels")
    names = [name for name, _ in pictures] + list(scene.layers)
    for name in names:
        if names.count(name) > 1:
            raise NgptError(f"{path}: scene '{scene.name}' has two pictures named '{name}'; rename one")


def _pictures(scene: Scene) -> list[tuple[str, np.ndarray]]:
    """Everything with light in it, in the order of the page: the methods, then the reference."""
    pictures = [(entry.name, np.asarray(entry.image)) for entry in scene.entries]
    return pictures if scene.reference is None else [*pictures, (REFERENCE, np.asarray(scene.reference))]


def _facts(scene: Scene, stops: float, steps: list[int]) -> dict:
    """What the script has to know of a scene, besides the pixels."""
    best = _best(scene, next(iter(scene.entries[0].metrics), ""))
    names = [entry.name for entry in scene.entries]
    second = names[best] if best is not None else (REFERENCE if scene.reference is not None else names[-1])
    return {
        "width": scene.entries[0].image.shape[1],
        "height": scene.entries[0].image.shape[0],
        "stops": stops,
        "steps": steps,
        "pictures": [name for name, _ in _pictures(scene)],
        "layers": list(scene.layers),
        "reference": scene.reference is not None,
        "a": BASELINE if BASELINE in names else names[0],
        "b": second if second != BASELINE else names[-1],
    }


# --- pixels ----------------------------------------------------------------------------------------------------------


def _pixels(scenes: list[Scene], exposures: list[float], room: float) -> tuple[list[str], list[list[int]]]:
    """The script elements of all pictures, in about ``room`` bytes, and the steps per stop of each scene's."""
    exposed = [
        [image.astype(np.float64) * 2.0 ** round(stops) for _, image in _pictures(scene)]
        for scene, stops in zip(scenes, exposures, strict=True)
    ]
    chosen = iter(pixelcodec.fitting_steps([image for images in exposed for image in images], room))
    steps = [[next(chosen) for _ in images] for images in exposed]
    elements = []
    for number, images in enumerate(exposed):
        for place, image in enumerate(images):
            packed = base64.b64encode(pixelcodec.encode(image, steps[number][place])).decode()
            elements.append(f'<script type="text/plain" id="pixels-{number}-{place}">{packed}</script>')
    return elements, steps


def _layer_view(name: str, layer: np.ndarray) -> np.ndarray:
    """An input layer as (H, W, 3) uint8."""
    layer = np.atleast_3d(np.asarray(layer, dtype=np.float64))
    layer = np.broadcast_to(layer, (*layer.shape[:2], 3))
    if name in ("dx", "dy"):
        return display.signed_map(layer)
    if name == "normal":
        colour = np.rint(127.5 * (np.clip(np.nan_to_num(layer), -1.0, 1.0) + 1.0)).astype(np.uint8)
        return np.where(np.isnan(layer).any(axis=2, keepdims=True), np.array(display.MAGENTA, np.uint8), colour)
    if name == "depth":
        finite = layer[np.isfinite(layer)]
        layer = layer / ((np.percentile(finite, 99.0) if finite.size else 0.0) or 1.0)
    elif name.endswith("_var"):
        return display.to_srgb8(layer, display.auto_exposure(layer))
    return display.to_srgb8(layer)


def _thumbnail(image: np.ndarray) -> np.ndarray:
    """Averages uint8 blocks until the picture is at most THUMBNAIL_WIDTH wide."""
    factor = math.ceil(image.shape[1] / THUMBNAIL_WIDTH)
    height, width = (math.ceil(side / factor) for side in image.shape[:2])
    rest = (height * factor - image.shape[0], width * factor - image.shape[1])
    padded = np.pad(image, ((0, rest[0]), (0, rest[1]), (0, 0)), mode="edge").astype(np.float64)
    return np.rint(padded.reshape(height, factor, width, factor, 3).mean(axis=(1, 3))).astype(np.uint8)


# --- markup ----------------------------------------------------------------------------------------------------------


def _section(number: int, scene: Scene, stops: float) -> str:
    first = next(iter(scene.entries[0].metrics), "")
    notes = {
        entry.name: _note(first, median(entry.metrics[first])) if first in entry.metrics else ""
        for entry in scene.entries
    }
    pictures = [
        _figure(name, _thumbnail(display.to_srgb8(image, stops)), notes.get(name, ""))
        for name, image in _pictures(scene)
    ]
    # Layers are shown in full, not as thumbnails: the page has no other copy of them.
    layers = [_figure(name, _layer_view(name, layer), "") for name, layer in scene.layers.items()]
    parts = [
        f'<section class="scene" id="scene-{number}">',
        f"<h2>{escape(scene.name)}</h2>",
        f'<p class="caption">{escape(scene.caption)}</p>',
        '<div class="slot"></div>',
        '<h3>Methods</h3><div class="thumbs">' + "".join(pictures) + "</div>",
        "<h3>Measurements</h3>" + _table(scene),
        '<h3>Input layers</h3><div class="thumbs">' + "".join(layers) + "</div>" if layers else "",
        "</section>",
    ]
    return "\n".join(part for part in parts if part)


def _figure(name: str, picture: np.ndarray, note: str) -> str:
    height, width = picture.shape[:2]
    data = base64.b64encode(encode_png(picture)).decode()
    small = ' class="pixelated"' if width <= THUMBNAIL_WIDTH // 2 else ""
    return (
        f'<figure data-name="{escape(name)}"><div class="frame">'
        f'<img{small} width="{width}" height="{height}" alt="{escape(name)}" src="data:image/png;base64,{data}"></div>'
        f"<figcaption><b>{escape(name)}</b>{note}</figcaption></figure>"
    )


def _note(metric: str, value: float) -> str:
    return f"<small>{escape(metric)} {_number(value)}</small>"


def _table(scene: Scene) -> str:
    """Methods down, metrics and seconds across; the best value of a metric is bold, each is compared to BASELINE."""
    metrics = list(dict.fromkeys(metric for entry in scene.entries for metric in entry.metrics))
    best = {metric: _best(scene, metric) for metric in metrics}
    baseline = next((entry.metrics for entry in scene.entries if entry.name == BASELINE), {})
    heads = [
        f'<th scope="col">{escape(metric)} <i>{"↑" if metric in scene.rising else "↓"}</i><small></small></th>'
        for metric in metrics
    ]
    rows = []
    for row, entry in enumerate(scene.entries):
        cells = []
        for metric in metrics:
            values = entry.metrics.get(metric, math.nan)
            value, primal = median(values), median(baseline.get(metric, math.nan))
            compared = "" if entry.name == BASELINE else _compared(value, primal, metric in scene.rising)
            mark = ' class="best"' if best[metric] == row else ""
            cells.append(f"<td{mark}><span>{_number(value)}</span>{_spread(values)}<small>{compared}</small></td>")
        seconds = NOTHING if entry.seconds is None else f"{entry.seconds:.3g} s"
        cells.append(f"<td><span>{seconds}</span></td>")
        rows.append(f'<tr><th scope="row">{escape(entry.name)}</th>{"".join(cells)}</tr>')
    head = f'<tr><th scope="col">method</th>{"".join(heads)}<th scope="col">time</th></tr>'
    legend = f"↓ lower is better, ↑ higher is better; bold: best; &times; ratio to {BASELINE} (&plusmn; difference)"
    return (
        f'<div class="scroll"><table><thead>{head}</thead><tbody>{"".join(rows)}</tbody></table></div>'
        f'<p class="hint">{legend}</p>'
    )


def median(values: float | Sequence[float]) -> float:
    """The median over seeds; NaN if one of them is not finite, since that seed failed."""
    values = [values] if isinstance(values, int | float | np.number) else list(values)
    return statistics.median(values) if values and all(map(math.isfinite, values)) else math.nan


def _spread(values: float | Sequence[float]) -> str:
    """The lowest and the highest of several seeds."""
    if isinstance(values, int | float | np.number) or len(values) < 2:
        return ""
    return f'<small class="spread">{_number(min(values))} &hellip; {_number(max(values))}</small>'


def _overview(overview: Overview) -> str:
    """Plots, tables and formulas, each under its title."""
    parts = []
    for title, svg in overview.plots.items():
        # As a picture of its own, so that no script or link in it does anything.
        data = base64.b64encode(svg.encode()).decode()
        image = f'<img alt="{escape(title)}" src="data:image/svg+xml;base64,{data}">'
        parts.append(f'<figure class="plot">{image}<figcaption><b>{escape(title)}</b></figcaption></figure>')
    plots = '<h3>Plots</h3><div class="plots">' + "".join(parts) + "</div>" if parts else ""
    tables = "".join(f"<h3>{escape(title)}</h3>{_plain_table(rows)}" for title, rows in overview.tables.items())
    formulas = "".join(f"<dt>{escape(key)}</dt><dd>{escape(text)}</dd>" for key, text in overview.formulas.items())
    formulas = f'<h3>Metrics</h3><dl class="formulas">{formulas}</dl>' if formulas else ""
    body = tables + plots + formulas
    return f'<details id="overview" open><summary>Overview</summary>{body}</details>' if body else ""


def _plain_table(rows: list[list[str]]) -> str:
    head, *body = [[escape(cell) for cell in row] for row in rows]
    lines = [f'<tr><th scope="row">{row[0]}</th>' + "".join(f"<td>{c}</td>" for c in row[1:]) + "</tr>" for row in body]
    heads = "".join(f'<th scope="col">{cell}</th>' for cell in head)
    return f'<div class="scroll"><table><thead><tr>{heads}</tr></thead><tbody>{"".join(lines)}</tbody></table></div>'


def _best(scene: Scene, metric: str) -> int | None:
    """The index of the entry with the best finite value, or None."""
    values = [(median(entry.metrics.get(metric, math.nan)), row) for row, entry in enumerate(scene.entries)]
    values = [(-value if metric in scene.rising else value, row) for value, row in values if math.isfinite(value)]
    return min(values)[1] if values else None


def _compared(value: float, baseline: float, rising: bool) -> str:
    if not (math.isfinite(value) and math.isfinite(baseline)):
        return ""
    if rising:  # decibels and similarities have no meaningful ratio
        return f"{value - baseline:+.2f}"
    return f"&times;{value / baseline:.2g}" if baseline > 0.0 else ""


def _number(value: float) -> str:
    return f"{value:.4g}" if math.isfinite(value) else NOTHING
