"""How often the truth lies within one and within 1.96 standard errors of a result: by method, scene and samples.

    python -m bench.uncertainty --scenes diffuse lens --checked glossy --cache STACKS -o bench/results/uncertainty.json

A scene is a built-in one, or a folder with scene.xml in it. The intervals include the noise of the reference: their
half-width is sqrt(error² + variance of the reference). Pixels that show a lamp are left out.

Each method's factor is chosen on --scenes, so that both coverages are closest to 68.3 and 95 %, and checked on
--checked. With --halves, each stack is merged from two halves, which the estimate of the error also uses. Two rows are
printed for each method: the coverages, and the tail. The tail is the share of values that are more than five standard
errors off, and the sum of all squared errors over the claimed sum.
"""

import argparse
from pathlib import Path

import numpy as np

from bench.common import kept, metadata, renderer, save
from ngpt.api.uncertainty import FACTOR, FACTORS, reconstruct_with_error
from ngpt.errors import NgptError
from ngpt.merging import merge
from ngpt.methods import METHODS
from ngpt.stack import GradientStack

INTERVALS = {"68": (1.0, 0.683), "95": (1.96, 0.95)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="*", default=["diffuse", "lens"], help="that factors are chosen on")
    parser.add_argument("--checked", nargs="*", default=["glossy", "environment"], help="that they are checked on")
    parser.add_argument("--methods", nargs="*", default=[name for name, m in METHODS.items() if not m.missing()])
    parser.add_argument("--spp", type=int, nargs="*", default=[4, 16])
    parser.add_argument("--halves", action="store_true", help="the error goes by two halves of the samples, too")
    parser.add_argument("--reference", type=int, default=1024, metavar="SPP")
    parser.add_argument("--size", type=int, nargs=2, default=(192, 108), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--cache", type=Path, required=True, help="folder of stacks and references")
    parser.add_argument("-o", "--output", type=Path, default=Path("bench/results/uncertainty.json"))
    args = parser.parse_args()

    result = {"benchmark": "uncertainty", "spp": args.spp, "chosen on": args.scenes, "checked on": args.checked}
    result |= {"metadata": metadata("onnxruntime", "mitsuba-oidn"), "methods": {}}
    for method in args.methods:
        cases = {}
        for scene in (*args.scenes, *args.checked):
            for spp in args.spp:
                try:
                    cases[Path(scene).name, spp] = case(method, *images(scene, spp, args))
                except NgptError as error:
                    print(f"{method}, {scene}, {spp} spp: {error}", flush=True)
        chosen, checked = (
            [c for (scene, _), c in cases.items() if scene in {Path(s).name for s in names}]
            for names in (args.scenes, args.checked)
        )
        if not chosen:
            continue
        best = min(np.geomspace(0.3, 6, 240), key=lambda factor: miss(chosen, float(factor)))
        used = FACTORS.get(method, FACTOR)
        row = {"best factor": round(float(best), 3), "factor": used}
        row |= {"chosen": mean(chosen, used), "checked": mean(checked, used)}
        row["cases"] = {f"{scene}, {spp} spp": covered(c, used) for (scene, spp), c in cases.items()}
        row["tails"] = {f"{scene}, {spp} spp": tail(c, used) for (scene, spp), c in cases.items()}
        result["methods"][method] = row
        print(line(method, row), flush=True)
        print(tail_line(method, row), flush=True)
        save(args.output, result)


def images(scene: str, spp: int, args: argparse.Namespace) -> list[GradientStack]:
    """The reference, the stack and, where they are wanted, its halves; rendered where they are not in the cache."""
    name = Path(scene).name
    halves = [(f"{name}-{spp}-half{i}.exr", spp // 2, "gpt", 2 * spp + i) for i in (0, 1)]
    files = [(f"{name}-reference.exr", args.reference, "primal", spp)]
    files += halves if args.halves else [(f"{name}-{spp}.exr", spp, "gpt", spp)]

    def make(count: int, sampler: str, seed: int) -> GradientStack:
        load_scene, render_stack = renderer()
        at = Path(scene) / "scene.xml"
        return render_stack(
            load_scene(str(at) if at.exists() else scene, tuple(args.size)), count, seed, sampler, unbiased=True
        )

    found = [kept(args.cache / file, lambda how=how: make(*how)) for file, *how in files]
    return [found[0], merge(found[1:]), *found[1:]] if args.halves else found


def case(method: str, reference: GradientStack, stack: GradientStack, *halves: GradientStack) -> tuple[np.ndarray, ...]:
    """Difference to the reference, change by more noise, variance of the reference, for values that show no lamp."""
    result = reconstruct_with_error(stack, method, halves=halves or None)
    image, changed = result.image, result.error / FACTORS.get(method, FACTOR)
    shown = ~stack["direct"].any(axis=-1) if "direct" in stack else np.ones(image.shape[:2], bool)
    variance = np.nan_to_num(reference["primal_var"])
    return tuple(a[shown].astype(np.float64) for a in (image - reference["primal"], changed, variance))


def covered(one: tuple[np.ndarray, ...], factor: float) -> dict[str, float]:
    difference, changed, variance = one
    width = np.sqrt((factor * changed) ** 2 + variance)
    return {name: round(float(np.mean(np.abs(difference) <= k * width)), 4) for name, (k, _) in INTERVALS.items()}


def tail(one: tuple[np.ndarray, ...], factor: float) -> dict[str, float]:
    """The share of values that are more than 5 errors off, and the sum of all squared errors over the claimed one."""
    difference, changed, variance = one
    width = np.sqrt((factor * changed) ** 2 + variance)
    squares = (np.square(difference) - variance).sum() / np.square(factor * changed).sum()
    return {
        "beyond 5 errors": round(float(np.mean(np.abs(difference) > 5 * width)), 5),
        "squares over claimed": round(float(squares), 3),
    }


def mean(cases: list, factor: float) -> dict[str, float]:
    each = [covered(one, factor) for one in cases]
    return {name: round(float(np.mean([c[name] for c in each])), 4) for name in INTERVALS} if each else {}


def miss(cases: list, factor: float) -> float:
    found = mean(cases, factor)
    return sum(abs(found[name] - wanted) for name, (_, wanted) in INTERVALS.items())


def line(method: str, row: dict) -> str:
    """A row of a table in Markdown: factor, coverage in the mean of the checked scenes, least to most of all."""
    cells = [f"| `{method}` | {row['factor']}"]
    for name in INTERVALS:
        each = [one[name] for one in row["cases"].values()]
        mean = (row["checked"] or row["chosen"])[name]
        cells.append(f"{100 * mean:.0f} | {100 * min(each):.0f} .. {100 * max(each):.0f}")
    return " | ".join(cells) + " |"


def tail_line(method: str, row: dict) -> str:
    """A row of the table of tails: share beyond 5 errors in percent, then squares; both the mean, least to most."""
    cells = [f"| `{method}`"]
    for name, unit in (("beyond 5 errors", 100), ("squares over claimed", 1)):
        each = [unit * one[name] for one in row["tails"].values()]
        cells.append(f"{np.mean(each):.2f} | {min(each):.2f} .. {max(each):.2f}")
    return " | ".join(cells) + " |"


if __name__ == "__main__":
    main()
