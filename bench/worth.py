"""The worth of gradients: the whole time without them over the whole time with them, for the same error.

    n, e    the samples and the error of a pipeline with gradients (a sampler and a method)
    T       its whole time: seconds to render and to reconstruct
    T', m   the whole time and the samples with which a pipeline without gradients first reaches the error e
    W / C   T' / T, for the pipeline without gradients of the least T'. Gradients pay if it is above 1
    W       m / n, for this pipeline
    C       the seconds of one more sample with gradients over the seconds of one more sample of this pipeline

T' and m are read from curves of errors. ``bench.curves`` explains the marks; W has the mark of W / C. The seconds of
one more sample come from the renders with the fewest and the most samples, so they exclude the start of a render.
"""

from collections.abc import Sequence
from typing import Any

from bench.curves import first_at, joined
from bench.wholetime import grouped, ratio
from ngpt.measure.averages import geometric_mean, median


def worth_of_gradients(results: dict[str, Any]) -> dict[str, Any]:
    """``rows`` for each scene, number of samples and column with gradients, and their ``means`` over scenes.

    ``best`` is true for the column with gradients that has the least error. Without columns of both kinds, there are no
    rows. A column without times has no rows: stacks of other renderers may lack them.
    """
    rows = [row for scene in results["scenes"] for row in _scene_rows(results, scene)]
    return {"rows": rows, "means": _means(results, rows)}


def _scene_rows(results: dict[str, Any], scene: str) -> list[dict[str, Any]]:
    found: dict[str, dict[int, dict[str, Any]]] = {}
    for row in results["summary"]:
        if row["scene"] == scene and (row["error"] or 0) > 0 and row["seconds"]["total"]:
            found.setdefault(row["method"], {})[row["spp"]] = row
    renders = {name: _renders(results, scene, name) for name in found}
    ours = [name for name in found if results["methods"][name]["stack"] == "gradients"]
    rivals = {name: list(rows.values()) for name, rows in found.items() if name not in ours}
    rows = []
    for spp in results["settings"]["spp"]:
        here = {name: found[name][spp] for name in ours if spp in found[name]}
        for name, row in here.items():
            if worth := _against(row, renders[name], rivals, renders):
                place = {"scene": scene, "spp": spp, "method": name, "sampler": results["methods"][name]["sampler"]}
                best = row["error"] == min(other["error"] for other in here.values())
                rows.append(place | {"best": best, "error": row["error"], "seconds": row["seconds"]["total"]} | worth)
    return rows


def _renders(results: dict[str, Any], scene: str, method: str) -> dict[int, tuple[int, float]]:
    """Nominal samples -> (samples that were rendered, median seconds of the renders)."""
    found: dict[int, list[dict[str, Any]]] = {}
    for cell in results["cells"]:
        if (cell["scene"], cell["method"]) == (scene, method) and not cell["absent"]:
            found.setdefault(cell["spp"], []).append(cell)
    return {
        spp: (cells[0]["spp used"], median(cell["seconds"]["render"] for cell in cells) or 0.0)
        for spp, cells in found.items()
    }


def _against(
    ours: dict[str, Any],
    renders: dict[int, tuple[int, float]],
    rivals: dict[str, list[dict[str, Any]]],
    of_all: dict[str, dict[int, tuple[int, float]]],
) -> dict[str, Any] | None:
    """The entries of a row: the rival that reaches the error of ``ours`` first, and W, C, W/C; None without a rival."""
    answers = []
    for name, rows in rivals.items():
        if answer := first_at(ours["error"], [(row["seconds"]["total"], row["error"]) for row in rows]):
            answers.append((*answer, name))
    if not answers:
        return None
    seconds, mark, rival = min(answers)
    points = [(of_all[rival][row["spp"]][0], row["error"]) for row in rivals[rival]]
    samples = first_at(ours["error"], points)
    W = samples[0] / renders[ours["spp"]][0] if samples else None
    costs = [_of_a_sample(list(rendered.values())) for rendered in (renders, of_all[rival])]
    C = costs[0] / costs[1] if costs[0] and costs[1] else None
    entry = {"rival": rival, "rival seconds": seconds, "rival samples": samples[0] if samples else None}
    return entry | {"W": W, "C": C, "W/C": seconds / ours["seconds"]["total"], "mark": mark}


def _of_a_sample(renders: Sequence[tuple[int, float]]) -> float:
    """Seconds of one more sample, from the renders (samples, seconds) with the fewest and the most samples."""
    (few, short), (many, long) = min(renders), max(renders)
    return (long - short) / (many - few) if many > few and long > short else long / many


def _means(results: dict[str, Any], rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Geometric means over each group of scenes: of each column, and, with the method None, of the best columns."""
    both = [*rows, *(row | {"method": None} for row in rows if row["best"])]
    means = []
    for entry, here in grouped(results, both, spp=results["settings"]["spp"], method=(None, *results["methods"])):
        entry["scenes"] = len(here)
        for key in ("W", "C", "W/C"):
            values = [row[key] for row in here]
            entry[key] = None if None in values else geometric_mean(values)
        means.append(entry | {"mark": joined(row["mark"] for row in here)})
    return means


def worth_tables(results: dict[str, Any]) -> dict[str, list[list[str]]]:
    """Title -> rows of text, the header first: means over groups, then each scene."""
    worth, keys = worth_of_gradients(results), ("W", "C", "W/C")
    columns = [name for name in results["methods"] if any(row["method"] == name for row in worth["rows"])]
    heads = [*keys, *(f"W/C {name}" for name in columns)]
    means = {(row["group"], row["spp"], row["method"]): row for row in worth["means"]}
    rows = {(row["scene"], row["spp"], row["method"]): row for row in worth["rows"]}

    def cells(best: dict[str, Any], of: dict[tuple, dict[str, Any]], name: str) -> list[str]:
        others = [ratio(of.get((best[name], best["spp"], column)), "W/C") for column in columns]
        return [*(ratio(best, key) for key in keys), *others]

    by_group = [["scenes", "spp", *heads]]
    for best in (row for row in worth["means"] if row["method"] is None):
        by_group.append([f"{best['group']} ({best['scenes']})", str(best["spp"]), *cells(best, means, "group")])
    by_scene = [["scene", "spp", "with gradients", "without", *heads]]
    for best in (row for row in worth["rows"] if row["best"]):
        by_scene.append([best["scene"], str(best["spp"]), best["method"], best["rival"], *cells(best, rows, "scene")])
    tables = {
        "Worth of gradients, geometric means; best pipelines, then each column with gradients": by_group,
        "Worth of gradients, scene by scene": by_scene,
    }
    return {title: lines for title, lines in tables.items() if len(lines) > 1}
