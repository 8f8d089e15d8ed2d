"""Shared tails over many seeds: how far single images are off, and whether their noise is as large as claimed.

    python -m bench.seeds kitchen/scene.xml generator:3:partition --references FOLDER

The sampler is `primal`; ``bench.judging`` opens the scenes. There is a cell for each scene, number of samples and value
of ``tails``:

    light      the mean of the image over the mean of the reference: mean, least and largest value of the seeds
    deviation  the real over the claimed standard deviation of the image's light. The claimed variance is the sum of the
               pixels' own variances plus the square of the mean of the layer ``shared``, averaged over the seeds
    blocks     the real over the claimed variance of blocks of 8x8 and of 32x32 pixels: the ratio of the sums over all
               blocks, and the median of the ratios. For whole paths it is below 1, because with points in Z order the
               errors of neighbouring pixels partly cancel
    error      ``bench.judging.Judge.steady`` after `oidn`: geometric mean, median and worst of the seeds
    seconds    processor seconds of the render and of OIDN

The table divides the error by the error of whole paths after the same time; both are geometric means over seeds.
``bench.curves`` explains the marks. Cells that are measured again replace the old ones.
"""

import argparse
from collections.abc import Iterator
from typing import Any

import numpy as np

import ngpt
from bench.common import blocks, digits, renderer, table
from bench.curves import marked, over_least
from bench.judging import WARM_SPP, Cells, command, open_judged, parsed, timed
from bench.tails import TAILS
from ngpt.measure.averages import geometric_mean
from ngpt.shared import shared_variance

SIDES = (8, 32)
CELL = ("scene", "size", "spp", "tails")
HEAD = ["scene", "spp", "tails", "light", "least .. most", "deviation", *(f"{n}x{n}, median" for n in SIDES)]
HEAD += ["error", "median", "worst", "worst / median", "whole s", "error at equal time"]


def main() -> None:
    parser = command(__doc__, "seeds", "320x180", (16, 64))
    parser.add_argument("--seeds", type=int, default=32, help="number of seeds for shared tails")
    parser.add_argument("--paths-seeds", type=int, default=8, help="number of seeds for whole paths")
    args = parsed(parser)
    if args.scenes and min(args.seeds, args.paths_seeds) < 2:
        parser.error("give two seeds or more")
    cells = Cells(args.output, "seeds", CELL)
    cells.measure(args.scenes, lambda scene, _: measured(scene, args))
    table(HEAD, rows(cells))


def measured(scene: str, args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Yields the cells of a scene."""
    _, render_stack = renderer()
    name, loaded, judge = open_judged(scene, args.size, args.references, args.reference_spp)

    def made(spp: int, seed: int, tails: str) -> tuple[ngpt.GradientStack, np.ndarray]:
        stack = render_stack(loaded, spp, seed, "primal", tails=tails)
        return stack, ngpt.reconstruct(stack, "oidn").image

    for tails in TAILS:
        made(WARM_SPP, 0, tails)
        for spp in args.spp:
            layers, found, seconds = [], [], []
            for seed in range(1, 1 + (args.seeds if tails == "shared" else args.paths_seeds)):
                (stack, image), taken = timed(lambda n=spp, s=seed, t=tails: made(n, s, t))
                seconds.append(taken)
                found.append(judge.steady(image))
                layers.append({each: stack[each] for each in ("primal", "primal_var", "shared") if each in stack})
            light = [judge.light(each["primal"]) for each in layers]
            cell = {"scene": name, "size": args.size, "spp": spp, "tails": tails, "seeds": len(seconds)}
            cell |= {"seconds": float(np.mean(seconds)), "light": spread(light), "error": errors(found)}
            yield cell | noise(layers)


def spread(values: list[float]) -> dict[str, float]:
    return {"mean": float(np.mean(values)), "least": float(min(values)), "most": float(max(values))}


def errors(values: list[float]) -> dict[str, float]:
    return {"mean": geometric_mean(values), "median": float(np.median(values)), "worst": float(max(values))}


def noise(stacks: list[dict[str, np.ndarray]]) -> dict[str, Any]:
    """The entries ``deviation`` and ``blocks`` of a cell.

    ``stacks`` are the stacks of two seeds or more, with ``primal``, ``primal_var`` and, if paths share their tails,
    ``shared``, (H, W, 3) each. Where no noise is claimed, the deviation is None and the ratios of a block are {}.
    """
    primal, own = (np.array([stack[name] for stack in stacks], np.float64) for name in ("primal", "primal_var"))
    shared = np.zeros_like(primal)
    if all("shared" in stack for stack in stacks):
        shared = np.array([stack["shared"] for stack in stacks], np.float64)
        own = np.maximum(own - np.array([shared_variance(layer) for layer in shared]), 0)

    def ratios(means, pixels: int) -> dict[str, float | None]:
        real, claimed = means(primal).var(axis=0, ddof=1), (means(own) / pixels + means(shared) ** 2).mean(axis=0)
        known = claimed.mean(axis=-1) > 0
        each = real.mean(axis=-1)[known] / claimed.mean(axis=-1)[known]
        return {"sum": float(real.sum() / claimed.sum()), "median": float(np.median(each))} if each.size else {}

    whole = ratios(lambda layers: layers.mean(axis=(1, 2)), primal[0, ..., 0].size)
    by_side = {str(side): ratios(lambda layers, side=side: blocks(layers, side), side * side) for side in SIDES}
    return {"deviation": whole["sum"] ** 0.5 if whole else None, "blocks": by_side}


def rows(cells: list[dict[str, Any]]) -> list[list[str]]:
    """The lines of the table, one for each cell, sorted by scene, size, number of samples and tails."""
    lines = []
    for cell in sorted(cells, key=lambda cell: tuple(cell[name] for name in CELL)):
        paths = [c for c in cells if (c["scene"], c["size"], c["tails"]) == (cell["scene"], cell["size"], "paths")]
        light, error = cell["light"], cell["error"]
        curve = [(c["seconds"], c["error"]["mean"]) for c in paths if c["error"]["mean"] > 0]
        ratio = None if cell["tails"] == "paths" else over_least(error["mean"], cell["seconds"], [curve])
        line = [f"{cell['scene']} {cell['size']}", str(cell["spp"]), cell["tails"]]
        line += [f"{light['mean']:.4f}", f"{light['least']:.3f} .. {light['most']:.3f}", digits(cell["deviation"])]
        line += [f"{digits(by.get('sum'))}, {digits(by.get('median'))}" for by in cell["blocks"].values()]
        line += [digits(error[name]) for name in ("mean", "median", "worst")]
        lines.append([*line, f"{error['worst'] / error['median']:.2f}", f"{cell['seconds']:.2f}", marked(ratio)])
    return lines


if __name__ == "__main__":
    main()
