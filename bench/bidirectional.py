"""Bidirectional samplers at equal time: `path`, `bdpt`, `gpt` and `gbdpt`, with l1, wcv, the networks and OIDN.

    python -m bench.bidirectional --scenes diffuse glossy SCENE.xml ... [--apart SCENE.xml ...] [--docs]
    python -m bench.bidirectional --table                                # of what is in the file

Every sampler gets the time of --spp samples of `gpt`, but never less than two passes. What a sample costs is measured
in the same run, all samplers in turn, the least of --repeats, on images of --timed-size: a pass of `bdpt` has four
samples a pixel and takes a time to start that a small image does not pay for. Errors are those of small images.

    error      trimmed relMSE against two halves of a reference, mean over --seeds
    reference  by the sampler with the least noise for its time, in --reference-seconds a half; the error of the mean of
               both halves, which is taken off all errors, stands beside them
    time       the seconds that its samples cost over those of `gpt`'s; 1 but for rounding, and where two passes cost
               more

Scenes in --apart are those that nothing was tuned on, and are marked so. A row is written when its scene is finished; a
run that was broken off goes on. With another setup a file begins anew. --docs puts the tables into the page.
"""

import argparse
import json
import math
import statistics
import time
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np

from bench.common import metadata, save, write_page
from ngpt.evaluation.config import scene_name
from ngpt.measure.metrics import EPSILON, relmse_trimmed
from ngpt.methods import METHODS, reconstruct
from ngpt.stack import GradientStack

RESULT = Path("bench/results/bidirectional.json")
PAGE = Path("docs/samplers/bidirectional.md")
MARKS = "<!-- python -m bench.bidirectional -->", "<!-- ends here -->"
# sampler -> options of its renders, and what its stacks are given to; "primal" is the image as it is
PIPELINES: dict[str, tuple[dict, tuple[str, ...]]] = {
    "path": ({"sampler": "primal", "with_features": False}, ("primal",)),
    "path, features": ({"sampler": "primal"}, ("oidn", "ngpt-primal")),
    "bdpt": ({"sampler": "bdpt"}, ("primal", "oidn", "ngpt-primal")),
    "gpt": ({"sampler": "gpt"}, ("l1", "wcv", "ngpt-fast", "ngpt-combine")),
    "gbdpt": ({"sampler": "gbdpt"}, ("l1", "wcv", "ngpt-fast", "ngpt-combine")),
}
CLOCK = "gpt"
_REFERENCE_SEED = 1 << 20


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=[])
    parser.add_argument("--apart", nargs="+", default=[], help="more scenes: those that nothing was tuned on")
    parser.add_argument("--size", type=int, nargs=2, default=(96, 72), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--timed-size", type=int, nargs=2, default=(256, 192), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--spp", type=int, default=128, help="of gpt (default %(default)s)")
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=2, help="of timings")
    parser.add_argument("--reference-seconds", type=float, default=15.0, help="of each half")
    parser.add_argument("--table", action="store_true", help="print the tables of the file, and measure nothing")
    parser.add_argument("--docs", action="store_true", help=f"write the tables into {PAGE}")
    parser.add_argument("-o", "--output", type=Path, default=RESULT)
    args = parser.parse_args()
    if args.scenes or args.apart:
        measure_all(args)
    result = json.loads(args.output.read_text())
    if args.table:
        print(table(result))
    if args.docs:
        write_page(PAGE, table(result), MARKS)


def measure_all(args: argparse.Namespace) -> None:
    from data_gen.backend import use_variant

    use_variant()
    names = ("size", "timed_size", "spp", "seeds", "repeats", "reference_seconds")
    setup = json.loads(json.dumps({name: getattr(args, name) for name in names}))
    result: dict = {"benchmark": "bidirectional", "setup": setup, "scenes": {}}
    if args.output.exists():
        before = json.loads(args.output.read_text())
        result["scenes"] = before["scenes"] if before.get("setup") == setup else {}
    result["metadata"] = metadata("mitsuba", "onnxruntime", "mitsuba-oidn")
    for scene in (*args.scenes, *args.apart):
        name, start = scene_name(scene), time.perf_counter()
        if name in result["scenes"]:
            continue
        row = result["scenes"][name] = {"apart": scene in args.apart} | bench_scene(scene, args)
        save(args.output, result)
        errors = "  ".join(f"{column} {error:.3g}" for column, error in row["errors"].items())
        print(f"{name}, {time.perf_counter() - start:.0f} s:  {errors}", flush=True)


def bench_scene(path: str, args: argparse.Namespace) -> dict:
    """Sampler -> seconds per sample, samples and time; column -> error; and the reference."""
    from data_gen.choosing.costs import measure
    from data_gen.render import render_stack
    from data_gen.samplers import SAMPLERS
    from data_gen.scenes.load import load_scene, set_film_size

    scene = load_scene(path, tuple(args.timed_size))
    renders = {name: options for name, (options, _) in PIPELINES.items()}
    timings, _ = measure(scene, renders, 2 * max(entry.batch for entry in SAMPLERS.values()), args.repeats)
    seconds = {name: min(values) for name, values in timings.items()}
    batch = {name: max(1, SAMPLERS[options["sampler"]].batch) for name, options in renders.items()}
    spp = {name: max(2 * batch[name], round(args.spp * seconds[CLOCK] / seconds[name])) for name in renders}

    set_film_size(scene, tuple(args.size))
    errors: dict[str, list[float]] = {}
    halves: list[np.ndarray] = []
    found: dict[str, GradientStack] = {}
    for seed in range(args.seeds):
        found = {name: render_stack(scene, spp[name], seed, **options) for name, options in renders.items()}
        if not halves:
            best = quieter(found)
            halves = reference(scene, renders[best], args.reference_seconds)
        for name, (_, methods) in PIPELINES.items():
            for method in methods:
                if not METHODS[method].missing():
                    image = reconstruct(found[name], method).image
                    errors.setdefault(column(name, method), []).append(relmse_trimmed(image, *halves))
    return {
        "seconds per sample": seconds,
        "spp": spp,
        "time": {name: spp[name] * seconds[name] / (args.spp * seconds[CLOCK]) for name in renders},
        "reference": {"sampler": best, "error": relmse_trimmed(halves[0], halves[1]) / 4},
        # Above 0: where hardly any error is left, more may be taken off for the reference's.
        "errors": {name: max(statistics.mean(values), 1e-9) for name, values in errors.items()},
    }


def quieter(stacks: dict[str, GradientStack]) -> str:
    """Which of `path` and `bdpt` has less noise in equal time, relative to the light that either finds."""
    light = sum(stacks[name]["primal"].astype(np.float64) for name in ("path", "bdpt")) / 2
    return min(("path", "bdpt"), key=lambda name: np.mean(stacks[name]["primal_var"] / (light**2 + EPSILON)))


def reference(scene, options: dict, seconds: float) -> list[np.ndarray]:
    """Two independent images, in passes of many samples: nobody reads their variances."""
    from data_gen.render import render_stack
    from data_gen.samplers import SAMPLERS

    entry = SAMPLERS[options["sampler"]]
    longer = {entry.name: replace(entry, batch=64 if entry.batch else 0)}
    with patch.dict(SAMPLERS, longer):
        stacks = [render_stack(scene, None, _REFERENCE_SEED + i, **options, seconds=seconds) for i in range(2)]
    return [stack["primal"].astype(np.float64) for stack in stacks]


def column(sampler: str, method: str) -> str:
    sampler = sampler.removesuffix(", features")
    return sampler if method == "primal" else f"{sampler}, {method}"


def table(result: dict) -> str:
    """Two tables in Markdown: errors over the least of each scene, with geometric means; costs and samples."""
    scenes = result["scenes"]
    columns = list(dict.fromkeys(name for row in scenes.values() for name in row["errors"]))
    ratios = {
        name: {c: error / min(row["errors"].values()) for c, error in row["errors"].items()}
        for name, row in scenes.items()
    }
    lines = ["| pipeline | " + " | ".join(shown(name, row) for name, row in scenes.items()) + " | mean |"]
    lines.append("|---|" + "--:|" * (len(scenes) + 1))
    for c in columns:
        cells = [f"**{r[c]:.3g}**" if r[c] == 1 else f"{r[c]:.3g}" if c in r else "" for r in ratios.values()]
        mean = math.exp(statistics.mean(math.log(r[c]) for r in ratios.values() if c in r))
        lines.append(f"| {c} | " + " | ".join(cells) + f" | {mean:.3g} |")
    samplers = [name for name in PIPELINES if not name.endswith(", features")]
    lines += ["", "| scene | least error | reference, by | cost over `path`: " + ", ".join(samplers[1:])]
    lines[-1] += " | samples: " + ", ".join(samplers) + " | time |"
    lines.append("|---|--:|--:|--:|--:|--:|")
    for name, row in scenes.items():
        each = row["seconds per sample"]
        costs = ", ".join(f"{each[s] / each['path']:.1f}" for s in samplers[1:])
        samples = ", ".join(str(row["spp"][s]) for s in samplers)
        made = f"{row['reference']['error']:.2g}, `{row['reference']['sampler']}`"
        most = f"{max(row['time'].values()):.2g}"
        lines.append(
            f"| {shown(name, row)} | {min(row['errors'].values()):.3g} | {made} | {costs} | {samples} | {most} |"
        )
    return "\n".join(lines)


def shown(name: str, row: dict) -> str:
    return f"{name} (apart)" if row["apart"] else name


if __name__ == "__main__":
    main()
