"""Speed against accuracy as a picture: error over total seconds, both axes logarithmic, by hand as SVG."""

from dataclasses import dataclass
from typing import Any

from bench.wholetime import envelope
from ngpt.measure.averages import geometric_mean
from ngpt.report.axes import Axes
from ngpt.system.text import markup

# The dash patterns that tell the samplers of one method apart.
DASHES = ("", "7 3", "2 3", "7 3 2 3", "12 4", "1 5")
COLORS = ("#777777", "#2f7fd6", "#d9772b", "#3a9a5b", "#b0489a", "#c9a400", "#17a2a8", "#8a5a2b", "#d62f45", "#5b4fd6")


@dataclass(frozen=True)
class Point:
    """A method at a sample count: total seconds and error, both positive; one colour for each ``family``.

    ``spp`` is 0 for a point of a curve that is no count of its own.
    """

    method: str
    spp: int
    seconds: float
    error: float
    family: str = ""


def pareto(points: list[Point]) -> list[bool]:
    """For each point, whether it is Pareto optimal: no other is as fast and as good, and better in one of the two."""
    return [
        not any(
            (o.seconds <= p.seconds and o.error <= p.error) and (o.seconds < p.seconds or o.error < p.error)
            for o in points
        )
        for p in points
    ]


def points_against(results: dict[str, Any], scenes: list[str]) -> list[Point]:
    """Geometric means over the scenes: columns other than settings of rivals, and each rival at its best setting."""
    rivals = results["settings"]["against"]
    points = [
        Point(rival, 0, seconds, error, rival)
        for rival in rivals
        for seconds, error in envelope(results, rival, scenes)
    ]
    settings = {column for columns in rivals.values() for column in columns}
    for method in (name for name in results["methods"] if name not in settings):
        for spp in results["settings"]["spp"]:
            rows = [r for r in results["summary"] if (r["spp"], r["method"]) == (spp, method) and r["scene"] in scenes]
            rows = [row for row in rows if (row["error"] or 0) > 0 and row["seconds"]["total"]]
            if scenes and len(rows) == len(scenes):
                seconds = geometric_mean(row["seconds"]["total"] for row in rows)
                points.append(Point(method, spp, seconds, geometric_mean(row["error"] for row in rows), method))
    return points


def draw(points: list[Point], title: str, metric: str) -> str:
    """An SVG: a line for each method over its sample counts, filled rings for the Pareto set, the line through it.

    Samplers of one method share its colour, and differ in dashes.
    """
    x = [p.seconds for p in points]
    y = [p.error for p in points]
    margin = max(160, 40 + 7 * max(len(p.method) for p in points))
    axes = Axes((min(x) / 1.15, max(x) * 1.15), (min(y) / 1.2, max(y) * 1.2), width=520 + margin, margin=margin)
    parts = axes.frame("seconds, rendering and reconstruction", metric, title)
    best = sorted((p for p, is_best in zip(points, pareto(points), strict=True) if is_best), key=lambda p: p.seconds)
    path = "L".join(f"{axes.x(p.seconds):.1f} {axes.y(p.error):.1f}" for p in best)
    parts.append(f'<path d="M{path}" fill="none" stroke="#000000" stroke-width="7" stroke-opacity="0.12"/>')
    looks = _looks(points)
    for method, (color, dash) in looks.items():
        own = sorted((p for p in points if p.method == method), key=lambda p: (p.spp, p.seconds))
        path = "L".join(f"{axes.x(p.seconds):.1f} {axes.y(p.error):.1f}" for p in own)
        dashes = f' stroke-dasharray="{dash}"' if dash else ""
        parts.append(f'<path d="M{path}" fill="none" stroke="{color}" stroke-width="1.6"{dashes}/>')
        for p in (p for p in own if p.spp):
            shape = f'cx="{axes.x(p.seconds):.1f}" cy="{axes.y(p.error):.1f}"'
            name = markup(f"{method}, {p.spp} spp: {p.seconds:.3g} s, {p.error:.3g}")
            look = f'r="4.5" fill="{color}" stroke="black"' if p in best else f'r="2.5" fill="{color}"'
            parts.append(f"<circle {shape} {look}><title>{name}</title></circle>")
    parts += axes.legend([(method, *look) for method, look in looks.items()])
    note = "rings: Pareto set"
    parts.append(f'<text x="{axes.right + 10}" y="{axes.bottom}" font-size="11" fill="#555555">{note}</text>')
    return "\n".join([*parts, "</svg>"]) + "\n"


def _looks(points: list[Point]) -> dict[str, tuple[str, str]]:
    """(colour, dashes) of each method: colours by family, dashes by its members and by the rounds of the colours."""
    families: dict[str, list[str]] = {}
    for name, family in dict.fromkeys((p.method, p.family or p.method) for p in points):
        families.setdefault(family, []).append(name)
    looks = {}
    for i, names in enumerate(families.values()):
        for j, name in enumerate(names):
            looks[name] = (COLORS[i % len(COLORS)], DASHES[(i // len(COLORS) + j) % len(DASHES)])
    # In the order of the points.
    return {name: looks[name] for name in dict.fromkeys(p.method for p in points)}
