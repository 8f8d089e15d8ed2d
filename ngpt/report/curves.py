"""Curves over steps or hours as a small SVG picture."""

import math
from collections.abc import Mapping, Sequence

from ngpt.report.axes import Axes

COLORS = ("#2f7fd6", "#d9772b", "#3a9a5b", "#b0489a", "#7a6a3a", "#777777")
# The most points of a curve; if there are more, groups of neighbours are replaced by their mean.
MOST = 300

Curve = Sequence[tuple[float, float]]


def curves(across: str, lines: Mapping[str, Curve]) -> str:
    """An SVG of named curves of (x, y): x linear, y logarithmic. Points whose y is not above 0 are left out.

    Returns "" if there is nothing to draw.
    """
    drawn = {name: points for name, line in lines.items() if (points := _thinned(line))}
    if not drawn:
        return ""
    xs = [x for line in drawn.values() for x, _ in line]
    ys = [y for line in drawn.values() for _, y in line]
    low, high = min(0.0, *xs), max(xs) or 1.0
    margin = 24 + (7 * max(map(len, drawn)) + 34 if len(drawn) > 1 else 0)
    axes = Axes((low, high), (min(ys) / 1.15, max(ys) * 1.15), 560, 280, 64, min(margin, 240), even=True)
    parts = axes.frame(across, "", "")
    for color, line in zip(_colors(len(drawn)), drawn.values(), strict=True):
        path = "L".join(f"{axes.x(x):.1f} {axes.y(y):.1f}" for x, y in line)
        parts.append(f'<path d="M{path}" fill="none" stroke="{color}" stroke-width="2" stroke-linejoin="round"/>')
        # Without a dot, a line of a single point would be invisible.
        x, y = line[-1]
        parts.append(f'<circle cx="{axes.x(x):.1f}" cy="{axes.y(y):.1f}" r="3" fill="{color}"/>')
    if len(drawn) > 1:
        names = [name if len(name) <= 28 else f"...{name[-26:]}" for name in drawn]
        parts += axes.legend([(name, color, "") for name, color in zip(names, _colors(len(drawn)), strict=True)])
    return "\n".join([*parts, "</svg>"])


def _colors(count: int) -> list[str]:
    return [COLORS[i % len(COLORS)] for i in range(count)]


def _thinned(line: Curve) -> list[tuple[float, float]]:
    """At most ``MOST`` points, each the mean of a group of neighbours."""
    points = [(x, y) for x, y in line if math.isfinite(y) and y > 0]
    group = math.ceil(len(points) / MOST)
    parts = [points[i : i + group] for i in range(0, len(points), group)] if points else []
    return [(part[-1][0], sum(y for _, y in part) / len(part)) for part in parts]
