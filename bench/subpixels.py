"""Errors and seconds of OIDN on K x K subpixels of each pixel, relative to OIDN on pixels.

    python -m bench.subpixels product lens living-room/scene.xml --references FOLDER

The sampler is `primal`, with shared tails where they work. A scene is a name of ``bench.panel``, or one that
``bench.judging`` opens. For each scene, number of samples and seed, one stack is rendered, with the most subpixels that
a way needs; stacks with fewer subpixels are means of it. Ways that need more subpixels than a pixel has samples are
skipped. Each of WAYS is the mean of one or more images of OIDN, each with its K and its use of the features; "auto" is
the default of `oidn` with subpixels. A cell has, for each way:

    seconds  processor seconds of OIDN, after a warm-up
    error    ``bench.judging.Judge.steady``
    FLIP     relative to the mean of the reference's halves

The table shows medians over seeds of the ratio of each value to the value of ``BASE``.
"""

import argparse
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd

import ngpt
from bench.common import renderer
from bench.judging import Cells, command, open_judged, parsed, timed
from bench.panel import CASES
from ngpt.measure.averages import geometric_mean
from ngpt.stack import GradientStack
from ngpt.subpixels import means, subpixels

# Name -> the images that are averaged: K, and how OIDN uses the features.
WAYS: dict[str, tuple[tuple[int, str], ...]] = {
    "1 prefiltered": ((1, "prefiltered"),),
    "1 noisy": ((1, "noisy"),),
    "2 noisy": ((2, "noisy"),),
    "2 clean": ((2, "clean"),),
    "2 prefiltered": ((2, "prefiltered"),),
    "1 and 2 clean": ((1, "prefiltered"), (2, "clean")),
    "1 and 2 prefiltered": ((1, "prefiltered"), (2, "prefiltered")),
    "2 auto": ((2, "auto"),),
    "4 auto": ((4, "auto"),),
}
BASE = "1 prefiltered"
CELL = ("scene", "size", "spp", "seed")


def main() -> None:
    parser = command(__doc__, "subpixels", "192x108", (8, 16, 64, 256))
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    parser.add_argument("--ways", nargs="+", default=list(WAYS), choices=list(WAYS))
    args = parsed(parser)
    cells = Cells(args.output, "subpixels", CELL)
    cells.measure(args.scenes, lambda scene, known: measured(scene, args, known))
    show(cells)


def measured(scene: str, args: argparse.Namespace, known: set[tuple]) -> Iterator[dict[str, Any]]:
    """Yields the cells of a scene that are not ``known``."""
    _, render_stack = renderer()
    file = CASES[scene].scene if scene in CASES else scene
    name, loaded, judge = open_judged(file, args.size, args.references, args.reference_spp)
    warm = False

    def rendered(spp: int, seed: int, k: int) -> GradientStack:
        return render_stack(loaded, spp, seed, "primal", unbiased=False, subpixels=k)

    for spp in args.spp:
        able = [way for way in args.ways if max(k for k, _ in WAYS[way]) ** 2 <= spp]
        most = max(k for way in able for k, _ in WAYS[way])
        for seed in args.seeds:
            place = (name, args.size, spp, seed)
            if place in known:
                continue
            if not warm:
                warm = bool([rendered(spp, 0, k) for k in (1, most)])
            stack, seconds = timed(lambda spp=spp, seed=seed, most=most: rendered(spp, seed, most))
            images = {part: denoised(stack, *part) for part in {part for way in able for part in WAYS[way]}}
            ways = {}
            for way in able:
                each = [images[part] for part in WAYS[way]]
                image = np.mean([one for one, _ in each], axis=0, dtype=np.float32)
                ways[way] = {"seconds": sum(taken for _, taken in each)} | judge.values(image)
            yield dict(zip(CELL, place, strict=True)) | {"seconds": seconds, "ways": ways}


def denoised(stack: GradientStack, k: int, auxiliary: str) -> tuple[np.ndarray, float]:
    """OIDN's image of K x K subpixels, and the seconds of a second, warm call."""
    has = subpixels(stack.fine, stack.width)
    fine = {name: means(layer, has // k) for name, layer in stack.fine.items()} if k > 1 else {}
    given = replace(stack, fine=fine)
    ngpt.reconstruct(given, "oidn", auxiliary=auxiliary)
    result, seconds = timed(lambda: ngpt.reconstruct(given, "oidn", auxiliary=auxiliary))
    return result.image, seconds


def show(cells: list[dict]) -> None:
    """Prints a table for each size and number of samples: for each way, means, worst values, and errors by scene."""
    values = ["error", "FLIP", "seconds"]
    lines = [
        {name: cell[name] for name in CELL} | {"way": way} | {v: found[v] / cell["ways"][BASE][v] for v in values}
        for cell in cells
        for way, found in cell["ways"].items()
    ]
    for (size, spp), here in pd.DataFrame(lines).groupby(["size", "spp"]):
        by_way = here.groupby(["way", "scene"], sort=False)[values].median()
        print(f"\n{size}, {spp} spp: {', '.join(by_way.index.unique('scene'))}\n")
        print("| way | error: mean | worst | FLIP: mean | worst | seconds | errors |\n|---|--:|--:|--:|--:|--:|---|")
        for way in (way for way in WAYS if way != BASE and way in by_way.index):
            of = by_way.loc[way]
            ends = [end(of[value]) for value in ("error", "FLIP") for end in (geometric_mean, max)]
            ends.append(geometric_mean(of["seconds"]))
            each = " ".join(f"{ratio:.2f}" for ratio in of["error"])
            print(f"| {way} | " + " | ".join(f"{value:.2f}" for value in ends) + f" | {each} |")


if __name__ == "__main__":
    main()
