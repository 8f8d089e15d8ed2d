"""Bidirectional samplers at equal time: `path`, `bdpt`, `gpt` and `gbdpt`, with l1, wcv, the networks and OIDN.

    python -m bench.bidirectional --scenes diffuse glossy SCENE.xml ... --out FOLDER

An evaluation (`ngpt evaluate`, docs/evaluation.md) whose clock is `gpt`: all samplers are given the time of --spp of
its samples, but never less than two passes. What it makes is kept in FOLDER, where a run that was broken off goes on.
References are two halves of --reference-spp samples by `bdpt`, since `path` has hardly any light where `bdpt` pays;
where `bdpt` refuses a scene, by `path`. Written are errors (trimmed relMSE, median over seeds), samples and seconds of
each column, losses included, and each error over the least of its scene.
"""

import argparse
import statistics
from pathlib import Path
from typing import Any

from bench.common import metadata, save
from ngpt.errors import NgptError
from ngpt.evaluation.config import Config, scene_name
from ngpt.evaluation.references import HALVES
from ngpt.evaluation.run import evaluate
from ngpt.evaluation.stacks import REFERENCE_SEED
from ngpt.io.exr import write
from ngpt.system.console import Console

METHODS = ("path", "bdpt", "l1", "wcv", "ngpt-fast", "ngpt-combine", "ngpt-primal", "oidn")
# Images as they are, of which those by `bdpt` have features in any case.
VARIANTS = {
    "path": {"method": "primal", "stack": "path", "sampler": "primal"},
    "bdpt": {"method": "primal", "stack": "features", "sampler": "bdpt"},
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", required=True)
    parser.add_argument("--out", type=Path, required=True, metavar="FOLDER")
    parser.add_argument("--size", type=int, nargs=2, default=(96, 64), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--spp", type=int, default=128, help="of gpt (default %(default)s)")
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--reference-spp", type=int, default=2048)
    parser.add_argument("-o", "--output", default="bench/results/bidirectional.json")
    args = parser.parse_args()

    from data_gen.backend import use_variant

    use_variant()
    setup = {"size": list(args.size), "spp": args.spp, "seeds": args.seeds, "reference spp": args.reference_spp}
    result: dict = {"benchmark": "bidirectional"} | setup | {"metadata": metadata("mitsuba"), "scenes": {}}
    for scene in args.scenes:
        row = result["scenes"][scene_name(scene)] = bench_scene(scene, args)
        save(args.output, result)
        print(
            scene_name(scene), *(f"{name} {cell['over least']:.3g}" for name, cell in row.items()), sep="  ", flush=True
        )


def bench_scene(scene: str, args: argparse.Namespace) -> dict[str, dict[str, float]]:
    """Column -> its error, that over the least of the scene, samples for each pixel, and seconds of rendering."""
    name, out = scene_name(scene), args.out / scene_name(scene)
    halves = reference(scene, out, args)
    config = Config(
        title=f"Bidirectional samplers at equal time: {name}",
        scenes=(scene,),
        size=tuple(args.size),
        spp=(args.spp,),
        seeds=args.seeds,
        methods=METHODS,
        samplers=("gpt", "gbdpt"),
        rivals=("primal", "bdpt"),
        clock="gpt",
        metrics=("relMSE trimmed", "FLIP"),
        reference_spp=args.reference_spp,
        references={name: halves} if halves else {},
        variants=VARIANTS,
    )
    cells = evaluate(config, out, Console(quiet=True), "python -m bench.bidirectional")["cells"]
    rows: dict[str, list[dict[str, Any]]] = {}
    for cell in cells:
        if not cell["absent"]:
            rows.setdefault(cell["method"], []).append(cell)
    errors = {name: statistics.median(c["metrics"]["relMSE trimmed"] for c in found) for name, found in rows.items()}
    least = min(errors.values())
    return {
        name: {
            "error": error,
            "over least": error / least,
            "FLIP": statistics.median(cell["metrics"]["FLIP"] for cell in rows[name]),
            "spp": rows[name][0]["spp used"],
            "seconds": statistics.median(cell["seconds"]["render"] for cell in rows[name]),
        }
        for name, error in errors.items()
    }


def reference(scene: str, out: Path, args: argparse.Namespace) -> list[str]:
    """The files of two halves by `bdpt`; none where it refuses the scene."""
    from data_gen.render import render_stack
    from data_gen.scenes.load import load_scene

    setup = f"{args.size[0]}x{args.size[1]}-{args.reference_spp}"
    paths = [out / f"reference-{setup}{half}.exr" for half in HALVES]
    out.mkdir(parents=True, exist_ok=True)
    for i, path in enumerate(paths):
        if not path.exists():
            try:
                stack = render_stack(
                    load_scene(scene, tuple(args.size)), args.reference_spp // 2, REFERENCE_SEED + i, "bdpt"
                )
            except NgptError:
                return []
            write(path, stack)
    return [str(path) for path in paths]


if __name__ == "__main__":
    main()
