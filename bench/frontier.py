"""Plots error over whole seconds, on logarithmic axes."""

import io
from dataclasses import dataclass
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure

from bench.wholetime import envelope
from ngpt.measure.averages import geometric_mean

# Text is written as text, and the same points give the same file.
LOOK = {"svg.fonttype": "none", "svg.hashsalt": "ngpt"}


@dataclass(frozen=True)
class Point:
    """A method at one number of samples: whole seconds and error, both positive.

    ``spp`` is 0 for a point between numbers of samples, as on the curve of a rival.
    """

    method: str
    spp: int
    seconds: float
    error: float


def pareto(points: list[Point]) -> list[bool]:
    """For each point, whether it is Pareto optimal: no other is as fast and as good, and faster or better."""
    return [
        not any(
            (o.seconds <= p.seconds and o.error <= p.error) and (o.seconds < p.seconds or o.error < p.error)
            for o in points
        )
        for p in points
    ]


def points_against(results: dict[str, Any], scenes: list[str]) -> list[Point]:
    """Geometric means over the scenes: points of each rival's envelope, and of columns that are no rival's setting."""
    rivals = results["settings"]["against"]
    points = [Point(rival, 0, *place) for rival in rivals for place in envelope(results, rival, scenes)]
    settings = {column for columns in rivals.values() for column in columns}
    for method in (name for name in results["methods"] if name not in settings):
        for spp in results["settings"]["spp"]:
            rows = [r for r in results["summary"] if (r["spp"], r["method"]) == (spp, method) and r["scene"] in scenes]
            rows = [row for row in rows if (row["error"] or 0) > 0 and row["seconds"]["total"]]
            if scenes and len(rows) == len(scenes):
                seconds = geometric_mean(row["seconds"]["total"] for row in rows)
                points.append(Point(method, spp, seconds, geometric_mean(row["error"] for row in rows)))
    return points


def draw(points: list[Point], title: str, metric: str) -> str:
    """An SVG: a line for each method, and rings and a grey line for the Pareto set."""
    best = sorted((p for p, is_best in zip(points, pareto(points), strict=True) if is_best), key=lambda p: p.seconds)
    with mpl.rc_context(LOOK):
        figure = Figure(figsize=(9, 5.5), layout="constrained")
        axes = figure.subplots()
        axes.loglog([p.seconds for p in best], [p.error for p in best], color="0.85", linewidth=7)
        for i, method in enumerate(dict.fromkeys(p.method for p in points)):
            own = sorted((p for p in points if p.method == method), key=lambda p: (p.spp, p.seconds))
            look = {"color": f"C{i % 10}", "label": method, "gid": f"line {method}"}
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
