"""Tables of evaluations in the pages that quote them.

    python eval.py --config configs/eval-bidirectional.toml --out out/bidirectional --scenes 'scenes/*/scene.xml'
    python -m bench.tables bidirectional out/bidirectional   # keeps its numbers, puts the table into its page
    python -m bench.tables                                   # all tables again, from the numbers that are kept

Numbers are kept in bench/results/NAME.json: medians over seeds of the primary metric and of FLIP, cell by cell, and
the cost of a sample of each sampler. ``PAGES`` gives the page of each table, and its kind, one of three:

    by_scene   errors over the least error of the scene, which is bold; below, the least error itself, and the cost of a
               sample relative to `primal`
    means      geometric means over the scenes at each number of samples; the least is bold
    rivals     errors relative to OIDN on our samples and on Mitsuba's, means over all cells
"""

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from bench.common import save, write_page
from ngpt.measure.averages import geometric_mean

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "bench" / "results"


def by_scene(result: dict[str, Any]) -> str:
    cells = {(cell["scene"], cell["spp"], cell["method"]): cell["error"] for cell in result["cells"]}
    columns = list(dict.fromkeys((scene, spp) for scene, spp, _ in cells))
    methods = list(dict.fromkeys(method for *_, method in cells))
    several = len({spp for _, spp in columns}) > 1
    lines = heading(
        "method (sampler)", *(f"{scene}, {spp} spp" if several else scene for scene, spp in columns), "mean"
    )
    least = {column: min(e for (*place, _), e in cells.items() if tuple(place) == column) for column in columns}
    for method in methods:
        ratios = [cells[*column, method] / least[column] if (*column, method) in cells else None for column in columns]
        shown = ["" if r is None else "**1**" if r == 1 else short(r) for r in ratios]
        # A mean needs all scenes: means over different scenes could not be compared.
        shown.append("" if None in ratios else short(geometric_mean(ratios)))
        lines.append(f"| `{method}` | {' | '.join(shown)} |")
    lines.append(f"| *least error* | {' | '.join(f'{error:.2g}' for error in least.values())} | |")
    costs = result.get("costs", {})
    for sampler in dict.fromkeys(name for cost in costs.values() for name in cost):
        of = [costs.get(scene, {}) for scene, _ in columns]
        shown = [short(cost[sampler] / cost["primal"], 2) if sampler in cost else "" for cost in of]
        if sampler != "primal":
            lines.append(f"| *cost of `{sampler}`* | {' | '.join(shown)} | |")
    return "\n".join(lines)


def means(result: dict[str, Any]) -> str:
    methods = list(dict.fromkeys(cell["method"] for cell in result["cells"]))
    both = all("FLIP" in cell for cell in result["cells"])
    lines = heading("spp", *(f"`{method}`{', FLIP' if both else ''}" for method in methods))
    for spp in sorted({cell["spp"] for cell in result["cells"]}):
        texts = {method: [] for method in methods}
        for key in ("error", "FLIP") if both else ("error",):
            found = {
                m: geometric_mean([c[key] for c in result["cells"] if (c["spp"], c["method"]) == (spp, m)])
                for m in methods
            }
            for method, value in found.items():
                text = f"{value:.3f}" if key == "FLIP" else f"{value:.2g}"
                texts[method].append(f"**{text}**" if value == min(found.values()) else text)
        lines.append(f"| {spp} | {' | '.join(', '.join(text) for text in texts.values())} |")
    return "\n".join(lines)


# Columns of evaluations and their names in tables: OIDN on our own samples, and the usual alternative of a user
RIVALS = {"oidn": "OIDN", "mitsuba": "Mitsuba + OIDN"}


def rivals(result: dict[str, Any]) -> str:
    of = {(cell["scene"], cell["spp"], cell["method"]): cell for cell in result["cells"]}
    methods = [name for name in dict.fromkeys(method for *_, method in of) if name not in RIVALS]
    places = list(dict.fromkeys((scene, spp) for scene, spp, _ in of))
    lines = heading(f"{len(places)} cells", *(f"`{method}`" for method in methods))
    for rival, text in RIVALS.items():
        over = {
            (method, key): [of[*p, method][key] / of[*p, rival][key] for p in places if (*p, method) in of]
            for method in methods
            for key in ("error", "FLIP")
        }
        less = [f"{sum(r < 1 for r in over[m, 'error'])} of {len(over[m, 'error'])}" for m in methods]
        lines.append(f"| less error than {text} | {' | '.join(less)} |")
        for key in ("error", "FLIP"):
            lines.append(f"| {key} over its | {' | '.join(short(geometric_mean(over[m, key])) for m in methods)} |")
    return "\n".join(lines)


PAGES: dict[str, tuple[str, Callable[[dict[str, Any]], str]]] = {
    "media": ("docs/samplers/media.md", rivals),
    "bidirectional": ("docs/samplers/bidirectional.md", by_scene),
    "photons": ("docs/samplers/photons.md", by_scene),
    "photons-media": ("docs/samplers/photons.md", by_scene),
    "studies": ("docs/samplers/metropolis.md", by_scene),
    "kpcn": ("docs/methods/kpcn.md", means),
    "classical": ("docs/methods/classical.md", means),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", nargs="?", choices=PAGES)
    parser.add_argument("folder", type=Path, nargs="?", help="of the evaluation; default: the numbers of before")
    args = parser.parse_args()
    if args.folder:
        save(RESULTS / f"{args.name}.json", kept(json.loads((args.folder / "results.json").read_text())))
    for name in [args.name] if args.name else PAGES:
        write_page(ROOT / PAGES[name][0], table(name), marks(name))


def table(name: str) -> str:
    return PAGES[name][1](json.loads((RESULTS / f"{name}.json").read_text()))


def marks(name: str) -> tuple[str, str]:
    return f"<!-- python -m bench.tables {name} -->", f"<!-- {name} ends -->"


def kept(results: dict[str, Any]) -> dict[str, Any]:
    """The part of an evaluation's results.json that the tables use."""
    facts = {name: results[name] for name in ("title", "command", "date", "metadata", "settings")}
    costs = {
        scene: {cost["sampler"]: cost["median"] for cost in entry["cost"].values()}
        for scene, entry in results["scenes"].items()
        if not entry.get("absent")
    }
    return facts | {"cells": cells_of(results), "costs": costs}


def cells_of(results: dict[str, Any]) -> list[dict[str, Any]]:
    """Medians over seeds, a row for each scene, number of samples and column."""
    return [
        {
            "scene": row["scene"],
            "spp": row["spp"],
            "method": row["method"],
            "error": row["metrics"][results["primary"]]["median"],
            "seconds": row["seconds"]["reconstruct"],
        }
        | ({"FLIP": row["metrics"]["FLIP"]["median"]} if "FLIP" in row["metrics"] else {})
        for row in results["summary"]
        if row["scene"] and row["metrics"]
    ]


def short(value: float, digits: int = 3) -> str:
    return f"{value:.{digits}g}" if value < 100 else f"{value:.0f}"


def heading(first: str, *others: str) -> list[str]:
    return [f"| {first} | {' | '.join(others)} |", "|---" + "|--:" * len(others) + "|"]


if __name__ == "__main__":
    main()
