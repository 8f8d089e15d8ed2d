"""The first tables of docs/RESULTS.md: errors at equal time, by what the networks knew of the scenes.

    python -m bench.groups

reads the cells that `ngpt advise` ships with (ngpt/measure/advice.json, of the evaluation that RESULTS.md names) and
prints Markdown: geometric means of relMSE trimmed for each group, and in how many cells one method beats another.
"""

import json
from pathlib import Path

import numpy as np

# What the shipped networks knew of each scene. docs/training.md and the model cards say how.
GROUPS = {
    "untouched": ("dining-room", "bedroom"),
    "constants": ("living-room",),
    "watched": ("lamp", "staircase", "glass-of-water"),
    "other views": ("diffuse", "glossy", "environment", "lens", "cornell-box", "coffee", "veach-mis"),
}
METHODS = ("l1", "wcv", "ngpt-fast", "ngpt-combine", "ngpt-primal", "nfor", "oidn")
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
    """Both tables as Markdown."""
    counts = sorted({spp for _, spp, _ in errors})
    known = {scene for scenes in GROUPS.values() for scene in scenes}
    lines = [f"| scenes | spp | {' | '.join(f'`{m}`' for m in METHODS)} |", "|---|--:|" + "--:|" * len(METHODS)]
    for name, scenes in {**GROUPS, "all": sorted(known)}.items():
        for spp in counts:
            means = [np.exp(np.mean([np.log(errors[scene, spp, m]) for scene in scenes])) for m in METHODS]
            texts = [f"**{mean:.4f}**" if mean == min(means) else f"{mean:.4f}" for mean in means]
            lines.append(f"| {f'{name} ({len(scenes)})' if spp == counts[0] else ''} | {spp} | {' | '.join(texts)} |")
    rivals = ("ngpt-combine", "ngpt-primal", "ngpt-fast")
    lines += ["", f"| scenes | {' | '.join(f'`{m}` below `oidn`' for m in rivals)} |", "|---|" + "--:|" * len(rivals)]
    for name, scenes in {**GROUPS, "all": sorted(known)}.items():
        pairs = [(scene, spp) for scene in scenes for spp in counts]
        won = [sum(errors[s, n, m] < errors[s, n, "oidn"] for s, n in pairs) for m in rivals]
        lines.append(f"| {name} ({len(scenes)}) | {' | '.join(f'{w} of {len(pairs)}' for w in won)} |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
