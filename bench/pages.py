"""Writes the tables of the main evaluation into the pages that quote it.

    python eval.py --config configs/eval-main.toml --out out/eval ...
    python -m bench.pages out/eval

keeps what the tables are made of in bench/results/main.json, and puts each table between its marks: in the README,
docs/lab/RESULTS.md, docs/methods/methods.md, docs/samplers/points.md and the model cards. Without a folder it writes
them anew from that file.
"""

import argparse
import json
from pathlib import Path

import numpy as np

from bench.common import save, write_page
from bench.tables import RIVALS, cells_of, heading
from ngpt.evaluation.worth import worth_of_gradients, worth_tables

ROOT = Path(__file__).parents[1]
RESULT = ROOT / "bench" / "results" / "main.json"
# What the shipped networks knew of each scene. docs/train/training.md and the model cards say how.
GROUPS = {
    "blind": ("classroom",),
    "rooms": ("living-room", "dining-room", "bedroom"),
    "watched": ("lamp", "staircase", "glass-of-water"),
    "other views": ("diffuse", "glossy", "environment", "lens", "cornell-box", "coffee", "veach-mis"),
}
COMPARED = ("l1", "wcv", "ngpt-fast", "ngpt-combine", "ngpt-primal", "nfor", "oidn", "mitsuba")
PAIRS = (
    *((method, rival) for rival in RIVALS for method in ("ngpt-combine", "ngpt-primal", "ngpt-fast")),
    ("ngpt-combine", "ngpt-primal"),
    ("oidn", "mitsuba"),
)
# Better samples and those of before, by columns that differ in nothing else
BETTER = {
    "`ngpt-combine`": ("ngpt-combine", "ngpt-combine-before"),
    "`ngpt-fast`": ("ngpt-fast", "ngpt-fast-before"),
    "`wcv`": ("wcv", "wcv-before"),
    "OIDN": ("oidn", "mitsuba"),
    "`ngpt-primal`": ("ngpt-primal", "ngpt-primal-before"),
}
EVERYONE = tuple(scene for scenes in GROUPS.values() for scene in scenes)
# Among which gradients are judged by scenes that no network was trained on
KNOWN = {
    "all but classroom": tuple(scene for scene in EVERYONE if scene != "classroom"),
    "rooms, watched": GROUPS["rooms"] + GROUPS["watched"],
    "other views": GROUPS["other views"],
}
# No constant of points or lamps was chosen by looking at them
APART = tuple(s for s in EVERYONE if s not in ("diffuse", "glossy", "coffee", "living-room", "staircase"))
LISTED = ("l1", "wcv", "ngpt-fast", "ngpt-combine", "ngpt-primal", "oidn", "mitsuba")
# Ratios over OIDN from which a loss is listed by name
LOSS = 1.1


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, nargs="?", help="of the evaluation; default: the tables of before")
    args = parser.parse_args()
    if args.folder:
        save(RESULT, kept(json.loads((args.folder / "results.json").read_text())))
    for (page, name), text in blocks(json.loads(RESULT.read_text())).items():
        write_page(ROOT / page, text, marks(name))


def marks(name: str) -> tuple[str, str]:
    return f"<!-- python -m bench.pages: {name} -->", f"<!-- {name} ends -->"


def kept(results: dict) -> dict:
    """Of an evaluation what the tables need: medians over seeds, and what gradients are worth."""
    results["settings"]["groups"] = KNOWN
    before = {name for pair in BETTER.values() for name in pair[1:]}
    now = results | {key: [row for row in results[key] if row["method"] not in before] for key in ("summary", "cells")}
    table = worth_tables(now | {"worth": worth_of_gradients(now)})
    facts = {name: results[name] for name in ("command", "date", "metadata")}
    return {"benchmark": "main", **facts, "cells": cells_of(results), "worth": list(table.values())}


def blocks(result: dict) -> dict[tuple[str, str], str]:
    """(page, name of its marks) -> Markdown."""
    table = Cells(result["cells"])
    card = "docs/methods/ngpt-{}.md".format
    made = {
        ("docs/lab/RESULTS.md", "groups"): by_group(table),
        ("docs/lab/RESULTS.md", "eye"): eye(table),
        ("docs/lab/RESULTS.md", "worth"): worth_by_group(result["worth"][0]),
        ("docs/lab/RESULTS.md", "worth by scene"): worth_by_scene(result["worth"][1]),
        ("README.md", "errors"): errors_of_readme(table),
        ("README.md", "cells"): cells_of_readme(table),
        ("README.md", "worth"): worth_by_group(result["worth"][0], ("all but classroom", "rooms, watched")),
        ("docs/methods/methods.md", "errors"): errors_by_method(table),
        ("docs/samplers/points.md", "better"): better(table),
        (card("combine"), "over primal"): over_primal(table),
        (card("combine"), "losses"): losses(table, "ngpt-combine"),
        (card("primal"), "losses"): losses(table, "ngpt-primal"),
    }
    for name in ("fast", "combine", "primal"):
        made[card(name), "results"] = over_rivals(table, f"ngpt-{name}")
    return made


class Cells:
    """Medians of the evaluation, and means and counts over scenes."""

    def __init__(self, rows: list[dict]):
        self.rows = {(row["scene"], row["spp"], row["method"]): row for row in rows}
        self.counts = sorted({spp for _, spp, _ in self.rows})

    def values(self, key: str) -> dict[tuple[str, int, str], float]:
        return {cell: row[key] for cell, row in self.rows.items()}

    def mean(self, scenes: tuple[str, ...], spp: int, method: str, key: str = "error") -> float:
        return float(np.exp(np.mean([np.log(self.rows[scene, spp, method][key]) for scene in scenes])))

    def over(self, scenes: tuple[str, ...], spp: int, method: str, rival: str, key: str = "error") -> float:
        return self.mean(scenes, spp, method, key) / self.mean(scenes, spp, rival, key)

    def below(self, scenes: tuple[str, ...], method: str, rival: str, key: str = "error", spp: int = 0) -> str:
        """In how many cells, by default at all numbers of samples, one has less than the other: "4 of 12"."""
        counts = [spp] if spp else self.counts
        pairs = [(self.rows[s, n, method][key], self.rows[s, n, rival][key]) for s in scenes for n in counts]
        return f"{sum(a < b for a, b in pairs)} of {len(pairs)}"


def by_group(table: Cells) -> str:
    """Mean errors of each group of scenes, and in how many cells one method has less error than another."""
    groups = {**GROUPS, "all": EVERYONE}
    lines = heading("scenes", "spp", *(f"`{method}`" for method in COMPARED))
    for name, scenes in groups.items():
        for spp in table.counts:
            means = [table.mean(scenes, spp, method) for method in COMPARED]
            texts = [f"**{value:.4f}**" if value == min(means) else f"{value:.4f}" for value in means]
            first = f"{name} ({len(scenes)})" if spp == table.counts[0] else ""
            lines.append(f"| {first} | {spp} | {' | '.join(texts)} |")
    between = "In how many cells one has less error than the other:"
    lines += ["", between, "", *heading("cells", *(f"{name} ({len(scenes)})" for name, scenes in groups.items()))]
    for method, rival in PAIRS:
        won = [table.below(scenes, method, rival) for scenes in groups.values()]
        lines.append(f"| `{method}` than `{rival}` | {' | '.join(won)} |")
    return "\n".join(lines)


def over_rivals(table: Cells, method: str) -> str:
    """Of a model card: errors and FLIP over those of both rivals for each group of scenes."""
    spp = ", ".join(map(str, table.counts))
    heads = [(f"less error than {name}", f"error over its at {spp} spp", "FLIP") for name in RIVALS.values()]
    lines = heading("scenes", *(text for head in heads for text in head))
    for name, scenes in {**GROUPS, "all": EVERYONE}.items():
        cells = []
        for rival in RIVALS:
            cells.append(table.below(scenes, method, rival))
            for key in ("error", "FLIP"):
                cells.append(", ".join(f"{table.over(scenes, n, method, rival, key):.2f}" for n in table.counts))
        shown = f"{name}: {', '.join(scenes)}" if name != "all" else f"all {len(scenes)}"
        lines.append(f"| {shown} | {' | '.join(cells)} |")
    return "\n".join(lines)


def eye(table: Cells) -> str:
    """By FLIP: in how many scenes a network has less than each rival, and the mean ratio."""
    lines = heading("FLIP, all scenes", *(f"{n} spp" for n in table.counts), "all cells")
    for method, rival in PAIRS[: 3 * len(RIVALS)]:
        won = [table.below(EVERYONE, method, rival, "FLIP", n) for n in (*table.counts, 0)]
        ratios = [f", {table.over(EVERYONE, n, method, rival, 'FLIP'):.2f}" for n in table.counts]
        cells = [f"{count}{ratio}" for count, ratio in zip(won, [*ratios, ""], strict=True)]
        lines.append(f"| `{method}` less than {RIVALS[rival]}, and mean over its | {' | '.join(cells)} |")
    return "\n".join(lines)


def better(table: Cells) -> str:
    """Better samples over those of before: error and FLIP, all scenes and those apart; the worst scene in brackets."""
    groups = {f"all {len(EVERYONE)} scenes": EVERYONE, f"the {len(APART)} apart": APART}
    lines = heading("new over old", "", *(f"{n} spp" for n in table.counts))
    for name, (now, before) in BETTER.items():
        for group, scenes in groups.items():
            cells = []
            for n in table.counts:
                worst = max(table.over((scene,), n, now, before) for scene in scenes)
                error, flip = (table.over(scenes, n, now, before, key) for key in ("error", "FLIP"))
                cells.append(f"{error:.2f} ({worst:.2f}), FLIP {flip:.2f}")
            lines.append(f"| {name} | {group} | {' | '.join(cells)} |")
            name = ""
    return "\n".join(lines)


def over_primal(table: Cells) -> str:
    lines = heading("error of `ngpt-combine` over `ngpt-primal`", *(f"{n} spp" for n in table.counts))
    for name, scenes in {**GROUPS, "all": EVERYONE}.items():
        ratios = [f"{table.over(scenes, n, 'ngpt-combine', 'ngpt-primal'):.2f}" for n in table.counts]
        lines.append(f"| {name} ({len(scenes)}) | {' | '.join(ratios)} |")
    return "\n".join(lines)


def losses(table: Cells, method: str) -> str:
    """The scenes in which it has more than ``LOSS`` times OIDN's error somewhere, the worst first."""
    lines = heading("scene", *(f"{n} spp" for n in table.counts))
    found = {scene: [table.over((scene,), n, method, "oidn") for n in table.counts] for scene in EVERYONE}
    for scene, ratios in sorted(found.items(), key=lambda item: -max(item[1])):
        if max(ratios) > LOSS:
            lines.append(f"| {scene} | {' | '.join(f'{ratio:.2f}' for ratio in ratios)} |")
    return "\n".join(lines)


def errors_by_method(table: Cells) -> str:
    lines = heading("method", "relMSE at 4 spp", *(str(n) for n in table.counts[1:]), "seconds")
    for method in LISTED:
        means = [f"{table.mean(EVERYONE, n, method):.4f}" for n in table.counts]
        seconds = table.mean(EVERYONE, table.counts[0], method, "seconds")
        lines.append(f"| `{method}` | {' | '.join(means)} | {seconds:.2f} |")
    return "\n".join(lines)


def errors_of_readme(table: Cells) -> str:
    methods = {
        "mitsuba": RIVALS["mitsuba"],
        "oidn": RIVALS["oidn"],
        "ngpt-combine": "`ngpt-combine`",
        "ngpt-fast": "`ngpt-fast`",
    }
    firsts = {"classroom, blind: ": GROUPS["blind"], "all 14 scenes: ": EVERYONE}
    heads = [f"{first if name == 'mitsuba' else ''}{text}" for first in firsts for name, text in methods.items()]
    lines = heading("spp of gradients", *heads)
    for n in table.counts:
        cells = []
        for scenes in firsts.values():
            means = [table.mean(scenes, n, method) for method in methods]
            cells += [f"**{value:.4f}**" if value == min(means) else f"{value:.4f}" for value in means]
        lines.append(f"| {n} | {' | '.join(cells)} |")
    return "\n".join(lines)


def cells_of_readme(table: Cells) -> str:
    told = {
        "ngpt-combine": "uses OIDN and gradients",
        "ngpt-primal": "uses OIDN, no gradients",
        "ngpt-fast": "uses gradients, no OIDN",
    }
    groups = {"classroom": GROUPS["blind"], "three other rooms": GROUPS["rooms"], "all scenes": EVERYONE}
    lines = heading("network", "less than", *(f"error: {name}" for name in groups), "FLIP: all scenes")
    for method, what in told.items():
        for rival, text in RIVALS.items():
            won = [table.below(scenes, method, rival) for scenes in groups.values()]
            won.append(table.below(EVERYONE, method, rival, "FLIP"))
            lines.append(f"| `{method}` ({what}) | {text} | {' | '.join(won)} |")
    return "\n".join(lines)


def worth_by_group(rows: list[list[str]], only: tuple[str, ...] = ()) -> str:
    """W/C of the best pipelines, a line for each group; ``rows`` are those of ``worth_tables``."""
    place = {name: i for i, name in enumerate(rows[0])}
    found: dict[str, dict[str, list[str]]] = {}
    for row in rows[1:]:
        found.setdefault(row[place["scenes"]], {})[row[place["spp"]]] = row
    counts = list(next(iter(found.values())))
    lines = heading("W / C, geometric means", "C", *(f"{n} spp" for n in counts))
    for group, by_spp in found.items():
        if not only or group.rpartition(" (")[0] in only:
            cells = [by_spp[counts[0]][place["C"]], *(by_spp[n][place["W/C"]] for n in counts)]
            lines.append(f"| {group} | {' | '.join(cells)} |")
    return "\n".join(lines)


def worth_by_scene(rows: list[list[str]]) -> str:
    place = {name: i for i, name in enumerate(rows[0])}
    found: dict[str, dict[str, list[str]]] = {}
    for row in rows[1:]:
        found.setdefault(row[place["scene"]], {})[row[place["spp"]]] = row
    counts = list(next(iter(found.values())))
    lines = heading("scene", "C", *(f"W / C at {n} spp" for n in counts))
    for scene, by_spp in found.items():
        cells = [by_spp[counts[0]][place["C"]], *(by_spp[n][place["W/C"]] if n in by_spp else "" for n in counts)]
        lines.append(f"| {scene} | {' | '.join(cells)} |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
