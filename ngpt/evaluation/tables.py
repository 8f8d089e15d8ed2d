"""The markdown of an evaluation: what a reader compares, the losses as visible as the wins."""

from __future__ import annotations

from typing import Any

import numpy as np


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
        "without; ~ is within three times of the reference's own noise, where an order means little.",
        "",
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
        lines += ["Means over scenes of the other metrics:", "", *_others(results, others), ""]
    for name in dict.fromkeys((primary, "FLIP")):
        lines += _duels(results, name)
    lines += _absences(results)
    facts = results["metadata"]
    versions = ", ".join(f"{name} {value}" for name, value in facts["versions"].items() if value)
    lines.append(
        f"By `{results['command']}` on {results['date']}, {facts['threads']} threads of {facts['cpu']}, "
        f"commit {facts['commit']}; {versions}."
    )
    return "\n".join(lines) + "\n"


def _present(results: dict[str, Any]) -> list[str]:
    return [name for name in results["methods"] if any(row["method"] == name for row in results["summary"])]


def _heads(results: dict[str, Any], methods: list[str]) -> list[str]:
    return [f"`{m}`" + ("" if results["methods"][m]["stack"] == "gradients" else "†") for m in methods]


def _table(heads: list[str], rows: list[list[str]], left: int) -> list[str]:
    rule = "|---" * left + "|--:" * (len(heads) - left) + "|"
    return [f"| {' | '.join(heads)} |", rule, *(f"| {' | '.join(row)} |" for row in rows)]


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
            noise = results["scenes"][scene]["reference"]["noise"] if scene else None
            texts = [_error(results, m, found, errors, noise) for m in methods]
            label = scene or "*geometric mean*"
            rows.append([label, str(spp), *texts, f"{noise:.5f}" if noise is not None else ""])
    return _table(["scene", "spp", *_heads(results, methods), "reference noise"], rows, 1)


def _error(results: dict[str, Any], method: str, found: dict, errors: dict[str, float], noise: float | None) -> str:
    if method not in errors:
        return ""
    error, stacks = errors[method], results["methods"]
    text = f"{error:.4f}" if error >= 0.001 else f"{error:.2g}"
    spread = found[method]["metrics"][results["primary"]]
    half = (spread["high"] - spread["low"]) / 2 / error if error else 0.0
    if half > 0.05:
        text += f" ±{half:.0%}"
    if noise is not None and error < 3 * noise:
        text += " ~"
    if error == min(errors.values()):
        return f"**{text}**"
    rivals = [e for m, e in errors.items() if stacks[m]["stack"] != "gradients"]
    lost = stacks[method]["stack"] == "gradients" and rivals and min(rivals) < error
    return f"*{text}*" if lost else text


def _costs(results: dict[str, Any]) -> list[str]:
    rows = []
    for name, entry in results["scenes"].items():
        cost = entry.get("cost") or {}
        if cost:
            gradients = cost["gradients"]["median"]
            ratios = [f"{gradients / cost[kind]['median']:.2f}" for kind in ("path", "features")]
            quartiles = f"{cost['gradients']['low'] * 1e3:.1f} .. {cost['gradients']['high'] * 1e3:.1f}"
            reference = entry.get("reference") or {}
            spp = reference.get("spp")
            rows.append([name, f"{gradients * 1e3:.1f}", quartiles, *ratios, f"{spp:.0f}" if spp else ""])
    if not rows:
        return []
    heads = ["scene", "ms / spp with gradients", "quartiles", "over path", "over path with features", "reference spp"]
    return ["What a sample with gradients costs:", "", *_table(heads, rows, 1)]


def _seconds(results: dict[str, Any]) -> list[str]:
    methods, rows = _present(results), []
    values = {(row["spp"], row["method"]): row["seconds"] for row in results["summary"] if row["scene"] is None}
    for spp in results["settings"]["spp"]:
        found = [values.get((spp, m)) for m in methods]
        rows.append(
            [str(spp), *(f"{s['reconstruct']:.2f}" if s and s["reconstruct"] is not None else "" for s in found)]
        )
    return _table(["spp", *_heads(results, methods)], rows, 0)


def _others(results: dict[str, Any], names: list[str]) -> list[str]:
    methods, rows = _present(results), []
    means = {(row["spp"], row["method"]): row["metrics"] for row in results["summary"] if row["scene"] is None}
    for name in names:
        for spp in results["settings"]["spp"]:
            values = [means.get((spp, m), {}).get(name, {}).get("median", np.nan) for m in methods]
            if np.isnan(values).all():
                continue
            best = np.nanmin(values) if results["metrics"][name]["better"] == "lower" else np.nanmax(values)
            texts = ["" if np.isnan(v) else f"**{v:.4g}**" if v == best else f"{v:.4g}" for v in values]
            rows.append([name, str(spp), *texts])
    return _table(["metric", "spp", *_heads(results, methods)], rows, 1)


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
    return [text, "", *_table(["", *_heads(results, methods)], rows, 1), ""]


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
    return ["Absent:", "", *(f"- {', '.join(whats)}: {why}" for why, whats in reasons.items()), ""]
