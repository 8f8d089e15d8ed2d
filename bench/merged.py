"""What a render takes, once its kernels are compiled, with the meshes of a scene merged by material and as they are.

    python -m bench.merged SCENE.xml ... -o bench/results/merged.json

Seconds of renders of one sample at 64x36 pixels, which is what it takes to begin one, and of 16 samples at 320x180; in
turns, the median of six and their spread (largest over least).
"""

import argparse
import gc
import statistics
import time
from pathlib import Path

from bench.common import metadata, save

ROUNDS, TIMES = 2, 3
RENDERS = {"begin": ((64, 36), 1), "render": ((320, 180), 16)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+")
    parser.add_argument("--samplers", nargs="+", default=["gpt", "primal"])
    parser.add_argument("-o", "--output", type=Path, default=Path("bench/results/merged.json"))
    args = parser.parse_args()
    from data_gen.backend import use_variant

    use_variant()
    rows = []
    print("| scene | meshes | merged | sampler | begin | ratio | 16 spp | ratio |\n|---|--:|--:|---|--:|--:|--:|--:|")
    for path in args.scenes:
        for row in measured(path, args.samplers):
            rows.append(row)
            print(line(row), flush=True)
            save(args.output, {"benchmark": "merged", "metadata": metadata("mitsuba"), "rows": rows})


def measured(path: str, samplers: list[str]):
    """A row for each sampler."""
    found: dict = {}
    # In turns, one at a time: a kernel knows the shapes of all scenes in memory.
    for _ in range(ROUNDS):
        for kind in ("merged", "apart"):
            shapes, seconds = times(path, kind == "merged", samplers)
            for key, took in seconds.items():
                found.setdefault(key, {}).setdefault(kind, []).extend(took)
            found[kind] = shapes
    for sampler in samplers:
        row = {"scene": Path(path).parent.name, "meshes": found["apart"], "merged": found["merged"], "sampler": sampler}
        for name in RENDERS:
            row[name] = {
                kind: {"median": round(statistics.median(took), 3), "spread": round(max(took) / min(took), 2)}
                for kind, took in found[sampler, name].items()
            }
        yield row


def times(path: str, merged: bool, samplers: list[str]) -> tuple[int, dict[tuple[str, str], list[float]]]:
    """How many shapes the scene has, and seconds by sampler and kind of render."""
    from data_gen.render import render_stack
    from data_gen.scenes.load import load_scene, set_film_size

    gc.collect()
    scene = load_scene(path, merged=merged)
    seconds: dict = {}
    for sampler in samplers:
        for name, (size, spp) in RENDERS.items():
            set_film_size(scene, size)
            for turn in range(TIMES + 1):
                start = time.perf_counter()
                render_stack(scene, spp, 1, sampler)
                if turn:  # The first compiles.
                    seconds.setdefault((sampler, name), []).append(time.perf_counter() - start)
    return len(scene.shapes()), seconds


def line(row: dict) -> str:
    told = []
    for name in RENDERS:
        seconds = {kind: found["median"] for kind, found in row[name].items()}
        told.append(f"{seconds['merged']:.2f} s | {seconds['merged'] / seconds['apart']:.2f}")
    return f"| {row['scene']} | {row['meshes']} | {row['merged']} | {row['sampler']} | {' | '.join(told)} |"


if __name__ == "__main__":
    main()
