"""KPCN beside denoisers that need no split light, on the same stacks: the table of docs/methods/kpcn.md.

    python -m bench.kpcn --cache DIR --networks kpcn-small=runs/kpcn-small/weights.safetensors --scenes glossy SCENE.xml

Renders stacks by the sampler `split` and references by `primal`, two halves (kept in the cache folder), and prints
errors as Markdown: trimmed relMSE without the noise of the reference, and FLIP. All methods see the same samples.
--table prints the table of the file.
"""

import argparse
import json
from pathlib import Path

import numpy as np

import ngpt
from bench.common import metadata, save
from ngpt.evaluation.config import scene_name
from ngpt.measure.metrics import scores
from ngpt.stack import GradientStack

METRICS = ("relMSE trimmed", "FLIP")
METHODS = ("primal", "nfor", "oidn")
# Seeds of the halves of a reference, beside that of the stacks.
STACK, HALVES = 0, (1001, 1002)
RESULT = Path(__file__).parent / "results" / "kpcn.json"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cache", type=Path, help="folder for the rendered stacks and references")
    parser.add_argument("--networks", nargs="*", default=[], metavar="NAME=FILE")
    parser.add_argument("--scenes", nargs="+", default=["glossy", "environment", "lens"])
    parser.add_argument("--size", type=int, nargs=2, default=(128, 72), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--spp", type=int, nargs="+", default=[4, 16, 64])
    parser.add_argument("--reference-spp", type=int, default=1024)
    parser.add_argument("--table", action="store_true")
    args = parser.parse_args()
    if not args.table:
        if args.cache is None:
            parser.error("--cache: a folder for stacks and references is needed")
        save(RESULT, measured(args))
    print(table(json.loads(RESULT.read_text())))


def measured(args: argparse.Namespace) -> dict:
    """Errors of each method in each cell, (scene, samples)."""
    from data_gen.backend import use_variant

    use_variant()
    args.cache.mkdir(parents=True, exist_ok=True)
    networks = dict(named.split("=", 1) for named in args.networks)
    cells = []
    for scene in args.scenes:
        halves = [cached(scene, args.reference_spp // 2, "primal", seed, args)["primal"] for seed in HALVES]
        for spp in args.spp:
            stack = cached(scene, spp, "split", STACK, args)
            images = {method: ngpt.denoise(stack, method) for method in METHODS}
            images |= {name: ngpt.denoise(stack, "auto", weights=file) for name, file in networks.items()}
            found = {name: scores(METRICS, image, *halves) for name, image in images.items()}
            cells.append({"scene": scene_name(scene), "spp": spp, "errors": found})
    about = {"size": list(args.size), "reference_spp": args.reference_spp}
    return {**about, "cells": cells, "metadata": metadata("mitsuba", "mitsuba-oidn", "torch")}


def cached(scene: str, spp: int, sampler: str, seed: int, args: argparse.Namespace) -> GradientStack:
    """A rendered stack, from the cache if it is there."""
    from data_gen.render import render_stack
    from data_gen.scenes.load import load_scene

    width, height = args.size
    path = args.cache / f"{scene_name(scene)}-{sampler}-{spp}-{seed}-{width}x{height}.exr"
    if not path.exists():
        print(f"rendering {path.name}", flush=True)
        ngpt.write(path, render_stack(load_scene(scene, (width, height)), spp, seed, sampler))
    return ngpt.read(path)


def table(result: dict) -> str:
    """Markdown: a row for each scene and sample count, relMSE and FLIP of each method, and geometric means."""
    cells = result["cells"]
    methods = list(cells[0]["errors"])
    counts = sorted({cell["spp"] for cell in cells})
    heads = [f"`{method}`" for method in methods]
    lines = [f"| scene | spp | {' | '.join(heads)} |", "|---|--:|" + "--:|" * len(methods)]
    for cell in cells:
        lines.append(f"| {cell['scene']} | {cell['spp']} | {row([cell['errors'][method] for method in methods])} |")
    for spp in counts:
        these = [cell["errors"] for cell in cells if cell["spp"] == spp]
        means = [{m: float(np.exp(np.mean([np.log(e[name][m]) for e in these]))) for m in METRICS} for name in methods]
        lines.append(f"| *geometric mean* | {spp} | {row(means)} |")
    return "\n".join(lines)


def row(errors: list[dict[str, float]]) -> str:
    """The cells of a row, the least error of each metric bold; that of the first method, the input, never is."""
    least = [min(error[metric] for error in errors[1:]) for metric in METRICS]

    def text(value: float, best: float, digits: int) -> str:
        number = f"{value:.2g}" if digits == 0 else f"{value:.{digits}f}"
        return f"**{number}**" if value == best else number

    return " | ".join(
        ", ".join(
            text(error[metric], best, digits) for metric, best, digits in zip(METRICS, least, (0, 3), strict=True)
        )
        for error in errors
    )


if __name__ == "__main__":
    main()
