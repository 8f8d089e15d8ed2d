"""Where gradients pay, as SVG: a map of each scene in blocks, at equal time, and W/C over the samples."""

from pathlib import Path
from typing import Any

import numpy as np

from ngpt.evaluation.frontier import COLORS, DASHES
from ngpt.evaluation.gradientmap import COLOURS
from ngpt.image.display import coloured
from ngpt.io.exr import read_image
from ngpt.measure.metrics import relative_squared_error
from ngpt.report.axes import Axes
from ngpt.system.text import markup
from ngpt.system.writing import write_text

RANGE = 3.0  # powers of two at either end of the colours
BLOCK = 8  # pixels, at least
_ACROSS = 40  # blocks, at most
_WIDTH = 240  # of a panel


def block_size(width: int) -> int:
    """The edge of a block, in pixels, of pictures of that width."""
    return max(BLOCK, -(-width // _ACROSS))


def block_errors(image: np.ndarray, *halves: np.ndarray, block: int) -> np.ndarray:
    """Sums of relative squared errors over blocks, (rows, columns); blocks at the right and below may be smaller.

    With two halves of a reference they are free of its noise, and may be negative.
    """
    errors = relative_squared_error(image.astype(np.float64), *halves).mean(axis=-1)
    errors = np.nan_to_num(errors, posinf=0.0, neginf=0.0)
    for axis in (0, 1):
        errors = np.add.reduceat(errors, np.arange(0, errors.shape[axis], block), axis=axis)
    return errors


def log_ratio(ours: np.ndarray, theirs: np.ndarray) -> np.ndarray:
    """log2 of the error without gradients, ``theirs``, over the error with them: above 0 gradients pay.

    An error that is not positive is too small for the reference to tell: of one of the two the ratio is infinite, of
    both unknown (NaN).
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.log2(np.maximum(theirs, 0.0)) - np.log2(np.maximum(ours, 0.0))


def share_that_pays(ratio: np.ndarray) -> float | None:
    """The share of blocks where gradients pay, among blocks whose ratio is known; None if there are none."""
    known = ratio[~np.isnan(ratio)]
    return float(np.mean(known > 0)) if known.size else None


def write_map(results: dict[str, Any], scene: str, out: Path) -> dict[str, Any] | None:
    """Draws the map of a scene from the pictures of the first seed; its path relative to ``out``, and shares of blocks.

    At each number of samples the best pipeline with gradients is held against the best without, which has had the same
    rendering time. None where no pictures were kept, or one of the two kinds is missing.
    """
    entry = results["scenes"][scene]
    reference = entry["reference"]
    files = reference["images of halves"] or [file for file in (reference["image"],) if file]
    if not files:
        return None
    halves = [read_image(out / file) for file in files]
    images = {(c["spp"], c["method"]): c["image"] for c in results["cells"] if c["scene"] == scene and not c["seed"]}
    panels, shares = [], {}
    for spp in results["settings"]["spp"]:
        rows = [row for row in results["summary"] if (row["scene"], row["spp"]) == (scene, spp)]
        rows = sorted((row for row in rows if row["error"] is not None), key=lambda row: row["error"])
        with_gradients = [results["methods"][row["method"]]["stack"] == "gradients" for row in rows]
        if len(set(with_gradients)) < 2:
            continue
        ours, theirs = (rows[with_gradients.index(kind)]["method"] for kind in (True, False))
        pair = [read_image(out / images[spp, name]) for name in (ours, theirs)]
        block = block_size(pair[0].shape[1])
        ratio = log_ratio(*(block_errors(image, *halves, block=block) for image in pair))
        shares[str(spp)] = share_that_pays(ratio)
        panels.append((f"{spp} spp: {ours}, {theirs}", ratio))
    if not panels:
        return None
    path = f"plots/worth-{scene}.svg"
    write_text(
        out / path, draw_map(panels, f"{scene}: error without gradients over error with them, at equal rendering time")
    )
    return {"map": path, "blocks": shares}


def draw_map(panels: list[tuple[str, np.ndarray]], title: str) -> str:
    """An SVG of one panel for each (label, ratio): blue where gradients pay, orange where they hurt."""
    rows, columns = panels[0][1].shape
    edge = _WIDTH / columns
    width, height = (_WIDTH + 12) * len(panels), 30 + rows * edge + 62
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {height:.0f}" font-family="sans-serif" '
        'font-size="12">',
        f'<rect width="{width:.0f}" height="{height:.0f}" fill="white"/>',
        f'<text x="6" y="18" font-size="14">{markup(title)}</text>',
    ]
    for i, (label, ratio) in enumerate(panels):
        left = 6 + i * (_WIDTH + 12)
        for (y, x), colour in zip(np.ndindex(rows, columns), _hex(ratio.ravel()), strict=True):
            place = f'x="{left + x * edge:.2f}" y="{30 + y * edge:.2f}" width="{edge:.2f}" height="{edge:.2f}"'
            parts.append(f'<rect {place} fill="{colour}" shape-rendering="crispEdges"/>')
        parts.append(f'<text x="{left}" y="{30 + rows * edge + 15:.1f}">{markup(label)}</text>')
    return "\n".join([*parts, *_legend(30 + rows * edge + 26), "</svg>"]) + "\n"


def _legend(top: float) -> list[str]:
    """Colours and the ratios they stand for."""
    parts = []
    powers = np.arange(-RANGE, RANGE + 1)
    for i, (power, colour) in enumerate(zip(powers, _hex(powers), strict=True)):
        text = f"{2**power:g}" if power >= 0 else f"1/{2**-power:g}"
        parts.append(f'<rect x="{6 + 34 * i}" y="{top:.1f}" width="34" height="12" fill="{colour}"/>')
        parts.append(f'<text x="{23 + 34 * i}" y="{top + 25:.1f}" text-anchor="middle" font-size="10">{text}</text>')
    return parts


def _hex(ratios: np.ndarray) -> list[str]:
    values = (np.clip(ratios, -RANGE, RANGE) + RANGE) / (2 * RANGE)
    return [f"#{r:02x}{g:02x}{b:02x}" for r, g, b in coloured(values[None], COLOURS)[0]]


def draw_worth(worth: dict[str, Any]) -> str:
    """W/C of the best pipelines over the samples with gradients, a line for each scene; gradients pay above 1."""
    rows = [row for row in worth["rows"] if row["best"] and row["W/C"]]
    x, y = [row["spp"] for row in rows], [row["W/C"] for row in rows]
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    margin = max(160, 40 + 7 * max(map(len, scenes)))
    axes = Axes(
        (min(x) / 1.15, max(x) * 1.15), (min(*y, 0.5) / 1.2, max(*y, 1.5) * 1.2), width=520 + margin, margin=margin
    )
    parts = axes.frame("samples per pixel with gradients", "W/C", "worth of gradients over their cost")
    parts.append(axes.level(1.0, "#000000", "gradients pay above"))
    looks = {s: (COLORS[i % len(COLORS)], DASHES[i // len(COLORS) % len(DASHES)]) for i, s in enumerate(scenes)}
    for scene, (color, dash) in looks.items():
        own = [row for row in rows if row["scene"] == scene]
        path = "L".join(f"{axes.x(row['spp']):.1f} {axes.y(row['W/C']):.1f}" for row in own)
        dashes = f' stroke-dasharray="{dash}"' if dash else ""
        parts.append(f'<path d="M{path}" fill="none" stroke="{color}" stroke-width="1.6"{dashes}/>')
        for row in own:
            name = markup(f"{scene}, {row['spp']} spp: {row['mark']}{row['W/C']:.2f}, {row['method']}, {row['rival']}")
            place = f'cx="{axes.x(row["spp"]):.1f}" cy="{axes.y(row["W/C"]):.1f}"'
            # Hollow where W is not between measured samples.
            fill = "white" if row["mark"] else color
            parts.append(f'<circle {place} r="3" fill="{fill}" stroke="{color}"><title>{name}</title></circle>')
    parts += axes.legend([(scene, *look) for scene, look in looks.items()])
    return "\n".join([*parts, "</svg>"]) + "\n"
