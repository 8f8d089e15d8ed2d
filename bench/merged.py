"""What a render takes, once its kernels are compiled, with the meshes of a scene merged by material and as they are.

    python -m bench.merged SCENE.xml ... -o bench/results/merged.json

Seconds of renders of one sample at 64x36 pixels, which is what it takes to begin one, and of 16 samples at 320x180; in
turns, the median of five and their spread (largest over least).
"""

import argparse
import statistics
import time
from pathlib import Path

from bench.common import metadata, save

TIMES = 5
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
    from data_gen.render import render_stack
    from data_gen.scenes.load import load_scene, set_film_size

    scenes = {merged: load_scene(path, merged=merged) for merged in (True, False)}
    shapes = {merged: len(scene.shapes()) for merged, scene in scenes.items()}
    for sampler in samplers:
        row = {"scene": Path(path).parent.name, "meshes": shapes[False], "merged": shapes[True], "sampler": sampler}
        for name, (size, spp) in RENDERS.items():
            took: dict[bool, list[float]] = {True: [], False: []}
            for scene in scenes.values():
                set_film_size(scene, size)
            for turn in range(TIMES + 1):
                for merged, scene in scenes.items():
                    start = time.perf_counter()
                    render_stack(scene, spp, 1, sampler)
                    if turn:  # The first compiles.
                        took[merged].append(time.perf_counter() - start)
            row[name] = {
                "merged" if merged else "apart": {
                    "median": round(statistics.median(seconds), 3),
                    "spread": round(max(seconds) / min(seconds), 2),
                }
                for merged, seconds in took.items()
            }
        yield row


def line(row: dict) -> str:
    told = []
    for name in RENDERS:
        seconds = {kind: found["median"] for kind, found in row[name].items()}
        told.append(f"{seconds['merged']:.2f} s | {seconds['merged'] / seconds['apart']:.2f}")
    return f"| {row['scene']} | {row['meshes']} | {row['merged']} | {row['sampler']} | {' | '.join(told)} |"


if __name__ == "__main__":
    main()
