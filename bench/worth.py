"""W, C and W/C of each scene, sampler and method with gradients, of what ``python -m bench.pipelines`` has measured.

    python -m bench.worth [--file bench/results/pipelines.json]          # prints the tables of docs/lab/worth.md

W and C are those of ngpt/evaluation/worth.py: by how many times more samples the best pipeline without gradients needs
for the same error, and what a sample costs over one of it. Pipelines without gradients are all samplers that have none,
with `primal`, `oidn` and `ngpt-primal`. All samples are even. Rows with few samples are those at a quarter of the
samples of the part, then the part and four of them: about 16, 64 and 256 samples of the first sampler in time, as
``bench.pipelines`` says; those of dear samplers are fewer.
"""

import argparse
import json
import math
import statistics
from pathlib import Path

from bench.pipelines import cells
from data_gen.samplers import SAMPLERS
from ngpt.evaluation.worth import samples_for

NETWORKS = ("wcv", "ngpt-fast", "ngpt-combine")
STEPS = ("a quarter", "one part", "four parts")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--file", type=Path, default=Path("bench/results/pipelines.json"))
    args = parser.parse_args()

    from data_gen.backend import use_variant

    use_variant()
    print(*table(json.loads(args.file.read_text())["scenes"]), sep="\n")


def worth(entry: dict) -> list[dict]:
    """Rows of a scene: sampler, method, samples, W, its mark (~ < >), C."""
    even = [row for row in entry["rows"] if row["pilot"]["choosing"] == 0]
    rivals = [row for row in even if not SAMPLERS[row["pilot"]["sampler"]].gradients]
    rows = []
    for row in even:
        sampler, method = row["pilot"]["sampler"], row["pilot"]["method"]
        if method not in NETWORKS:
            continue
        for n, error in sorted((int(n), e) for n, e in row["errors"].items()):
            answers = []
            for rival in rivals:
                points = [(int(m), e) for m, e in rival["errors"].items()]
                if found := samples_for(error, points):
                    answers.append((found[0] * rival["seconds"], *found, rival["seconds"]))
            if answers:
                _, m, mark, seconds = min(answers)
                C = row["seconds"] / seconds
                rows.append({"sampler": sampler, "method": method, "spp": n, "W": m / n, "mark": mark, "C": C})
    return rows


def table(scenes: dict[str, dict]) -> list[str]:
    """Lines of Markdown: each scene and sampler, W, C and W/C of each method at each number of samples; their geometric
    means by sampler; and in how many cells the best pipeline with gradients is ahead."""
    found = {scene: worth(entry) for scene, entry in scenes.items()}
    head = "| scene | sampler | samples | C | " + " | ".join(f"W, W/C `{m}`" for m in NETWORKS) + " |"
    lines = [head, "|---|---|--:|--:|" + "--:|" * len(NETWORKS)]
    for scene, rows in found.items():
        for sampler, spp in dict.fromkeys((row["sampler"], row["spp"]) for row in rows):
            here = {row["method"]: row for row in rows if (row["sampler"], row["spp"]) == (sampler, spp)}
            # Of the fastest rival: methods may have others, at other costs.
            costs = sorted({f"{row['C']:.2f}" for row in here.values()}, key=float)
            texts = (_cell(here.get(m)) for m in NETWORKS)
            lines.append(f"| {scene} | `{sampler}` | {spp} | {', '.join(costs)} | " + " | ".join(texts) + " |")
    return [*lines, "", *means(scenes, found), "", *ahead(scenes)]


def _cell(row: dict | None) -> str:
    return "" if row is None else f"{row['mark']}{row['W']:.2f}, {row['mark']}{row['W'] / row['C']:.2f}"


def means(scenes: dict[str, dict], found: dict[str, list[dict]]) -> list[str]:
    """W/C by sampler and step, geometric means over scenes."""
    lines = ["| W/C, mean | sampler | " + " | ".join(f"`{m}`" for m in NETWORKS) + " |"]
    lines.append("|---|---|" + "--:|" * len(NETWORKS))
    for apart in (False, True):
        names = [scene for scene in found if scenes[scene]["apart"] == apart]
        for sampler in dict.fromkeys(row["sampler"] for scene in names for row in found[scene]):
            each: dict[tuple[int, str], list[float]] = {}
            for scene in names:
                rows = [row for row in found[scene] if row["sampler"] == sampler]
                counts = sorted({row["spp"] for row in rows})
                # Where a step had too few samples for variances, it is the first.
                first = len(STEPS) - len(counts)
                for row in rows:
                    each.setdefault((first + counts.index(row["spp"]), row["method"]), []).append(row["W"] / row["C"])
            for i, step in enumerate(STEPS):
                texts = (_mean(each.get((i, m), [])) for m in NETWORKS)
                title = f"{'apart' if apart else 'chosen on'}, {step}"
                lines.append(f"| {title} | `{sampler}` | " + " | ".join(texts) + " |")
    return lines


def _mean(values: list[float]) -> str:
    if not values:
        return ""
    return f"{math.exp(statistics.mean(math.log(v) for v in values)):.2f} ({len(values)})"


def ahead(scenes: dict[str, dict]) -> list[str]:
    """At equal time, samples shared out where that has less error: cells where the least error with gradients is below
    the least without, how far apart; and the same of what the pilot chose, where it chose gradients."""
    lines = ["| time of `gpt` samples | scenes | ahead with gradients | error, best over best without |"]
    lines[0] += " the pilot takes gradients | its error over the best without | at worst |"
    lines.append("|--:|---|--:|--:|--:|--:|--:|")
    for i in range(3):
        for apart in (False, True):
            best, chosen = [], []
            for cell in (cells(entry)[i] for entry in scenes.values() if entry["apart"] == apart):
                errors = {gradients: {} for gradients in (False, True)}
                for name, error in cell["errors"].items():
                    errors[SAMPLERS[name.split()[0]].gradients][name] = error
                without = min(errors[False].values())
                best.append(min(errors[True].values()) / without)
                if cell["choice"] in errors[True]:
                    chosen.append(errors[True][cell["choice"]] / without)
            parts = [str(cell["spp"]), "apart" if apart else "chosen on", f"{sum(r < 1 for r in best)} of {len(best)}"]
            parts += [_mean(best).split()[0], str(len(chosen)), (_mean(chosen) or "-").split()[0]]
            lines.append(f"| {' | '.join(parts)} | {max(chosen, default=math.nan):.2f} |")
    return lines


if __name__ == "__main__":
    main()
