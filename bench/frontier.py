"""Speed against accuracy as a picture: error over total seconds, both axes logarithmic."""

import io
from dataclasses import dataclass
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure

from bench.wholetime import envelope
from ngpt.measure.averages import geometric_mean

# The dash patterns that tell the samplers of one method apart.
DASHES = ("-", "--", ":", "-.", (0, (8, 3)), (0, (1, 4)))
# Text stays text, and the same points give the same file.
LOOK = {"svg.fonttype": "none", "svg.hashsalt": "ngpt"}


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
    """An SVG: a line for each method over its sample counts, rings for the Pareto set, and a grey line through it."""
    families: dict[str, dict[str, None]] = {}
    for p in points:
        families.setdefault(p.family or p.method, {})[p.method] = None
    best = sorted((p for p, is_best in zip(points, pareto(points), strict=True) if is_best), key=lambda p: p.seconds)
    with mpl.rc_context(LOOK):
        figure = Figure(figsize=(9, 5.5), layout="constrained")
        axes = figure.subplots()
        axes.loglog([p.seconds for p in best], [p.error for p in best], color="0.85", linewidth=7)
        for i, methods in enumerate(families.values()):
            for method, dash in zip(methods, DASHES * len(methods), strict=False):
                own = sorted((p for p in points if p.method == method), key=lambda p: (p.spp, p.seconds))
                look = {"color": f"C{i % 10}", "linestyle": dash, "label": method, "gid": f"line {method}"}
                axes.plot([p.seconds for p in own], [p.error for p in own], **look)
                counted = [p for p in own if p.spp]
                edges = ["black" if p in best else "none" for p in counted]
                where = [p.seconds for p in counted], [p.error for p in counted]
                axes.scatter(*where, color=f"C{i % 10}", edgecolors=edges, zorder=3)
        axes.set(xlabel="seconds, rendering and reconstruction", ylabel=metric, title=title)
        axes.grid(which="both", alpha=0.3)
        axes.legend(loc="center left", bbox_to_anchor=(1, 0.5), title="rings: Pareto set")
        text = io.StringIO()
        figure.savefig(text, format="svg", metadata={"Date": None})
    return text.getvalue()
