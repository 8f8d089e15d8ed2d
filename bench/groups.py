"""The first tables of docs/lab/RESULTS.md: errors at equal time, by what the networks knew of the scenes.

    python -m bench.groups

reads the cells that `ngpt advise` ships with (ngpt/measure/advice.json, of the evaluation that RESULTS.md names) and
prints Markdown: geometric means of relMSE trimmed for each group, and in how many cells one method beats another.
"""

import json
from pathlib import Path

import numpy as np

# What the shipped networks knew of each scene. docs/train/training.md and the model cards say how.
GROUPS = {
    "blind": ("classroom",),
    "rooms": ("living-room", "dining-room", "bedroom"),
    "watched": ("lamp", "staircase", "glass-of-water"),
    "other views": ("diffuse", "glossy", "environment", "lens", "cornell-box", "coffee", "veach-mis"),
}
METHODS = ("l1", "wcv", "ngpt-fast", "ngpt-combine", "ngpt-primal", "nfor", "oidn")
PAIRS = (("ngpt-combine", "oidn"), ("ngpt-primal", "oidn"), ("ngpt-fast", "oidn"), ("ngpt-combine", "ngpt-primal"))
CELLS = Path(__file__).parents[1] / "ngpt" / "measure" / "advice.json"


def main() -> None:
    print(tables(cells(CELLS)))


def cells(path: Path) -> dict[tuple[str, int, str], float]:
    """(scene, nominal spp, method) -> error."""
    result = {}
    for row in json.loads(path.read_text())["scenes"]:
        # Methods without gradients list the samples they were given, those with gradients the nominal ones.
        counts = [round(spp) for spp in row["methods"]["wcv"]["spp"]]
        for method, column in row["methods"].items():
            result |= {(row["scene"], n, method): e for n, e in zip(counts, column["error"], strict=True)}
    return result


def tables(errors: dict[tuple[str, int, str], float]) -> str:
    """Three tables as Markdown: mean errors, their ratios, and counts of cells."""
    counts = sorted({spp for _, spp, _ in errors})
    groups = {**GROUPS, "all": tuple(scene for scenes in GROUPS.values() for scene in scenes)}

    def mean(scenes: tuple[str, ...], spp: int, method: str) -> float:
        return float(np.exp(np.mean([np.log(errors[scene, spp, method]) for scene in scenes])))

    def below(scenes: tuple[str, ...], method: str, rival: str) -> int:
        return sum(errors[s, n, method] < errors[s, n, rival] for s in scenes for n in counts)

    lines = heading("scenes", "spp", *(f"`{method}`" for method in METHODS))
    for name, scenes in groups.items():
        for spp in counts:
            means = [mean(scenes, spp, method) for method in METHODS]
            texts = [f"**{value:.4f}**" if value == min(means) else f"{value:.4f}" for value in means]
            lines.append(f"| {f'{name} ({len(scenes)})' if spp == counts[0] else ''} | {spp} | {' | '.join(texts)} |")
    lines += ["", *heading("mean error over another's", *(f"{spp} spp" for spp in counts))]
    for method, rival in PAIRS:
        for name, scenes in groups.items():
            ratios = [f"{mean(scenes, spp, method) / mean(scenes, spp, rival):.2f}" for spp in counts]
            lines.append(f"| `{method}` over `{rival}`, {name} | {' | '.join(ratios)} |")
    lines += ["", *heading("cells with less error", *(f"{name} ({len(scenes)})" for name, scenes in groups.items()))]
    for method, rival in PAIRS:
        won = [f"{below(scenes, method, rival)} of {len(scenes) * len(counts)}" for scenes in groups.values()]
        lines.append(f"| `{method}` than `{rival}` | {' | '.join(won)} |")
    return "\n".join(lines)


def heading(first: str, *others: str) -> list[str]:
    return [f"| {first} | {' | '.join(others)} |", "|---" + "|--:" * len(others) + "|"]


if __name__ == "__main__":
    main()
