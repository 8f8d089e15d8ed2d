"""The markdown of an evaluation: what a reader compares, the losses as visible as the wins."""

from typing import Any

import numpy as np

from ngpt.evaluation.curves import REACH
from ngpt.evaluation.renders import KINDS
from ngpt.measure.averages import mean
from ngpt.report.evaluation import several_samplers
from ngpt.system.writing import markdown_table

_MARKS = (
    "~: outside of the measured times, by the nearest slope. < and >: no nearer than a factor of "
    f"{REACH:g} outside, where the slope is not followed."
)


def tables(results: dict[str, Any]) -> str:
    """results.md: errors by scene, times, what is absent and why."""
    settings, primary = results["settings"], results["primary"]
    width, height = settings["size"]
    lines = [f"# {results['title']}", ""]
    lines += [
        f"Errors are {primary}: {results['metrics'][primary]['formula']}. {settings['seeds']} seeds a cell: the "
        "median, and half the distance of the quartiles as ± per cent where it is over 5 %. "
        f"{width}x{height} pixels. Methods with a † see no gradients and are given path-traced samples in their place, "
        "as many as the gradient stack's rendering time buys (measured for each scene; with albedo, normal and depth "
        "where they want them). **Bold** is best in its row; *italic* is a method with gradients that loses to one "
        f"without; ~ is {_doubtful(results)}, where an order means little.",
        "",
        *_samplers(results),
        *_halves(results),
        *_errors(results),
        "",
        *_costs(results),
        "",
        "Geometric means over scenes of seconds to reconstruct, after rendering:",
        "",
        *_seconds(results),
        "",
    ]
    others = [name for name in results["metrics"] if name != primary]
    if others and any(row["scene"] is None for row in results["summary"]):
        lines += [_title_of_others(results), "", *_others(results, others), ""]
    for name in dict.fromkeys((primary, "FLIP")):
        lines += _duels(results, name)
    lines += _against(results)
    lines += [*_absences(results), _origin(results)]
    return "\n".join(lines) + "\n"


def _against(results: dict[str, Any]) -> list[str]:
    """Errors divided by the errors of rivals at equal whole time."""
    found = results.get("against", {}).get("tables", {})
    if not found:
        return []
    families = [
        f"{name} ({', '.join(f'`{c}`' for c in columns)})" for name, columns in results["settings"]["against"].items()
    ]
    lines = [
        "At equal whole time (to render and to reconstruct) the rivals are "
        + "; ".join(families)
        + ": of these settings "
        f"each time the one of least error, and for FLIP the one of least FLIP. {_MARKS}",
        "",
    ]
    for title, rows in found.items():
        lines += [f"{title}:", "", *markdown_table(rows[0], rows[1:]), ""]
    return lines


def worth_page(results: dict[str, Any]) -> str:
    """worth.md: what gradients are worth over what they cost, and what the words mean."""
    lines = [
        f"# {results['title']}: worth of gradients",
        "",
        "W/C: the seconds that the best method without gradients needs for the error of a method with them, over the "
        "seconds of that method; both render and reconstruct. Gradients pay where W/C > 1. W: by how many times more "
        "samples it needs. C: seconds of a further sample with gradients over one without.",
        "",
        f"Errors are {results['primary']}, medians over seeds. The best of several methods is the one of least error "
        f"with gradients, and of least time for that error without. {_MARKS} blocks: the share of the picture's blocks "
        "with less error at equal rendering time (plots/worth-SCENE.svg). In means over scenes, the number of scenes "
        "is in brackets.",
        "",
    ]
    for title, rows in results["worth"]["tables"].items():
        lines += [f"{title}:", "", *markdown_table(rows[0], rows[1:]), ""]
    return "\n".join([*lines, _origin(results)]) + "\n"


def _origin(results: dict[str, Any]) -> str:
    facts = results["metadata"]
    versions = ", ".join(f"{name} {value}" for name, value in facts["versions"].items() if value)
    return (
        f"By `{results['command']}` on {results['date']}, {facts['threads']} threads of {facts['cpu']}, "
        f"commit {facts['commit']}; {versions}."
    )


def _doubtful(results: dict[str, Any]) -> str:
    """What ~ means: halves take a reference's noise off the errors, so that less of it is left to doubt."""
    one, two = "three times of the reference's own noise", "three standard errors of what the reference's noise leaves"
    halved = _halved(results)
    if not halved:
        return f"within {one}"
    alike = all(name in halved for name, entry in results["scenes"].items() if entry.get("reference"))
    return f"within {two}" if alike else f"within {two}, or where the reference is one image within {one}"


def _halved(results: dict[str, Any]) -> list[str]:
    references = {name: entry.get("reference") or {} for name, entry in results["scenes"].items()}
    return [name for name, reference in references.items() if reference.get("halves")]


def _halves(results: dict[str, Any]) -> list[str]:
    if not _halved(results):
        return []
    return [
        "The reference is rendered in two independent halves a, b. In metrics made of squares, (x - r)² stands for "
        "(x - a)(x - b), to which the reference's noise adds nothing on average; it may be negative where an error is "
        "too small to tell. Elsewhere r is the mean of the two.",
        "",
    ]


def _samplers(results: dict[str, Any]) -> list[str]:
    """Which sampler made the stacks of each method, if it is not always the usual one."""
    if not several_samplers(results):
        return []
    found: dict[str, list[str]] = {}
    for method in _present(results):
        found.setdefault(results["methods"][method]["sampler"], []).append(f"`{method}`")
    lines = [f"- by `{sampler}`: {', '.join(methods)}" for sampler, methods in found.items()]
    clock = f"All samplers have the time that a row's samples cost with `{results['settings']['clock']}`"
    return [f"{clock}, measured for each scene. The stacks are rendered", "", *lines, ""]


def _present(results: dict[str, Any]) -> list[str]:
    return [name for name in results["methods"] if any(row["method"] == name for row in results["summary"])]


def _heads(results: dict[str, Any], methods: list[str]) -> list[str]:
    return [f"`{m}`" + ("" if results["methods"][m]["stack"] == "gradients" else "†") for m in methods]


def _errors(results: dict[str, Any]) -> list[str]:
    methods = _present(results)
    cells = {(row["scene"], row["spp"], row["method"]): row for row in results["summary"]}
    scenes = [name for name in results["scenes"] if any(key[0] == name for key in cells)]
    rows = []
    for scene in [*scenes, None]:
        for spp in results["settings"]["spp"]:
            found = {m: cells[scene, spp, m] for m in methods if (scene, spp, m) in cells}
            errors = {m: row["error"] for m, row in found.items() if row["error"] is not None}
            if not errors:
                continue
            noise, doubt = (results["scenes"][scene]["reference"][k] if scene else None for k in ("noise", "doubt"))
            texts = [_error(results, m, found, errors, doubt) for m in methods]
            label = scene or "*geometric mean*"
            rows.append([label, str(spp), *texts, f"{noise:.5f}" if noise is not None else ""])
    return markdown_table(["scene", "spp", *_heads(results, methods), "reference noise"], rows)


def _error(results: dict[str, Any], method: str, found: dict, errors: dict[str, float], doubt: float | None) -> str:
    if method not in errors:
        return ""
    error, stacks = errors[method], results["methods"]
    text = f"{error:.4f}" if error >= 0.001 else f"{error:.2g}"
    spread = found[method]["metrics"][results["primary"]]
    half = (spread["high"] - spread["low"]) / 2 / error if error > 0 else 0.0
    if half > 0.05:
        text += f" ±{half:.0%}"
    if doubt is not None and error < doubt:
        text += " ~"
    if error == min(errors.values()):
        return f"**{text}**"
    rivals = [e for m, e in errors.items() if stacks[m]["stack"] != "gradients"]
    lost = stacks[method]["stack"] == "gradients" and rivals and min(rivals) < error
    return f"*{text}*" if lost else text


def _costs(results: dict[str, Any]) -> list[str]:
    costs = {name: entry["cost"] for name, entry in results["scenes"].items() if entry.get("cost")}
    if not costs:
        return []
    # More than the three that every scene is measured with: one column each, and which sampler the usual one is.
    others = list(dict.fromkeys(name for cost in costs.values() for name in cost if name not in KINDS))
    rows = []
    for scene, cost in costs.items():
        gradients = cost["gradients"]["median"]
        ratios = [gradients / cost[name]["median"] if name in cost else None for name in ("path", "features", *others)]
        quartiles = f"{cost['gradients']['low'] * 1e3:.1f} .. {cost['gradients']['high'] * 1e3:.1f}"
        spp = (results["scenes"][scene].get("reference") or {}).get("spp")
        row = [scene, f"{gradients * 1e3:.1f}", quartiles, *("" if r is None else f"{r:.2f}" for r in ratios)]
        rows.append([*row, f"{spp:.0f}" if spp else "", *([f"`{cost['gradients']['sampler']}`"] if others else [])])
    heads = ["scene", "ms / spp with gradients", "quartiles", "over path", "over path with features"]
    heads += [*(f"over {_over(name)}" for name in others), "reference spp", *(["by sampler"] if others else [])]
    return ["What a sample with gradients costs:", "", *markdown_table(heads, rows)]


def _over(render: str) -> str:
    """ "gradients gpt-basic" as a column's head: the sampler, and the kind where it is not the one with gradients."""
    kind, _, sampler = render.partition(" ")
    return f"`{sampler}`" + {"gradients": "", "features": " with features", "path": ""}[kind]


def _seconds(results: dict[str, Any]) -> list[str]:
    methods, rows = _present(results), []
    values = {(row["spp"], row["method"]): row["seconds"] for row in results["summary"] if row["scene"] is None}
    for spp in results["settings"]["spp"]:
        found = [values.get((spp, m)) for m in methods]
        rows.append(
            [str(spp), *(f"{s['reconstruct']:.2f}" if s and s["reconstruct"] is not None else "" for s in found)]
        )
    return markdown_table(["spp", *_heads(results, methods)], rows, 0)


def _others(results: dict[str, Any], names: list[str]) -> list[str]:
    methods, rows, floors = _present(results), [], _floors(results)
    means = {(row["spp"], row["method"]): row["metrics"] for row in results["summary"] if row["scene"] is None}
    for name in names:
        for spp in results["settings"]["spp"]:
            values = [means.get((spp, m), {}).get(name, {}).get("median", np.nan) for m in methods]
            if np.isnan(values).all():
                continue
            best = np.nanmin(values) if results["metrics"][name]["better"] == "lower" else np.nanmax(values)
            texts = ["" if np.isnan(v) else f"**{v:.4g}**" if v == best else f"{v:.4g}" for v in values]
            rows.append([name, str(spp), *texts, *([floors.get(name, "")] if floors else [])])
    heads = ["metric", "spp", *_heads(results, methods), *(["between halves"] if floors else [])]
    return markdown_table(heads, rows)


def _title_of_others(results: dict[str, Any]) -> str:
    title = "Means over scenes of the other metrics"
    if not _floors(results):
        return f"{title}:"
    return (
        f"{title}. Those not made of squares are measured against the mean of the reference's halves. What they are "
        "between the two halves, whose noise has four times the variance of the mean's, says how much of them may be "
        "the reference's noise:"
    )


def _floors(results: dict[str, Any]) -> dict[str, str]:
    """Metric -> its mean, over the scenes with two halves, between these: what no image can be judged better than."""
    found: dict[str, list[float]] = {}
    for scene in _halved(results):
        for name, value in results["scenes"][scene]["reference"]["floors"].items():
            if value is not None:
                found.setdefault(name, []).append(value)
    lower = {name: results["metrics"][name]["better"] == "lower" for name in found}
    return {name: f"{mean(values, geometric=lower[name]):.4g}" for name, values in found.items()}


def _duels(results: dict[str, Any], metric: str) -> list[str]:
    """How often each method is ahead of each other, in the cells that have both."""
    methods = _present(results)
    if metric not in results["metrics"] or len(methods) < 2:
        return []
    sign = 1 if results["metrics"][metric]["better"] == "lower" else -1
    cells: dict[tuple, dict[str, float]] = {}
    for row in results["summary"]:
        if row["scene"] is not None and metric in row["metrics"]:
            cells.setdefault((row["scene"], row["spp"]), {})[row["method"]] = sign * row["metrics"][metric]["median"]
    rows = []
    for m in methods:
        texts = []
        for other in methods:
            pairs = [(cell[m], cell[other]) for cell in cells.values() if m != other and {m, other} <= cell.keys()]
            texts.append(f"{sum(mine < theirs for mine, theirs in pairs)}/{len(pairs)}" if pairs else "")
        rows.append([f"`{m}`", *texts])
    text = f"In how many cells (a scene at a number of samples) the row's method has the better {metric} of the two:"
    return [text, "", *markdown_table(["", *_heads(results, methods)], rows), ""]


def _absences(results: dict[str, Any]) -> list[str]:
    """Each reason once, with what it concerns."""
    reasons: dict[str, list[str]] = {}
    for name, entry in results["scenes"].items():
        if entry.get("absent"):
            reasons.setdefault(entry["absent"], []).append(f"scene {name}")
    for kind in ("methods", "metrics"):
        for name, entry in results[kind].items():
            if entry.get("absent"):
                reasons.setdefault(entry["absent"], []).append(f"`{name}`")
    for cell in results["cells"]:
        if cell["absent"] and cell["absent"] not in reasons:
            reasons[cell["absent"]] = [f"`{cell['method']}` on {cell['scene']}, {cell['spp']} spp"]
    if not reasons:
        return []
    return ["Absent:", "", *(f"- {', '.join(names)}: {why}" for why, names in reasons.items()), ""]
