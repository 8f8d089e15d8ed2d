"""Writes the tables of the main evaluation into the pages that quote it.

    python eval.py --config configs/eval-main.toml --out out/eval --scenes ...
    python eval.py --config configs/eval-640.toml --out out/eval-640 --scenes ...
    python -m bench.pages out/eval out/eval-640

stores the numbers of the tables in bench/results/main.json, and writes each table between its marks in a page: README,
docs/lab/RESULTS.md, docs/methods/methods.md, docs/samplers/points.md and the model cards. Plots are written to
docs/images. The numbers of a folder replace stored numbers of the same image size. Without folders, the tables are
written from the stored numbers.
"""

import argparse
import json
import math
from collections import Counter
from collections.abc import Iterable
from itertools import product
from pathlib import Path
from typing import Any

from bench.common import save, write_page
from bench.curves import over_least
from bench.frontier import draw, points_against
from bench.tables import RIVALS
from bench.wholetime import against_rivals, groups_of, ratio
from bench.worth import worth_of_gradients
from ngpt.measure.averages import geometric_mean
from ngpt.system.writing import markdown_table

ROOT = Path(__file__).parents[1]
RESULT = ROOT / "bench" / "results" / "main.json"
IMAGES = ROOT / "docs" / "images"
OURS = ("ngpt-combine", "ngpt-primal", "ngpt-fast")
# Columns with shared tails, the default of `ngpt render`, and their names in tables. All other columns are unbiased.
SHARED = {"ngpt-primal-shared": "`ngpt-primal`, shared tails", "oidn-shared": "`oidn-clean`, shared tails"}
COMPARED = ("l1", "wcv", "ngpt-fast", "ngpt-combine", "ngpt-primal")
# The groups of scenes that have plots.
DRAWN = ("blind", "all")
# Scenes on which a constant of points or lamps was chosen.
TUNED = ("diffuse", "glossy", "coffee", "living-room", "staircase")
# The least ratio to OIDN's error at which a scene is listed as a loss.
LOSS = 1.1
VALUES = ("error", "FLIP")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folders", type=Path, nargs="*", help="results of evaluations; default: stored numbers")
    args = parser.parse_args()
    if args.folders:
        before = json.loads(RESULT.read_text()).get("sizes", []) if RESULT.is_file() else []
        sizes = {tuple(size["size"]): size for size in before}
        for folder in args.folders:
            results = json.loads((folder / "results.json").read_text())
            size = kept(results)
            sizes[tuple(size["size"])] = size
            measured = [name for name, entry in results["scenes"].items() if not entry["absent"]]
            groups = groups_of(results, measured)
            for group in Size(size).drawn():
                title = f"{group}: geometric mean over {len(groups[group])} scenes"
                plot = draw(points_against(results, groups[group]), title, results["primary"])
                (IMAGES / picture(size, group)).write_text(plot)
        save(RESULT, {"benchmark": "main", "sizes": [sizes[size] for size in sorted(sizes)]})
    for (page, name), text in blocks(json.loads(RESULT.read_text())).items():
        write_page(ROOT / page, text, marks(name))


def marks(name: str) -> tuple[str, str]:
    return f"<!-- python -m bench.pages: {name} -->", f"<!-- {name} ends -->"


def picture(size: dict[str, Any], group: str) -> str:
    return f"frontier-{group}-{size['size'][0]}x{size['size'][1]}.svg"


def kept(results: dict[str, Any]) -> dict[str, Any]:
    """The numbers of an evaluation for the tables: medians over seeds, ratios at equal time, worth of gradients."""
    facts = {name: results[name] for name in ("command", "date", "metadata")}
    settings = {name: results["settings"][name] for name in ("size", "spp", "groups", "against")}
    cells = [
        {name: row[name] for name in ("scene", "spp", "method", "error", "seconds")}
        | {"FLIP": row["metrics"].get("FLIP", {}).get("median")}
        for row in results["summary"]
        if row["scene"]
    ]
    # Gradients are compared with unbiased rivals only.
    unbiased = [row for row in results["summary"] if row["method"] not in SHARED]
    tables = {"against": against_rivals(results), "worth": worth_of_gradients(results | {"summary": unbiased})}
    settings["rivals"] = settings.pop("against")
    return facts | settings | {"cells": cells} | tables


def blocks(result: dict[str, Any]) -> dict[tuple[str, str], str]:
    """(page, name of the marks) -> the text between these marks, in Markdown."""
    sizes = [Size(kept) for kept in result["sizes"]]
    card = "docs/methods/ngpt-{}.md".format
    results, readme = "docs/lab/RESULTS.md", "README.md"
    made = {
        (results, "blind"): of_groups(sizes, "blind"),
        (results, "groups"): of_groups(sizes, *(g for g in sizes[0].groups if g not in ("blind", "all"))),
        (results, "frontier"): "\n\n".join(frontier(size, group) for size in sizes for group in size.drawn()),
        (results, "settings"): settings(sizes[-1]),
        (results, "scenes"): by_scene(sizes[-1]),
        (results, "worth"): worth(sizes),
        (results, "worth by scene"): "\n\n".join(map(worth_by_scene, sizes)),
        (readme, "errors"): of_groups(sizes, "blind", methods=("ngpt-primal-shared", "ngpt-combine", "ngpt-primal")),
        ("docs/methods/methods.md", "errors"): by_method(sizes),
        ("docs/samplers/points.md", "better"): better(sizes),
        (card("combine"), "over primal"): over_primal(sizes),
    }
    for name in ("combine", "primal"):
        made[card(name), "losses"] = losses(sizes[0], f"ngpt-{name}")
    return made


class Size:
    """The numbers of an evaluation at one image size, by place."""

    def __init__(self, kept: dict[str, Any]):
        self.kept = kept
        self.name = "{}x{}".format(*kept["size"])
        self.counts: list[int] = kept["spp"]
        self.rivals = {name: text for name, text in RIVALS.items() if name in kept["rivals"]}
        keys = ("spp", "method", "rival")
        self.rows = {(row["scene"], *(row[k] for k in keys)): row for row in kept["against"]["rows"]}
        self.means = {(row["group"], *(row[k] for k in keys)): row for row in kept["against"]["means"]}
        self.cells = {(cell["scene"], cell["spp"], cell["method"]): cell for cell in kept["cells"]}
        self.scenes = list(dict.fromkeys(scene for scene, *_ in self.rows))
        found = {group for group, *_ in self.means}
        self.groups = [name for name in (*kept["groups"], "all") if name in found]
        if "blind" in self.groups and self.members("blind") == self.scenes:
            self.groups.remove("all")  # It would be the same group.

    def members(self, group: str) -> list[str]:
        return [scene for scene in self.scenes if group == "all" or scene in self.kept["groups"][group]]

    def both(self, row: dict[str, Any] | None) -> str:
        """Error and FLIP over a rival's, as text."""
        return ", ".join(filter(None, (ratio(row, "error"), ratio(row, "FLIP"))))

    def won(self, group: str, method: str, rival: str, key: str = "") -> str:
        """In how many cells, over all numbers of samples, a method has less error (or ``key``) than the rival."""
        rows = [row for n in self.counts if (row := self.means.get((group, n, method, rival)))]
        return f"{sum(row[f'less{key}'] for row in rows)} of {sum(row[f'scenes{key}'] for row in rows)}"

    def heads(self) -> list[str]:
        return [f"{n} spp" for n in self.counts]

    def drawn(self) -> list[str]:
        return [group for group in DRAWN if group in self.groups]


def table(heads: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    return "\n".join(markdown_table(list(heads), rows))


def of_groups(sizes: list[Size], *groups: str, methods: tuple[str, ...] = (*SHARED, *OURS)) -> str:
    """Error and FLIP over both rivals', for each group and size, and the number of cells in which they are less."""
    tables = []
    for size in sizes:
        rows = []
        for group, method, (rival, text) in product(groups, methods, size.rivals.items()):
            found = [size.means.get((group, n, method, rival)) for n in size.counts]
            if group in size.groups and any(found):
                won = ", ".join(size.won(group, method, rival, key) for key in ("", " FLIP"))
                scenes = max(row["scenes"] for row in found if row)
                first = f"{group} ({scenes}): {SHARED.get(method, f'`{method}`')}"
                rows.append([first, text, *map(size.both, found), won])
        if rows:
            heads = [f"{size.name}: error, FLIP", "over", *size.heads(), "less error, FLIP"]
            tables.append(table(heads, rows))
    return "\n\n".join(tables) or "Not measured yet."


def frontier(size: Size, group: str) -> str:
    what = f"{group}, {len(size.members(group))} scenes, {size.name}"
    return f"![Error against whole seconds: {what}](../images/{picture(size.kept, group)})"


def settings(size: Size) -> str:
    """In how many cells of `ngpt-combine` each setting of a rival has the least error at its time."""
    chosen = Counter((rival, row["setting"], n) for (_, n, m, rival), row in size.rows.items() if m == OURS[0])
    columns = [(rival, column) for rival, columns in size.kept["rivals"].items() for column in columns]
    found = {(rival, column): [chosen[rival, column, n] for n in size.counts] for rival, column in columns}
    rows = ([f"`{column}`", *map(str, counts)] for (_, column), counts in found.items() if any(counts))
    return table([f"{size.name}: best setting", *size.heads()], rows)


def by_scene(size: Size) -> str:
    """Error and FLIP over both rivals' in each scene, and the whole seconds of ``OURS[0]``."""
    rows = []
    for scene, n in product(size.scenes, size.counts):
        cells = [size.both(size.rows.get((scene, n, m, rival))) for m in OURS for rival in size.rivals]
        cell = size.cells.get((scene, n, OURS[0]))
        seconds = f"{cell['seconds']['total']:.3g}" if cell else ""
        rows.append([scene if n == size.counts[0] else "", str(n), seconds, *cells])
    heads = [f"`{method}` over {text}" for method in OURS for text in size.rivals.values()]
    return table([f"{size.name}: scene", "spp", "seconds", *heads], rows)


def worth(sizes: list[Size]) -> str:
    """C and W/C of the best pipelines with gradients, for each group and size."""
    counts, rows = sorted({n for size in sizes for n in size.counts}), []
    for size in sizes:
        found = {(row["group"], row["spp"]): row for row in size.kept["worth"]["means"] if row["method"] is None}
        for group in (group for group in dict.fromkeys(group for group, _ in found) if group in size.groups):
            first = next(row for (name, _), row in found.items() if name == group)
            cells = [ratio(first, "C"), *(ratio(found.get((group, n)), "W/C") for n in counts)]
            rows.append([f"{group} ({first['scenes']}), {size.name}", *cells])
    return table(["W / C, geometric means", "C", *(f"{n} spp" for n in counts)], rows)


def worth_by_scene(size: Size) -> str:
    found = {(row["scene"], row["spp"]): row for row in size.kept["worth"]["rows"] if row["best"]}
    first = {scene: row for (scene, _), row in reversed(found.items())}
    rows = [
        [scene, ratio(first[scene], "C"), *(ratio(found.get((scene, n)), "W/C") for n in size.counts)]
        for scene in dict.fromkeys(scene for scene, _ in found)
    ]
    return table([f"{size.name}: scene", "C", *(f"W / C at {n} spp" for n in size.counts)], rows)


def by_method(sizes: list[Size]) -> str:
    """The table of methods: each error divided by OIDN's on Mitsuba's samples, and the seconds of a reconstruction.

    Errors are geometric means over all scenes.
    """
    size, rows = sizes[0], []
    for method in COMPARED:
        cells = [ratio(size.means.get((size.groups[-1], n, method, "mitsuba")), "error") for n in size.counts]
        for s in sizes:
            of = (c for (_, n, m), c in s.cells.items() if (n, m) == (s.counts[0], method))
            cells.append(mean(cell["seconds"]["reconstruct"] for cell in of))
        rows.append([f"`{method}`", *cells])
    return table([f"{size.name}: method", *size.heads(), *(f"seconds, {s.name}" for s in sizes)], rows)


def mean(values: Iterable[float]) -> str:
    found = list(values)
    return f"{geometric_mean(found):.2f}" if found else ""


def better(sizes: list[Size]) -> str:
    """OIDN on our samples over OIDN on Mitsuba's, both at their best settings: means (worst scene)."""
    size, rows = sizes[0], []
    for group, scenes in {"all": size.scenes, "apart": [s for s in size.scenes if s not in TUNED]}.items():
        cells = []
        for n in size.counts:
            of = [[size.rows.get((s, n, c, "mitsuba")) for c in size.kept["rivals"]["oidn"]] for s in scenes]
            error, flips = ([min(r[v] for r in each if r and r[v]) for each in of if any(each)] for v in VALUES)
            cells.append(f"{mean(error)} ({max(error):.2f}), FLIP {mean(flips)}" if error and flips else "")
        if scenes:
            rows.append([f"{group} ({len(scenes)})", *cells])
    return table([f"{size.name}: new over old", *size.heads()], rows)


def over_primal(sizes: list[Size]) -> str:
    """The error of ngpt-combine over the error of ngpt-primal after the same whole time."""
    size = sizes[0]
    ratios: dict[tuple[str, int], float] = {}
    known = {place: cell for place, cell in size.cells.items() if (cell["error"] or 0) > 0}
    for (scene, n, method), mine in known.items():
        curve = [cell for (s, _, m), cell in known.items() if (s, m) == (scene, "ngpt-primal")]
        points = [(cell["seconds"]["total"], cell["error"]) for cell in curve]
        if method == "ngpt-combine" and (found := over_least(mine["error"], mine["seconds"]["total"], [points])):
            ratios[scene, n] = found[0]
    rows = []
    for group in size.groups:
        scenes = size.members(group)
        cells = (mean(ratios[scene, n] for scene in scenes if (scene, n) in ratios) for n in size.counts)
        rows.append([f"{group} ({len(scenes)})", *cells])
    return table(["error of `ngpt-combine` over `ngpt-primal`", *size.heads()], rows)


def losses(size: Size, method: str) -> str:
    """The scenes in which a method has more than ``LOSS`` times OIDN's error in a cell, the worst first."""
    found = {scene: [size.rows.get((scene, n, method, "oidn")) for n in size.counts] for scene in size.scenes}
    worst = {scene: max((row["error"] for row in rows if row), default=-math.inf) for scene, rows in found.items()}
    lost = sorted((scene for scene in found if worst[scene] > LOSS), key=lambda scene: -worst[scene])
    return table(["scene", *size.heads()], ([scene, *(ratio(row, "error") for row in found[scene])] for scene in lost))


if __name__ == "__main__":
    main()
