"""Makes the markup of a page: figures with their names, tables of metrics, and the overview."""

import base64
import math
from collections.abc import Mapping, Sequence

import numpy as np

from ngpt.image import display
from ngpt.image.png import encode_palette_png, encode_png
from ngpt.report.content import Overview, ReportEntry, Scene, median
from ngpt.system.text import markup

THUMBNAIL_WIDTH = 240
NOTHING = "&ndash;"


def section(number: int, scene: Scene, stops: float) -> str:
    """The markup of one scene without its pixels; ``stops`` is the exposure of its thumbnails."""
    first, pictures = next(iter(scene.entries[0].metrics), ""), []
    entries = {entry.name: entry for entry in scene.entries}
    measured = any(entry.metrics or entry.seconds is not None for entry in scene.entries)
    for name, image in scene.pictures:
        entry = entries.get(name) or ReportEntry(name, image)  # the reference
        note = (
            f"<small>{markup(first)} {_number(median(entry.metrics[first]))}</small>" if first in entry.metrics else ""
        )
        thumbnail = display.thumbnail(display.to_srgb8(image, stops), THUMBNAIL_WIDTH)
        pictures.append(_figure(name, thumbnail, note, entry.maps))
    # Layers are shown in full size, because the page has no other copy of them.
    layers = [_figure(name, display.layer_view(name, layer)) for name, layer in scene.layers.items()]
    parts = [
        f'<section class="scene" id="scene-{number}">',
        f"<h2>{markup(scene.name)}</h2>",
        f'<p class="caption">{markup(scene.caption)}</p>',
        '<div class="slot"></div>',
        '<h3>Pictures</h3><div class="thumbs">' + "".join(pictures) + "</div>",
        "<h3>Measurements</h3>" + _table(scene) if measured else "",
        '<h3>Input layers</h3><div class="thumbs">' + "".join(layers) + "</div>" if layers else "",
        "</section>",
    ]
    return "\n".join(part for part in parts if part)


def _figure(name: str, picture: np.ndarray, note: str = "", maps: Mapping[str, np.ndarray] = {}) -> str:
    """The markup of a picture (H, W, 3) uint8 with its name, a note, and hidden maps (H, W) by their names."""
    height, width = picture.shape[:2]
    source = "data:image/png;base64," + base64.b64encode(encode_png(picture)).decode()
    hidden = "".join(f'<img hidden alt="" data-map="{markup(key)}" src="{_map(m)}">' for key, m in maps.items())
    small = ' class="pixelated"' if width <= THUMBNAIL_WIDTH // 2 else ""
    return (
        f'<figure data-name="{markup(name)}"><div class="frame">'
        f'<img{small} width="{width}" height="{height}" alt="{markup(name)}" src="{source}">{hidden}'
        f"</div><figcaption><b>{markup(name)}</b>{note}</figcaption></figure>"
    )


def _map(values: np.ndarray) -> str:
    """The address of a picture of a map (H, W) in the colours of the heat table; NaN has the colour of 1."""
    places = np.rint(255 * np.clip(np.nan_to_num(values, nan=1.0), 0.0, 1.0)).astype(np.uint8)
    return "data:image/png;base64," + base64.b64encode(encode_palette_png(places, display.heat_table())).decode()


def _table(scene: Scene) -> str:
    """A table with a row for each entry, and a column for each metric and for the seconds.

    The best value of a metric is bold. Small numbers compare each entry with the baseline.
    """
    metrics = list(dict.fromkeys(metric for entry in scene.entries for metric in entry.metrics))
    best = {metric: scene.best(metric) for metric in metrics}
    baseline = scene.baseline
    timed = any(entry.seconds is not None for entry in scene.entries)
    arrows = {metric: "↑" if metric in scene.rising else "↓" for metric in metrics}
    heads = [f'<th scope="col">{markup(name)} <i>{arrow}</i><small></small></th>' for name, arrow in arrows.items()]
    rows = []
    for row, entry in enumerate(scene.entries):
        cells = []
        for metric in metrics:
            values = entry.metrics.get(metric, math.nan)
            value, primal = median(values), median(baseline.metrics.get(metric, math.nan))
            compared = "" if entry is baseline else _compared(value, primal, metric in scene.rising)
            mark = ' class="best"' if best[metric] == row else ""
            cells.append(f"<td{mark}><span>{_number(value)}</span>{_spread(values)}<small>{compared}</small></td>")
        seconds = NOTHING if entry.seconds is None else f"{entry.seconds:.3g} s"
        cells += [f"<td><span>{seconds}</span></td>"] if timed else []
        rows.append(f'<tr><th scope="row">{markup(entry.name)}</th>{"".join(cells)}</tr>')
    heads += ['<th scope="col">time</th>'] if timed else []
    head = f'<tr><th scope="col">picture</th>{"".join(heads)}</tr>'
    comparison = f"&times; ratio to {markup(baseline.name)} (&plusmn; difference)"
    legend = f"↓ lower is better, ↑ higher is better; bold: best; {comparison}"
    return _scrolled(head, rows) + f'<p class="hint">{legend}</p>'


def _scrolled(head: str, rows: list[str]) -> str:
    """A table that scrolls sideways, from the markup of its rows."""
    return f'<div class="scroll"><table><thead>{head}</thead><tbody>{"".join(rows)}</tbody></table></div>'


def _spread(values: float | Sequence[float]) -> str:
    """The markup of the lowest and the highest of several values; "" for one value."""
    if isinstance(values, int | float | np.number) or len(values) < 2:
        return ""
    return f'<small class="spread">{_number(min(values))} &hellip; {_number(max(values))}</small>'


def overview_html(overview: Overview) -> str:
    """The markup of the overview: tables and formulas, each under its title."""
    tables = "".join(f"<h3>{markup(title)}</h3>{plain_table(rows)}" for title, rows in overview.tables.items())
    formulas = "".join(f"<dt>{markup(key)}</dt><dd>{markup(text)}</dd>" for key, text in overview.formulas.items())
    formulas = f'<h3>Metrics</h3><dl class="formulas">{formulas}</dl>' if formulas else ""
    body = tables + formulas
    return f'<details id="overview" open><summary>Overview</summary>{body}</details>' if body else ""


def plots_html(plots: Mapping[str, str]) -> str:
    """The markup of SVG documents with their titles, side by side if there is room."""
    parts = []
    for title, svg in plots.items():
        # In an image, scripts and links of the SVG do nothing.
        data = base64.b64encode(svg.encode()).decode()
        image = f'<img alt="{markup(title)}" src="data:image/svg+xml;base64,{data}">'
        parts.append(f'<figure class="plot">{image}<figcaption><b>{markup(title)}</b></figcaption></figure>')
    return '<div class="plots">' + "".join(parts) + "</div>"


def plain_table(rows: list[list[str]]) -> str:
    """The markup of a table from rows of text; the first row is the header."""
    head, *body = [[markup(cell) for cell in row] for row in rows]
    lines = [f'<tr><th scope="row">{row[0]}</th>' + "".join(f"<td>{c}</td>" for c in row[1:]) + "</tr>" for row in body]
    heads = "".join(f'<th scope="col">{cell}</th>' for cell in head)
    return _scrolled(f"<tr>{heads}</tr>", lines)


def _compared(value: float, baseline: float, rising: bool) -> str:
    """The ratio of two errors, or the difference of two values if higher is better; "" if they are not finite."""
    if not (math.isfinite(value) and math.isfinite(baseline)):
        return ""
    if rising:  # decibels and similarities have no meaningful ratio
        return f"{value - baseline:+.2f}"
    return f"&times;{value / baseline:.2g}" if baseline > 0.0 else ""


def _number(value: float) -> str:
    return f"{value:.4g}" if math.isfinite(value) else NOTHING
