"""Prints tables of the results of `ngpt evaluate`: rivals at equal whole time, and the worth of gradients.

    python -m bench.evaluated DIR

The tables are in Markdown. For each group of scenes, the plot DIR/frontier-GROUP.svg shows error over whole seconds, of
each rival at its best setting. The configuration of the evaluation names rivals and groups. ``bench.curves`` explains
the marks.
"""

import sys
from pathlib import Path

from bench.frontier import draw, points_against
from bench.wholetime import against_tables, groups_of
from bench.worth import worth_tables
from ngpt.report.evaluation import read_results
from ngpt.system.writing import markdown_table


def main(folder: Path) -> None:
    results = read_results(folder)
    for title, (head, *rows) in (against_tables(results) | worth_tables(results)).items():
        print(f"{title}:", "", *markdown_table(head, rows), "", sep="\n")
    measured = [name for name, entry in results["scenes"].items() if not entry["absent"]]
    for group, scenes in groups_of(results, measured).items():
        if points := points_against(results, scenes):
            title = f"{group}: geometric mean over {len(scenes)} scenes"
            (folder / f"frontier-{group}.svg").write_text(draw(points, title, results["primary"]))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
