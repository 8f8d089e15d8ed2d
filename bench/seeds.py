"""Shared tails over many seeds: how often an image is far off, and whether the noise is as large as claimed.

    python -m bench.seeds kitchen/scene.xml generator:3:partition --references FOLDER

The sampler is `primal`. Scenes are files, built-in names, or generator:SEED:SIGHT: a made scene with one sight of
``data_gen.scenes.procedural.variety.SHARES``. A cell, of a scene, number of samples and ``tails``, has:

    light      mean of the image over the mean of the reference: mean, least and most of the seeds
    deviation  real over claimed standard deviation of the image's light. The claim is the sum of the pixels' own
               variances, and the square of the mean of the layer ``shared`` as a mean over seeds
    blocks     real over claimed variance of 8x8 and of 32x32 pixels: of the sums over all blocks, and the median. It is
               below 1 for whole paths, because points in Z order let neighbours make up for each other
    error      after `oidn`, as ``steady`` of ``bench.tails``: geometric mean, median and worst of the seeds
    seconds    of processors, of the render and of OIDN

In the table the error at equal whole time is over the curve of whole paths, geometric means over seeds; marks are those
of ``bench.curves``. References are made as ``bench.tails`` makes them. ``--against`` names the folder of
another version of the code, which renders shared tails too. Cells that are measured again replace the old ones.
"""

import argparse
import gc
import json
import os
import subprocess
import sys
import tempfile
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

import ngpt
from bench.common import blocks, metadata, renderer, save
from bench.curves import error_at
from bench.tails import (
    TAILS,
    WARM_SPP,
    add_references,
    check_references,
    clean_image,
    digits,
    marked,
    processor_seconds,
    reference_of,
    steady_error,
    table,
)
from ngpt.evaluation.config import scene_name
from ngpt.measure.averages import geometric_mean

SIDES = (8, 32)
HEAD = ["scene", "spp", "tails", "light", "least .. most", "deviation", *(f"{n}x{n}, median" for n in SIDES)]
HEAD += ["error", "median", "worst", "worst / median", "whole s", "error at equal time"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", metavar="SCENE", help="none: only the table")
    add_references(parser)
    parser.add_argument("--variant")
    parser.add_argument("--size", default="320x180")
    parser.add_argument("--spp", type=int, nargs="+", default=[16, 64])
    parser.add_argument("--seeds", type=int, default=32, help="of shared tails")
    parser.add_argument("--paths-seeds", type=int, default=8, help="of whole paths")
    parser.add_argument("--against", type=Path, metavar="DIR", help="another version of the code")
    parser.add_argument("--code", default="", help=argparse.SUPPRESS)
    parser.add_argument("-o", "--output", type=Path, default=Path("bench/results/seeds.json"))
    args = parser.parse_args()
    check_references(parser, args)
    if args.scenes and min(args.seeds, args.paths_seeds) < 2:
        parser.error("give two seeds or more")
    result = {"benchmark": "seeds", "metadata": metadata("mitsuba", "drjit", "mitsuba-oidn"), "cells": []}
    if args.output.exists():
        result["cells"] = json.loads(args.output.read_text())["cells"]
    for scene in args.scenes:
        for cell in measured(scene, args):
            result["cells"] = [old for old in result["cells"] if place(old) != place(cell)] + [cell]
            save(args.output, result)
            print(*place(cell), f"{cell['seconds']:.2f} s", flush=True)
    if args.code:
        return
    if args.against and args.scenes:
        # The file runs without its folder: the other version has its own modules, and may lack this one.
        given = [sys.executable, "-P", __file__, *sys.argv[1:], "--code", args.against.resolve().name]
        path = f"{args.against.resolve()}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"
        subprocess.run(given, check=True, env=os.environ | {"PYTHONPATH": path})
        result = json.loads(args.output.read_text())
    table(HEAD, rows(result["cells"]))


def place(cell: dict[str, Any]) -> tuple:
    return tuple(cell[name] for name in ("scene", "size", "spp", "tails"))


@contextmanager
def opened(scene: str):
    """The name of a scene in tables and files, and the argument that loads it."""
    kind, *parts = scene.split(":")
    if kind != "generator" or len(parts) != 2:
        yield scene_name(scene), scene
        return
    from data_gen.scenes.procedural.scenes import make_scene
    from data_gen.scenes.procedural.variety import SHARES

    seed, sight = parts
    with tempfile.TemporaryDirectory(prefix="ngpt-scene-") as folder:
        shares = dict.fromkeys(SHARES, 0.0)
        shares[sight] = 1.0
        yield f"generator-{seed}-{sight}", str(make_scene(int(seed), Path(folder), shares))


def measured(scene: str, args: argparse.Namespace):
    """The cells of a scene, one after the other."""
    load_scene, render_stack = renderer(args.variant)
    # A kernel knows the shapes of all scenes in memory.
    gc.collect()
    with opened(scene) as (name, file):
        loaded = load_scene(file, tuple(map(int, args.size.split("x"))))
        reference = reference_of(loaded, name, args)
        clean = clean_image(reference)
        for tails in ["shared"] if args.code else TAILS:
            ngpt.reconstruct(render_stack(loaded, WARM_SPP, 0, "primal", tails=tails), "oidn")
            label = f"{tails}, {args.code}" if args.code else tails
            for spp in args.spp:
                layers, found, seconds = [], [], []
                for seed in range(1, 1 + (args.seeds if tails == "shared" else args.paths_seeds)):
                    start = processor_seconds()
                    stack = render_stack(loaded, spp, seed, "primal", tails=tails)
                    image = ngpt.reconstruct(stack, "oidn").image
                    seconds.append(processor_seconds() - start)
                    found.append(steady_error(image, reference, clean))
                    layers.append({each: stack[each] for each in ("primal", "primal_var", "shared") if each in stack})
                light = [each["primal"].mean(dtype=float) / reference.mean.mean(dtype=float) for each in layers]
                cell = {"scene": name, "size": args.size, "spp": spp, "tails": label, "seeds": len(seconds)}
                cell |= {"seconds": float(np.mean(seconds)), "light": spread(light), "error": errors(found)}
                yield cell | noise(layers)


def spread(values: list[float]) -> dict[str, float]:
    return {"mean": float(np.mean(values)), "least": float(min(values)), "most": float(max(values))}


def errors(values: list[float]) -> dict[str, float]:
    return {"mean": geometric_mean(values), "median": float(np.median(values)), "worst": float(max(values))}


def noise(stacks: list[dict[str, np.ndarray]]) -> dict[str, Any]:
    """Real over claimed noise: ``deviation`` of the image's light, and ``blocks`` of variances by side of the block.

    ``stacks`` are two seeds or more with ``primal``, ``primal_var`` and, if paths share their tails, ``shared``,
    (H, W, 3) each. Values without a claim are None.
    """
    primal, own = (np.array([stack[name] for stack in stacks], np.float64) for name in ("primal", "primal_var"))
    shared = np.zeros_like(primal)
    if all("shared" in stack for stack in stacks):
        from ngpt.shared import shared_variance  # other versions of the code may not have it

        shared = np.array([stack["shared"] for stack in stacks], np.float64)
        own = np.maximum(own - np.array([shared_variance(layer) for layer in shared]), 0)

    def ratios(means, pixels: int) -> dict[str, float | None]:
        real, claimed = means(primal).var(axis=0, ddof=1), (means(own) / pixels + means(shared) ** 2).mean(axis=0)
        told = claimed.mean(axis=-1) > 0
        each = real.mean(axis=-1)[told] / claimed.mean(axis=-1)[told]
        return {"sum": float(real.sum() / claimed.sum()), "median": float(np.median(each))} if each.size else {}

    whole = ratios(lambda layers: layers.mean(axis=(1, 2)), primal[0, ..., 0].size)
    by_side = {str(side): ratios(lambda layers, side=side: blocks(layers, side), side * side) for side in SIDES}
    return {"deviation": whole["sum"] ** 0.5 if whole else None, "blocks": by_side}


def rows(cells: list[dict[str, Any]]) -> list[list[str]]:
    """A line of the table for each cell, by scene, number of samples and tails."""
    lines = []
    for cell in sorted(cells, key=place):
        paths = [c for c in cells if (c["scene"], c["size"], c["tails"]) == (cell["scene"], cell["size"], "paths")]
        answer = error_at(
            cell["seconds"], [(c["seconds"], c["error"]["mean"]) for c in paths if c["error"]["mean"] > 0]
        )
        ratio = (cell["error"]["mean"] / answer[0], answer[1]) if answer and cell["tails"] != "paths" else None
        light, error = cell["light"], cell["error"]
        line = [f"{cell['scene']} {cell['size']}", str(cell["spp"]), cell["tails"]]
        line += [f"{light['mean']:.4f}", f"{light['least']:.3f} .. {light['most']:.3f}", digits(cell["deviation"])]
        line += [f"{digits(by.get('sum'))}, {digits(by.get('median'))}" for by in cell["blocks"].values()]
        line += [digits(error[name]) for name in ("mean", "median", "worst")]
        lines.append([*line, f"{error['worst'] / error['median']:.2f}", f"{cell['seconds']:.2f}", marked(ratio)])
    return lines


if __name__ == "__main__":
    main()
