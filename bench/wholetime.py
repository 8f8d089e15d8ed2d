"""Ratios of a method's error to a rival's error after the same whole time (render and reconstruction).

A rival is a group of columns, which are settings of one denoiser on the samples of one renderer (``against`` in the
configuration). Each setting has a curve of errors over whole seconds (``bench.curves``). At each time the rival has the
least error of all its settings, and separately the least FLIP, as if its user knew the best setting. A setting does not
count before the time of its quickest cell, unless no setting has so quick a cell.
"""

import math
from collections.abc import Iterable, Iterator
from itertools import product
from typing import Any

from bench.curves import Points, error_at, joined
from ngpt.measure.averages import geometric_mean

FLIP = "FLIP"
# The number of points of an envelope in a plot.
_STEPS = 17


def against_rivals(results: dict[str, Any]) -> dict[str, Any]:
    """``rows`` for each scene, number of samples, column and rival, and their geometric ``means`` over scenes.

    A row has these entries, apart from its place:

    ``seconds``  the whole time of the column
    ``error``    the primary metric over the rival's after this time, with ``mark``; ``setting`` is the rival's column
    ``FLIP``     the same for FLIP, with ``FLIP mark``; None if it is not known

    The settings of a rival have no rows for this rival. Values that are missing, not positive or without a time have no
    rows. Means are over each group of scenes and over all. ``less`` and ``less FLIP`` count the scenes where the column
    is better, of ``scenes`` and ``scenes FLIP``.
    """
    rows = []
    counts, rivals = results["settings"]["spp"], results["settings"]["against"]
    for scene in results["scenes"]:
        here = _timed(results, scene)
        curves = {name: _curves(results, here, name) for name in rivals}
        for row, (rival, columns) in product(here, rivals.items()):
            counted = row["spp"] in counts and (row["error"] or 0) > 0 and row["method"] not in columns
            if counted and (found := _over(row, results["primary"], curves[rival])):
                place = {name: row[name] for name in ("scene", "spp", "method")}
                rows.append(place | {"seconds": row["seconds"]["total"], "rival": rival} | found)
    keys = {"spp": counts, "method": results["methods"], "rival": rivals}
    return {"rows": rows, "means": [entry | _mean(here) for entry, here in grouped(results, rows, **keys)]}


def _timed(results: dict[str, Any], scene: str) -> list[dict[str, Any]]:
    """The rows of a scene whose whole time is known."""
    return [row for row in results["summary"] if row["scene"] == scene and row["seconds"]["total"]]


def _curves(results: dict[str, Any], rows: list[dict[str, Any]], rival: str) -> dict[str, dict[str, Points]]:
    """Metric -> setting of the rival -> points (seconds, error), of the rows of one scene."""
    found: dict[str, dict[str, Any]] = {}
    for row in rows:
        if row["method"] in results["settings"]["against"][rival]:
            for metric in dict.fromkeys((results["primary"], FLIP)):
                if value := _value(row, metric):
                    points = found.setdefault(metric, {}).setdefault(row["method"], [])
                    points.append((row["seconds"]["total"], value))
    return found


def _value(row: dict[str, Any], metric: str) -> float | None:
    value = row["metrics"].get(metric, {}).get("median")
    return value if value is not None and value > 0 else None


def _least(seconds: float, settings: dict[str, Points]) -> tuple[float, str, str] | None:
    """The least error of all settings at a time, its mark and its setting; None without any."""
    found = [(*answer, name) for name, points in settings.items() if (answer := error_at(seconds, points))]
    begun = [answer for answer in found if min(settings[answer[2]])[0] <= seconds]
    return min(begun or found, default=None)


def _over(row: dict[str, Any], primary: str, curves: dict[str, dict[str, Points]]) -> dict[str, Any] | None:
    """The entries of a row that compare it with a rival; None if the rival has no error."""
    least = _least(row["seconds"]["total"], curves.get(primary, {}))
    if least is None:
        return None
    error, mark, setting = least
    entry = {"setting": setting, "error": row["error"] / error, "mark": mark, "FLIP": None, "FLIP mark": ""}
    flip, mine = _least(row["seconds"]["total"], curves.get(FLIP, {})), _value(row, FLIP)
    return entry | ({"FLIP": mine / flip[0], "FLIP mark": flip[1]} if flip and mine else {})


def _mean(rows: list[dict[str, Any]]) -> dict[str, Any]:
    seen = [row for row in rows if row["FLIP"] is not None]
    return {
        "scenes": len(rows),
        "seconds": geometric_mean(row["seconds"] for row in rows),
        "error": geometric_mean(row["error"] for row in rows),
        "mark": joined(row["mark"] for row in rows),
        "less": sum(row["error"] < 1 for row in rows),
        "scenes FLIP": len(seen),
        "FLIP": geometric_mean(row["FLIP"] for row in seen) if seen else None,
        "FLIP mark": joined(row["FLIP mark"] for row in seen),
        "less FLIP": sum(row["FLIP"] < 1 for row in seen),
    }


def envelope(results: dict[str, Any], rival: str, scenes: list[str]) -> list[tuple[float, float]]:
    """The curve of a rival as points (seconds, error), from its quickest to its slowest cell.

    A point is a geometric mean over the scenes. In each scene it lies at the same fraction between these two cells, on
    a logarithmic axis. A rival that was not measured on all scenes has no points.
    """
    parts = []
    for scene in scenes:
        settings = _curves(results, _timed(results, scene), rival).get(results["primary"], {})
        times = [math.log(seconds) for points in settings.values() for seconds, _ in points]
        if not times:
            # A mean over the other scenes could not be compared with other curves.
            return []
        at = [math.exp(min(times) + i / (_STEPS - 1) * (max(times) - min(times))) for i in range(_STEPS)]
        parts.append([(seconds, _least(seconds, settings)) for seconds in at])
    if not parts or any(least is None for part in parts for _, least in part):
        return []
    return [
        (geometric_mean(seconds for seconds, _ in column), geometric_mean(least[0] for _, least in column if least))
        for column in zip(*parts, strict=True)
    ]


def against_tables(results: dict[str, Any]) -> dict[str, list[list[str]]]:
    """Title -> rows of text, the header first: means of groups, then each scene. Settings of rivals have no rows."""
    tables: dict[str, list[list[str]]] = {}
    rivals = results["settings"]["against"]
    settings = {column for columns in rivals.values() for column in columns}
    ratios = against_rivals(results)
    for kind, first, how in (("means", "group", "geometric means"), ("rows", "scene", "scene by scene")):
        by_place: dict[tuple, dict[str, dict[str, Any]]] = {}
        for row in ratios[kind]:
            if row["method"] not in settings:
                by_place.setdefault((row[first], row["spp"], row["method"]), {})[row["rival"]] = row
        heads = ["scenes" if kind == "means" else "scene", "spp", "method", "seconds"]
        heads += [f"{value} over {rival}" for rival in rivals for value in ("error", FLIP)]
        heads += [f"less {value} than {r}" for r in rivals for value in ("error", FLIP) if kind == "means"]
        lines = [heads]
        for (name, spp, method), by_rival in by_place.items():
            one, found = next(iter(by_rival.values())), [by_rival.get(rival) for rival in rivals]
            name = f"{name} ({one['scenes']})" if kind == "means" else name
            counts = [_count(row, key) for row in found for key in ("", " FLIP") if kind == "means"]
            cells = [ratio(row, key) for row in found for key in ("error", FLIP)]
            lines.append([name, str(spp), method, f"{one['seconds']:.3g}", *cells, *counts])
        if len(lines) > 1:
            tables[f"Errors divided by the errors of rivals at equal whole time, {how}"] = lines
    return tables


def ratio(row: dict[str, Any] | None, key: str) -> str:
    """The entry ``key`` of a row with its mark, as text; "" if there is none. C (``bench.worth``) has no mark."""
    if row is None or row[key] is None:
        return ""
    return f"{'' if key == 'C' else row.get(f'{key} mark', row['mark'])}{row[key]:.2f}"


def _count(row: dict[str, Any] | None, key: str) -> str:
    return f"{row[f'less{key}']} of {row[f'scenes{key}']}" if row else ""


def grouped(
    results: dict[str, Any], rows: list[dict[str, Any]], **keys: Iterable
) -> Iterator[tuple[dict[str, Any], list[dict[str, Any]]]]:
    """(place, rows) for each group of scenes and each combination of values of ``keys`` that has rows."""
    for group, members in groups_of(results, [row["scene"] for row in rows]).items():
        for values in product(*keys.values()):
            place = dict(zip(keys, values, strict=True))
            if here := [row for row in rows if row["scene"] in members and place.items() <= row.items()]:
                yield {"group": group} | place, here


def groups_of(results: dict[str, Any], scenes: Iterable[str]) -> dict[str, list[str]]:
    """Returns the ``scenes`` of each group. If there are several scenes, the group "all" holds all of them."""
    found = list(dict.fromkeys(scenes))
    groups = {name: [s for s in found if s in listed] for name, listed in results["settings"]["groups"].items()}
    return groups | ({"all": found} if len(found) > 1 else {})
