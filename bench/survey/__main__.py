"""Error of every row of section 5 of the survey, by scene and samples per pixel: docs/methods/reconstructions.md.

    python -m bench.survey --scenes diffuse SCENE.xml ... --cache out/survey [--references FOLDER]

Stacks are made of --runs renders by `gpt`, since gradient resampling draws from runs. References are two halves:
NAME-a.exr and NAME-b.exr of --references where they are there, else rendered with --reference-spp samples each. Errors
are trimmed relMSE without the references' noise, at equal samples; OIDN's are of the same stacks. What is in the cache
is not rendered again, and what is in the file not measured again. --table prints the tables of the file.

With --stacks, the folder of an evaluation's cache (NAME-.../gradients-SPP-0.exr), stacks are those, and rows that draw
from runs are left out.
"""

import argparse
import json
import math
import time
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path

import numpy as np

import ngpt
from bench.common import metadata, save
from bench.survey.rows import RESAMPLED, image_of, usable
from ngpt.evaluation.config import scene_name
from ngpt.io.exr import read_image
from ngpt.measure.metrics import relmse_trimmed
from ngpt.merging import merge
from ngpt.stack import GradientStack

_REFERENCE_SEED = 1 << 20


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=[])
    parser.add_argument("--spp", nargs="+", type=int, default=[4, 16, 64, 256])
    parser.add_argument("--runs", type=int, default=4, help="that a stack is made of (default %(default)s)")
    parser.add_argument("--size", type=int, nargs=2, default=(160, 90), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--cache", type=Path, default=Path("out/survey"), help="folder for runs and references")
    parser.add_argument("--stacks", type=Path, help="folder of rendered stacks: the cache of `ngpt evaluate`")
    parser.add_argument("--references", type=Path, help="folder of references in two halves")
    parser.add_argument("--reference-spp", type=int, default=1024, help="of each half")
    parser.add_argument("--rows", nargs="+", default=usable(), help="those to measure")
    parser.add_argument("--table", action="store_true", help="print the tables of the file, and measure nothing")
    parser.add_argument("-o", "--output", type=Path, default=Path("bench/results/survey.json"))
    args = parser.parse_args()
    if args.table:
        print(*tables(json.loads(args.output.read_text())["scenes"]), sep="\n")
        return

    from data_gen.backend import use_variant

    use_variant()
    args.cache.mkdir(parents=True, exist_ok=True)
    setup = {"size": list(args.size), "runs": args.runs, "reference spp": args.reference_spp}
    result: dict = {"benchmark": "survey"} | setup | {"scenes": {}}
    if args.output.exists():
        result["scenes"] = json.loads(args.output.read_text())["scenes"]
    for scene in args.scenes:
        cells = result["scenes"].setdefault(scene_name(scene), {})
        halves = references(scene, args)
        for spp in args.spp:
            runs, merged = stacks(scene, spp, args)
            row = cells.setdefault(str(spp), {})
            for name in args.rows:
                if name in row or (name in RESAMPLED and not runs):
                    continue
                start = time.process_time()
                image = image_of(name, merged, runs)
                seconds = time.process_time() - start
                energy = float(image.sum(dtype=np.float64) / sum(half.sum(dtype=np.float64) / 2 for half in halves))
                row[name] = {"error": relmse_trimmed(image, *halves), "energy": energy, "seconds": seconds}
            print(scene_name(scene), spp, *(f"{name} {cell['error']:.4g}" for name, cell in row.items()), flush=True)
            save(args.output, result | {"metadata": metadata("mitsuba", "onnxruntime", "mitsuba-oidn")})


def stacks(scene: str, spp: int, args: argparse.Namespace) -> tuple[list[GradientStack], GradientStack]:
    """The runs, and the stack of them all."""
    if args.stacks:
        return [], ngpt.read(next(args.stacks.glob(f"{scene_name(scene)}-*/gradients-{spp}-0.exr")))
    runs = [cached(scene, spp // args.runs, "gpt", seed, args) for seed in range(args.runs)]
    return runs, merge(runs)


def references(scene: str, args: argparse.Namespace) -> list[np.ndarray]:
    """Two halves, (H, W, 3) each."""
    files = [args.references / f"{scene_name(scene)}-{half}.exr" for half in "ab"] if args.references else []
    if files and all(file.exists() for file in files):
        return [read_image(file) for file in files]
    seeds = (_REFERENCE_SEED, _REFERENCE_SEED + 1)
    return [cached(scene, args.reference_spp, "primal", seed, args)["primal"] for seed in seeds]


def cached(scene: str, spp: int, sampler: str, seed: int, args: argparse.Namespace) -> GradientStack:
    """A rendered stack, from the cache if it is there."""
    from data_gen.render import render_stack

    width, height = args.size
    path = args.cache / f"{scene_name(scene)}-{sampler}-{spp}-{seed}-{width}x{height}.exr"
    if not path.exists():
        ngpt.write(path, render_stack(loaded(scene, width, height), spp, seed, sampler))
    return ngpt.read(path)


@lru_cache(maxsize=1)
def loaded(scene: str, width: int, height: int):
    """The last scene asked for: to load one takes longer than some of the renders."""
    from data_gen.scenes.load import load_scene

    return load_scene(scene, (width, height))


def tables(scenes: dict) -> Iterable[str]:
    """Markdown: geometric means of errors over those of wcv, a row each; then each scene's."""
    counts = sorted({spp for cells in scenes.values() for spp in cells}, key=int)
    names = [name for cells in scenes.values() for row in cells.values() for name in row]
    names = list(dict.fromkeys(names))
    yield "| row | " + " | ".join(f"{spp} spp" for spp in counts) + " | energy | seconds |"
    yield "|---|" + "--:|" * (len(counts) + 2)
    for name in names:
        rows = {spp: [cells[spp] for cells in scenes.values() if spp in cells and name in cells[spp]] for spp in counts}
        values = [mean(row[name]["error"] / row["wcv"]["error"] for row in rows[spp]) for spp in counts]
        energies = sorted(row[name]["energy"] for spp in counts for row in rows[spp])
        seconds = sorted(row[name]["seconds"] for spp in counts for row in rows[spp])
        middle = len(energies) // 2
        cells = [f"{value:.2f}" for value in values] + [f"{energies[middle]:.3f}", f"{seconds[middle]:.2f}"]
        yield f"| `{name}` | " + " | ".join(cells) + " |"
    for spp in counts:
        yield ""
        yield f"| {spp} spp | " + " | ".join(scenes) + " |"
        yield "|---|" + "--:|" * len(scenes)
        for name in names:
            errors = [cells.get(spp, {}).get(name, {}).get("error") for cells in scenes.values()]
            yield f"| `{name}` | " + " | ".join("" if e is None else f"{e:.4g}" for e in errors) + " |"


def mean(ratios: Iterable[float]) -> float:
    """The geometric mean; errors without the references' noise may be 0 or less, and count as next to nothing."""
    logs = [math.log(max(ratio, 1e-6)) for ratio in ratios]
    return math.exp(sum(logs) / len(logs)) if logs else math.nan


if __name__ == "__main__":
    main()
