"""The value of subpixels: errors and seconds of denoisers on K x K subpixels of each pixel, relative to pixels.

    python -m bench.subpixels living-room/scene.xml generator:20261211:partition --references FOLDER

The sampler is `primal`, with shared tails where they work. A scene, number of samples and seed is rendered once, with
as many subpixels as any way needs; fewer are their means. A way with K x K subpixels is left out below K² samples per
pixel, where some subpixels would have none. Scenes and references are as of `bench.seeds`, and scenes of `bench.panel`
have their names there. Ways to denoise are in WAYS. Each cell has, of each way:

    seconds  of processors, warmed up
    error    relMSE by two halves of a reference, without the worst 0.1 % of the pixels; FLIP is over their mean

and the noise of features, and whether it is small compared to the image's (``ngpt.denoisers.clean``).

The table shows the ratio of each value to the value of ``BASE``: the median over seeds.
"""

import argparse
import gc
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import ngpt
from bench.common import metadata, renderer, save
from bench.seeds import opened
from bench.tails import add_references, check_references, processor_seconds, reference_of
from ngpt.denoisers.clean import features_are_clean
from ngpt.evaluation.references import Reference
from ngpt.layers import FEATURE_NOISE
from ngpt.measure.averages import geometric_mean, median
from ngpt.measure.metrics import scores
from ngpt.repair import repair
from ngpt.stack import GradientStack
from ngpt.subpixels import means, subpixels

# Name -> method, K, and how features are declared to OIDN; "" leaves that to the method
WAYS = {
    "1 prefiltered": ("oidn", 1, "prefiltered"),
    "1 noisy": ("oidn", 1, "noisy"),
    "2 noisy": ("oidn", 2, "noisy"),
    "2 clean": ("oidn", 2, "clean"),
    "2 prefiltered": ("oidn", 2, "prefiltered"),
    "4 noisy": ("oidn", 4, "noisy"),
    "1 ngpt-primal": ("ngpt-primal", 1, ""),
    "2 ngpt-primal": ("ngpt-primal", 2, ""),
}
BASE = "1 prefiltered"
CELL = ("scene", "size", "spp", "seed")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", metavar="SCENE", help="none: only the table")
    add_references(parser)
    parser.add_argument("--size", default="320x180")
    parser.add_argument("--spp", type=int, nargs="+", default=[4, 8, 16, 32, 64, 128])
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    parser.add_argument("--ways", nargs="+", default=list(WAYS), choices=list(WAYS))
    parser.add_argument("-o", "--output", type=Path, default=Path("bench/results/subpixels.json"))
    args = parser.parse_args()
    check_references(parser, args)
    cells = json.loads(args.output.read_text())["cells"] if args.output.exists() else []
    result = {"benchmark": "subpixels", "metadata": metadata("mitsuba", "drjit", "mitsuba-oidn"), "cells": cells}
    known = {tuple(cell[name] for name in CELL) for cell in cells}
    for scene in args.scenes:
        with opened(scene) as (name, file):
            for cell in measured(name, file, args, known):
                cells.append(cell)
                save(args.output, result)
                print(*(cell[key] for key in CELL), f"{cell['seconds']:.2f} s", flush=True)
    show(cells)


def measured(name: str, file: str, args: argparse.Namespace, known: set[tuple]):
    """The cells of a scene that are not ``known``, one after the other."""
    load_scene, render_stack = renderer()
    gc.collect()  # a kernel knows the shapes of all scenes in memory
    loaded = load_scene(file, tuple(map(int, args.size.split("x"))))
    reference = reference_of(loaded, name, args)
    warm, most = False, max(WAYS[way][1] for way in args.ways)
    for spp in args.spp:
        for seed in args.seeds:
            place = (name, args.size, spp, seed)
            if place in known:
                continue
            start = processor_seconds()
            stack = render_stack(loaded, spp, seed, "primal", unbiased=False, subpixels=most)
            seconds = processor_seconds() - start
            if not warm:
                warm = bool([judged(stack, way, reference) for way in args.ways])
            ways = {way: judged(stack, way, reference) for way in args.ways}
            noise = {"feature noise": stack.number(FEATURE_NOISE), "clean": features_are_clean(repair(stack))}
            yield dict(zip(CELL, place, strict=True)) | {"seconds": seconds, "ways": ways} | noise


def with_subpixels(stack: GradientStack, k: int) -> GradientStack:
    """The stack with the means of its subpixels, so that K is ``k``."""
    fine = (
        {name: means(layer, subpixels(stack.fine, stack.width) // k) for name, layer in stack.fine.items()}
        if k > 1
        else {}
    )
    return replace(stack, fine=fine)


def judged(stack: GradientStack, way: str, reference: Reference) -> dict[str, float]:
    method, k, auxiliary = WAYS[way]
    options: dict[str, Any] = {"auxiliary": auxiliary} if auxiliary else {}
    given = with_subpixels(stack, k)
    start = processor_seconds()
    image = ngpt.reconstruct(given, method, **options).image
    seconds = processor_seconds() - start
    found = scores(["relMSE trimmed", "FLIP"], image, *reference.images)
    return {"seconds": seconds, "error": found["relMSE trimmed"], "FLIP": found["FLIP"]}


def show(cells: list[dict]) -> None:
    """Tables of ratios: a line for each size, number of samples and way, with a column for each scene."""
    scenes = list(dict.fromkeys(cell["scene"] for cell in cells))
    sizes = sorted({(cell["size"], cell["spp"]) for cell in cells}, key=lambda each: (each[0], each[1]))
    print("| size, spp | way | " + " | ".join(scenes) + " | mean | FLIP | seconds |")
    print("|---|---|" + "--:|" * (len(scenes) + 3))
    for size, spp in sizes:
        of = {
            scene: [c["ways"] for c in cells if (c["scene"], c["size"], c["spp"]) == (scene, size, spp)]
            for scene in scenes
        }
        for way in WAYS:
            ratios = {
                name: [
                    median([ways[way][name] / ways[BASE][name] for ways in of[scene] if way in ways])
                    for scene in scenes
                ]
                for name in ("error", "FLIP", "seconds")
            }
            if way == BASE or not any(ratios["error"]):
                continue
            each = " | ".join("-" if r is None else f"{r:.2f}" for r in ratios["error"])
            ends = " | ".join(f"{geometric_mean([r for r in ratios[name] if r]):.2f}" for name in ratios)
            print(f"| {size}, {spp} | {way} | {each} | {ends} |")


if __name__ == "__main__":
    main()
