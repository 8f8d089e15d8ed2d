"""What a pass costs before its first ray, here and at an earlier commit: bench/results/recording.json.

    python -m bench.recording --before COMMIT [--scenes diffuse path/scene.xml ...] [--samplers gpt primal ...]

    pass      processor seconds of a pass of 16x16 pixels, one sample each, with kernels compiled before: nearly all of
              it is Python that records them. The first pass of a render, and the median of the later ones
    render    processor seconds of whole renders of --size at --spp, and C, `gpt`'s seconds over `primal`'s

Both trees take turns. On a busy machine only processor time means anything.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from bench.common import metadata, save, summary
from bench.speed import git

WORKER, PASSES = "--worker", 6


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--before", metavar="COMMIT", required=True)
    parser.add_argument("--scenes", nargs="+", default=["diffuse", "glossy"])
    parser.add_argument("--samplers", nargs="+", default=["gpt", "primal"])
    parser.add_argument("--size", default="320x180")
    parser.add_argument("--spp", type=int, default=64, help="0: no whole renders")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("-o", "--output", type=Path, default=Path("bench/results/recording.json"))
    args = parser.parse_args()
    result = {"benchmark": "recording", **vars(args), "metadata": metadata("mitsuba", "drjit"), "rows": {}}
    del result["output"]
    with tempfile.TemporaryDirectory() as folder:
        old = Path(folder) / "old"
        git("worktree", "add", "--detach", str(old), args.before)
        try:
            for scene in args.scenes:
                runs: dict[str, list[dict]] = {"before": [], "now": []}
                for _ in range(args.repeats):
                    for name, tree in (("before", old), ("now", Path(__file__).parents[1])):
                        runs[name].append(told_by(tree, scene, args))
                row = {name: spread(each) for name, each in runs.items()}
                result["rows"][Path(scene).parent.name or scene] = row
                print(scene, json.dumps({name: medians(each) for name, each in row.items()}, indent=1), flush=True)
        finally:
            git("worktree", "remove", "--force", str(old))
    save(args.output, result)


def told_by(tree: Path, scene: str, args: argparse.Namespace) -> dict[str, float]:
    """What this file, in a process of its own, measures in the code of ``tree``."""
    # Without -P the folder of this file would hide modules of the same names.
    call = [sys.executable, "-P", __file__, WORKER, scene, args.size, str(args.spp), *args.samplers]
    done = subprocess.run(
        call, env=os.environ | {"PYTHONPATH": str(tree)}, cwd=tree, stdout=subprocess.PIPE, text=True, check=True
    )
    return json.loads(done.stdout.splitlines()[-1])


def spread(runs: list[dict[str, float]]) -> dict[str, dict]:
    return {key: summary([run[key] for run in runs]) for key in runs[0]}


def medians(row: dict[str, dict]) -> dict[str, float]:
    return {key: round(value["median"], 3) for key, value in row.items()}


def work(name: str, size: str, spp: int, samplers: list[str]) -> None:
    from data_gen.backend import use_variant

    use_variant()
    from data_gen.render import render_stack
    from data_gen.scenes.load import load_scene

    told: dict[str, float] = {}
    small = load_scene(name, (16, 16))
    for sampler in samplers:
        passes(small, sampler, 2)
        each = passes(small, sampler, PASSES)
        told |= {f"first pass {sampler}": each[0], f"later pass {sampler}": sorted(each[1:])[len(each) // 2 - 1]}
    if spp:
        scene, seconds = load_scene(name, tuple(map(int, size.split("x")))), {}
        for sampler in ("gpt", "primal"):
            render_stack(scene, 1, 0, sampler)
            start = time.process_time()
            render_stack(scene, spp, 0, sampler)
            told[f"render {sampler}"] = seconds[sampler] = time.process_time() - start
        told["C"] = seconds["gpt"] / seconds["primal"]
    print(json.dumps(told), flush=True)


def passes(scene, name: str, count: int) -> list[float]:
    """Processor seconds of so many passes of a render."""
    import drjit as dr

    from data_gen.film import GradientFilm
    from data_gen.passes import recording
    from data_gen.paths.camera import CameraSamples
    from data_gen.samplers import SAMPLERS

    entry, seconds = SAMPLERS[name], []
    film, sample = GradientFilm(16, 16, batches=bool(entry.batch)), entry.made(scene)
    for i in range(count):
        start = time.process_time()
        with recording():
            sample(CameraSamples(scene.sensors()[0], 0, 1, i), film)
            film.end_pass(1)
            dr.sync_thread()
        seconds.append(time.process_time() - start)
    return seconds


if __name__ == "__main__":
    work(sys.argv[2], sys.argv[3], int(sys.argv[4]), sys.argv[5:]) if sys.argv[1:2] == [WORKER] else main()
