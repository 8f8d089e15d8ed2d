"""Writes tables of evaluations into the pages that quote them.

    python eval.py --config configs/eval-bidirectional.toml --out out/bidirectional --scenes 'scenes/*/scene.xml'
    python -m bench.tables bidirectional out/bidirectional   # stores the numbers, and writes the table into its page
    python -m bench.tables                                   # writes all tables, from the stored numbers

bench/results/NAME.json holds the stored numbers: for each cell, medians over seeds of the primary metric and of FLIP;
and the cost of a sample of each sampler. ``PAGES`` has the page and the kind of each table:

    by_scene   errors over the least error of the scene, which is bold; then the least errors, and the cost of a sample
               relative to `primal`
    means      geometric means over the scenes at each number of samples; the least is bold
    rivals     errors divided by OIDN's error on our samples, and on Mitsuba's; geometric means over all cells
"""

import argparse
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pandas as pd

from bench.common import save, write_page
from ngpt.measure.averages import geometric_mean
from ngpt.system.writing import markdown_table

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "bench" / "results"


# Columns of rivals and their names in tables: OIDN on our samples, and OIDN on Mitsuba's.
RIVALS = {"oidn": "OIDN", "mitsuba": "Mitsuba + OIDN"}


def pivoted(result: dict[str, Any], value: str = "error") -> pd.DataFrame:
    """A row for each scene and number of samples, and a column for each method, in the order of the cells."""
    return pd.DataFrame(result["cells"]).pivot_table(value, ["scene", "spp"], "method", sort=False, observed=True)


def by_scene(result: dict[str, Any]) -> str:
    errors = pivoted(result)
    ratios = errors.div(errors.min(axis=1), axis=0)
    several = errors.index.unique("spp").size > 1
    heads = [f"{scene}, {spp} spp" if several else scene for scene, spp in errors.index]
    rows = []
    for method in dict.fromkeys(cell["method"] for cell in result["cells"]):
        shown = ["" if math.isnan(r) else "**1**" if r == 1 else short(r) for r in ratios[method]]
        # Only methods that have all scenes have a mean, because means over different scenes cannot be compared.
        rows.append([f"`{method}`", *shown, "" if "" in shown else short(geometric_mean(ratios[method]))])
    rows.append(["*least error*", *(f"{error:.2g}" for error in errors.min(axis=1)), ""])
    costs = pd.DataFrame(result.get("costs", {})).reindex(columns=errors.index.get_level_values("scene"))
    for sampler, cost in (costs / costs.loc["primal"] if len(costs) else costs).iterrows():
        if sampler != "primal":
            rows.append([f"*cost of `{sampler}`*", *("" if math.isnan(c) else short(c, 2) for c in cost), ""])
    return "\n".join(markdown_table(["method (sampler)", *heads, "mean"], rows))


def means(result: dict[str, Any]) -> str:
    values = ["error", "FLIP"] if all("FLIP" in cell for cell in result["cells"]) else ["error"]
    of = {value: pivoted(result, value).groupby("spp").agg(geometric_mean) for value in values}
    methods = list(dict.fromkeys(cell["method"] for cell in result["cells"]))

    def text(value: str, spp: int, method: str) -> str:
        line = of[value].loc[spp]
        shown = f"{line[method]:.3f}" if value == "FLIP" else f"{line[method]:.2g}"
        return f"**{shown}**" if line[method] == line.min() else shown

    rows = [[str(n), *(", ".join(text(v, n, method) for v in values) for method in methods)] for n in of["error"].index]
    heads = (f"`{method}`{', FLIP' if len(values) > 1 else ''}" for method in methods)
    return "\n".join(markdown_table(["spp", *heads], rows))


def rivals(result: dict[str, Any]) -> str:
    of = {"error": pivoted(result), "FLIP": pivoted(result, "FLIP")}
    methods = [name for name in dict.fromkeys(cell["method"] for cell in result["cells"]) if name not in RIVALS]
    rows = []
    for rival, text in RIVALS.items():
        over = {
            value: [(found[method] / found[rival])[found[method].notna()] for method in methods]
            for value, found in of.items()
        }
        less = [f"{(ratios < 1).sum()} of {ratios.size}" for ratios in over["error"]]
        rows.append([f"less error than {text}", *less])
        rows += [[f"{value} over its", *map(short, map(geometric_mean, each))] for value, each in over.items()]
    return "\n".join(markdown_table([f"{len(of['error'])} cells", *(f"`{method}`" for method in methods)], rows))


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
    parser.add_argument("folder", type=Path, nargs="?", help="results of the evaluation; default: stored numbers")
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
    """The numbers of an evaluation's results.json that the tables need."""
    facts = {name: results[name] for name in ("title", "command", "date", "metadata", "settings")}
    costs = {
        scene: {cost["sampler"]: cost["median"] for cost in entry["cost"].values()}
        for scene, entry in results["scenes"].items()
        if not entry.get("absent")
    }
    return facts | {"cells": cells_of(results), "costs": costs}


def cells_of(results: dict[str, Any]) -> list[dict[str, Any]]:
    """Medians over seeds for each scene, number of samples and column."""
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


if __name__ == "__main__":
    main()
