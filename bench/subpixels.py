"""The value of subpixels: errors and seconds of OIDN on K x K subpixels of each pixel, relative to pixels.

    python -m bench.subpixels product lens living-room/scene.xml --references FOLDER

The sampler is `primal`, with shared tails where they work. A scene, number of samples and seed is rendered once, with
as many subpixels as any way needs; fewer are their means. Ways that need more subpixels than a pixel has samples are
skipped. A scene is a name of `bench.panel`, or a file or generated scene as in `bench.seeds`. References are made and
stored as there. Each of WAYS is the mean of one or more images, given by K and by how OIDN is to use the features.
"auto" is the default of `oidn` with subpixels. Each cell has, for each way:

    seconds  of processors, warmed up
    error    ``bench.tails.steady_error``; FLIP is over the mean of the reference's halves

The table shows the ratio of each value to the value of ``BASE``: the median over seeds.
"""

import argparse
import gc
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import ngpt
from bench.common import metadata, renderer, save
from bench.panel import CASES
from bench.seeds import opened
from bench.tails import add_references, check_references, clean_image, processor_seconds, reference_of, steady_error
from ngpt.measure.averages import geometric_mean, median
from ngpt.measure.flip import flip
from ngpt.stack import GradientStack
from ngpt.subpixels import means, subpixels

# Name -> the images whose mean it is: K, and how features are declared
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
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", metavar="SCENE", help="none: only the table")
    add_references(parser)
    parser.add_argument("--size", default="192x108")
    parser.add_argument("--spp", type=int, nargs="+", default=[8, 16, 64, 256])
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    parser.add_argument("--ways", nargs="+", default=list(WAYS), choices=list(WAYS))
    parser.add_argument("-o", "--output", type=Path, default=Path("bench/results/subpixels.json"))
    args = parser.parse_args()
    check_references(parser, args)
    cells = json.loads(args.output.read_text())["cells"] if args.output.exists() else []
    result = {"benchmark": "subpixels", "metadata": metadata("mitsuba", "drjit", "mitsuba-oidn"), "cells": cells}
    known = {tuple(cell[name] for name in CELL) for cell in cells}
    for scene in args.scenes:
        for cell in measured(scene, args, known):
            cells.append(cell)
            save(args.output, result)
            print(*(cell[key] for key in CELL), f"{cell['seconds']:.2f} s", flush=True)
    show(cells)


def measured(scene: str, args: argparse.Namespace, known: set[tuple]) -> Iterator[dict[str, Any]]:
    """The cells of a scene that are not ``known``, one after the other."""
    load_scene, render_stack = renderer()
    gc.collect()  # a kernel knows the shapes of all scenes in memory
    with opened(CASES[scene].scene if scene in CASES else scene) as (name, file):
        name = scene if scene in CASES else name
        loaded = load_scene(file, tuple(map(int, args.size.split("x"))))
    reference = reference_of(loaded, name, args)
    clean, warm = clean_image(reference), False
    for spp in args.spp:
        able = [way for way in args.ways if max(k for k, _ in WAYS[way]) ** 2 <= spp]
        most = max(k for way in able for k, _ in WAYS[way])
        for seed in args.seeds:
            place = (name, args.size, spp, seed)
            if place in known:
                continue
            if not warm:
                warm = bool([render_stack(loaded, spp, 0, "primal", unbiased=False, subpixels=k) for k in (1, most)])
            start = processor_seconds()
            stack = render_stack(loaded, spp, seed, "primal", unbiased=False, subpixels=most)
            seconds = processor_seconds() - start
            images = {part: denoised(stack, *part) for part in {part for way in able for part in WAYS[way]}}
            ways = {}
            for way in able:
                each = [images[part] for part in WAYS[way]]
                image = np.mean([one for one, _ in each], axis=0, dtype=np.float32)
                ways[way] = {
                    "seconds": sum(taken for _, taken in each),
                    "error": steady_error(image, reference, clean),
                    "FLIP": flip(image, reference.mean)[0],
                }
            yield dict(zip(CELL, place, strict=True)) | {"seconds": seconds, "ways": ways}


def denoised(stack: GradientStack, k: int, auxiliary: str) -> tuple[np.ndarray, float]:
    """OIDN's image of K x K subpixels, and its seconds at the second call."""
    has = subpixels(stack.fine, stack.width)
    fine = {name: means(layer, has // k) for name, layer in stack.fine.items()} if k > 1 else {}
    given = replace(stack, fine=fine)
    ngpt.reconstruct(given, "oidn", auxiliary=auxiliary)
    start = processor_seconds()
    image = ngpt.reconstruct(given, "oidn", auxiliary=auxiliary).image
    return image, processor_seconds() - start


def show(cells: list[dict]) -> None:
    """A line for each size, number of samples and way: ratios of errors by scene, and means of all values."""
    for size, spp in sorted({(cell["size"], cell["spp"]) for cell in cells}):
        here = [cell for cell in cells if (cell["size"], cell["spp"]) == (size, spp)]
        scenes = list(dict.fromkeys(cell["scene"] for cell in here))
        print(f"\n{size}, {spp} spp: {', '.join(scenes)}\n")
        print("| way | error: mean | worst | FLIP: mean | worst | seconds | errors |\n|---|--:|--:|--:|--:|--:|---|")
        for way in (way for way in WAYS if way != BASE and way in here[0]["ways"]):
            by = {
                name: [
                    median([c["ways"][way][name] / c["ways"][BASE][name] for c in here if c["scene"] == scene])
                    for scene in scenes
                ]
                for name in ("error", "FLIP", "seconds")
            }
            ends = [geometric_mean(by["error"]), max(by["error"]), geometric_mean(by["FLIP"]), max(by["FLIP"])]
            ends += [geometric_mean(by["seconds"])]
            each = " ".join(f"{ratio:.2f}" for ratio in by["error"])
            print(f"| {way} | " + " | ".join(f"{end:.2f}" for end in ends) + f" | {each} |")


if __name__ == "__main__":
    main()
