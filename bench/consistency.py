"""Error against the number of samples: paths that share their tails, and whole paths.

    python -m bench.consistency room/scene.xml diffuse --variant cuda_ad_rgb

The sampler is `primal`, without a reconstruction. For each scene, number of samples and ``tails``:

    error    relMSE by two halves of a reference of whole paths, so that it has no noise of the reference in it
    blocks   the same of means over 8x8 pixels, where bias shows and noise does not
    energy   mean of the image over the mean of the reference

Values are means over seeds. A rate is an error over the error at the next number of samples in the table. If that is
four times as many, pure noise has a rate of 4. Cells of a scene and size that are measured again replace the old ones.
"""

import argparse
import gc
import json
from pathlib import Path
from typing import Any

import numpy as np

from bench.common import blocks, metadata, renderer, save
from bench.tails import REFERENCE_SEED, TAILS
from ngpt.evaluation.config import scene_name
from ngpt.measure.metrics import relmse_trimmed


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", metavar="SCENE", help="files or built-in names; none: only the table")
    parser.add_argument("--variant", default="llvm_ad_rgb")
    parser.add_argument("--size", default="320x180")
    parser.add_argument("--spp", type=int, nargs="+", default=[16, 64, 256, 1024, 4096])
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--reference-spp", type=int, default=16384, help="of each half")
    parser.add_argument("-o", "--output", type=Path, default=Path("bench/results/consistency.json"))
    args = parser.parse_args()
    result = {"benchmark": "consistency", "metadata": metadata("mitsuba", "drjit"), "cells": []}
    if args.output.exists():
        result["cells"] = json.loads(args.output.read_text())["cells"]
    for scene in args.scenes:
        cells = measured(scene, args)
        place = (cells[0]["scene"], cells[0]["size"])
        result["cells"] = [cell for cell in result["cells"] if (cell["scene"], cell["size"]) != place] + cells
        save(args.output, result)
    show(result["cells"])


def measured(scene: str, args: argparse.Namespace) -> list[dict[str, Any]]:
    load_scene, render_stack = renderer(args.variant)
    # A kernel knows the shapes of all scenes in memory.
    gc.collect()
    loaded = load_scene(scene, tuple(map(int, args.size.split("x"))))

    def image(spp: int, seed: int, tails: str) -> np.ndarray:
        return render_stack(loaded, spp, seed, "primal", tails=tails)["primal"].astype(np.float64)

    halves = [image(args.reference_spp, REFERENCE_SEED + i, "paths") for i in range(2)]
    cells = []
    for spp in args.spp:
        for tails in TAILS:
            each = [judged(image(spp, seed, tails), halves) for seed in args.seeds]
            values = {name: float(np.mean([values[name] for values in each])) for name in each[0]}
            cells.append({"scene": scene_name(scene), "size": args.size, "spp": spp, "tails": tails, **values})
            print(cells[-1], flush=True)
    return cells


def judged(image: np.ndarray, halves: list[np.ndarray]) -> dict[str, float]:
    return {
        "error": relmse_trimmed(image, *halves),
        "blocks": relmse_trimmed(*(blocks(each) for each in (image, *halves))),
        "energy": float(image.mean() / np.mean(halves)),
    }


def show(cells: list[dict[str, Any]]) -> None:
    print("| scene | spp | error, paths | shared | rate, paths | shared | blocks, paths | shared | energy, shared |")
    print("|---|--:|--:|--:|--:|--:|--:|--:|--:|")
    found = {(cell["scene"], cell["size"], cell["spp"], cell["tails"]): cell for cell in cells}
    for scene, size in dict.fromkeys(key[:2] for key in found):
        before: dict[str, float] = {}
        for spp in sorted({key[2] for key in found if key[:2] == (scene, size)}):
            of = {tails: found[scene, size, spp, tails] for tails in TAILS}
            rates = [f"{before[tails] / of[tails]['error']:.2f}" if before else "" for tails in TAILS]
            before = {tails: of[tails]["error"] for tails in TAILS}
            values = [f"{of[tails][name]:.3g}" for name in ("error", "blocks") for tails in TAILS]
            line = [f"{scene} {size}", str(spp), *values[:2], *rates, *values[2:], f"{of['shared']['energy']:.4f}"]
            print(f"| {' | '.join(line)} |")


if __name__ == "__main__":
    main()
