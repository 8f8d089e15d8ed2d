"""Compares even and adaptive samples by the error of the final image of each method.

    python -m bench.adaptive --scenes diffuse glossy SCENE.xml ... [--by wcv] [--spp 128] [--cache out/adaptive]
    python -m bench.adaptive --timed diffuse SCENE.xml ... [--timed-size 320 180]
    python -m bench.adaptive --table                                   # of the results in the file

    even      all pixels have --spp samples
    adaptive  --spp on average, distributed by the expected error of the method --by (data_gen/adaptive.py)

Errors are trimmed relMSE against two halves of a reference, geometric means over --seeds, of small images. The cost of
adaptive samples is measured on larger images, since each pass takes some time to start. It is CPU seconds of the
process, and includes the reconstructions that choose the samples. The table also has the error that `assess` expects of
each method (`--error` uses it) over the true error. Scenes that are in the file are measured again; stacks are kept in
--cache.
"""

import argparse
import itertools
import json
import math
import statistics
import time
from pathlib import Path

from bench.common import measure, metadata, renderer, save
from bench.pipelines import Kept
from ngpt.evaluation.config import scene_name
from ngpt.measure.averages import geometric_mean
from ngpt.measure.metrics import relmse_trimmed
from ngpt.methods import METHODS, reconstruct
from ngpt.stack import GradientStack

OF = tuple(name for name in ("l1", "wcv", "ngpt-fast", "ngpt-combine") if not METHODS[name].missing())
PILOT = 16
_REFERENCE = 1 << 20


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=[])
    parser.add_argument("--size", type=int, nargs=2, default=(48, 32), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--timed", nargs="+", default=[], help="scenes to measure the cost on")
    parser.add_argument("--timed-size", type=int, nargs=2, default=(320, 180), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--spp", type=int, default=128)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=3, help="of timings")
    parser.add_argument("--reference-spp", type=int, default=4096)
    parser.add_argument("--by", choices=OF, default="wcv", help="the method that shares out (default: %(default)s)")
    parser.add_argument("--cache", type=Path, default=Path("out/adaptive"), help="folder for stacks")
    parser.add_argument("--table", action="store_true", help="print the tables of the file, and measure nothing")
    parser.add_argument("-o", "--output", type=Path, default=Path("bench/results/adaptive.json"))
    args = parser.parse_args()
    if args.table:
        print(table(json.loads(args.output.read_text())))
        return

    result: dict = {"benchmark": "adaptive", "by": {}, "costs": {}}
    if args.output.exists():
        before = json.loads(args.output.read_text())
        result |= {part: before[part] for part in ("by", "costs") if part in before}
    result |= {"size": list(args.size), "spp": args.spp, "metadata": metadata("mitsuba", "onnxruntime", "mitsuba-oidn")}
    for path in args.scenes:
        result["by"].setdefault(args.by, {})[scene_name(path)] = bench_scene(path, args)
        save(args.output, result)
        print(scene_name(path), flush=True)
    for path in args.timed:
        result["costs"][scene_name(path)] = bench_costs(path, args)
        save(args.output, result)
        print(scene_name(path), result["costs"][scene_name(path)], flush=True)


def bench_scene(path: str, args: argparse.Namespace) -> dict:
    """Method -> errors of its images of even and of adaptive samples, one of each seed, and what was expected."""
    load_scene, render_stack = renderer()
    from data_gen import adaptive

    scene = load_scene(path, tuple(args.size))
    kept = Kept(args.cache / f"{scene_name(path)}-{'x'.join(map(str, args.size))}-{args.spp}-{args.by}")

    def render(name: str, spp: int, seed: int, **more) -> GradientStack:
        more = {"sampler": "gpt"} | more
        return kept.stack(f"{name}-{spp}-{seed}", lambda: render_stack(scene, spp, seed, unbiased=True, **more))

    half = {"spp": args.reference_spp // 2, "sampler": "primal", "with_features": False}
    halves = [render("reference", seed=_REFERENCE | i, **half)["primal"] for i in range(2)]
    shared = {"adaptive": adaptive.Adaptive(None, args.by)}
    stacks = {"pilot": [render("pilot", PILOT, 0)]}
    stacks["even"] = [render("even", args.spp, seed) for seed in range(args.seeds)]
    stacks["adaptive"] = [render("adaptive", args.spp, seed, **shared) for seed in range(args.seeds)]
    result: dict = {"setup": {name: getattr(args, name) for name in ("seeds", "reference_spp")}, "methods": {}}
    for method in OF:
        row: dict = {}
        for name, each in stacks.items():
            # Very small errors may come out negative, since the noise of two halves is removed only on average.
            row[name] = [max(relmse_trimmed(reconstruct(stack, method).image, *halves), 1e-9) for stack in each]
        row["expected"] = {
            name: [adaptive.assess(stack, method).error ** 2 for stack in each] for name, each in stacks.items()
        }
        result["methods"][method] = row
    return result


def bench_costs(path: str, args: argparse.Namespace) -> dict:
    """CPU seconds of even renders, and of adaptive ones by method, in turn."""
    load_scene, render_stack = renderer()
    from data_gen.adaptive import Adaptive

    scene, seeds = load_scene(path, tuple(args.timed_size)), itertools.count()
    options: dict[str, dict] = {"gpt": {}} | {f"adaptive {m}": {"adaptive": Adaptive(None, m)} for m in OF}
    calls = {
        name: lambda more=more: render_stack(scene, args.spp, next(seeds), "gpt", unbiased=True, **more)
        for name, more in options.items()
    }
    return {"size": list(args.timed_size), "spp": args.spp} | measure(calls, args.repeats, time.process_time)


def table(result: dict) -> str:
    """Markdown for each method that distributed the samples: adaptive over even errors, and expected over true ones."""
    parts = []
    for by, scenes in result["by"].items():
        methods = list(dict.fromkeys(m for entry in scenes.values() for m in entry["methods"]))
        head = [f"| shared out by {by} | " + " | ".join(f"`{m}`" for m in methods) + " |"]
        head.append("|---|" + "--:|" * len(methods))
        found: dict[str, list[float]] = {m: [] for m in methods}
        lines, foretold = list(head), list(head)
        for scene, entry in scenes.items():
            ratios, told = [], []
            for m in methods:
                row = entry["methods"].get(m, {"expected": {}})
                if "even" in row:
                    found[m].append(geometric_mean(row["adaptive"]) / geometric_mean(row["even"]))
                ratios.append(f"{found[m][-1]:.2f}" if "even" in row else "")
                over = (math.sqrt(geometric_mean(e) / geometric_mean(row[name])) for name, e in row["expected"].items())
                told.append(", ".join(f"{ratio:.2f}" for ratio in over))
            lines.append(f"| {scene} | " + " | ".join(ratios) + " |")
            foretold.append(f"| {scene} | " + " | ".join(told) + " |")
        lines.append("| mean | " + " | ".join(f"{geometric_mean(found[m]):.2f}" for m in methods) + " |")
        lines.append("| seconds over even | " + " | ".join(price(result["costs"], m) for m in methods) + " |")
        parts += ["\n".join(lines), "\n".join(foretold)]
    return "\n\n".join(parts)


def price(costs: dict, method: str) -> str:
    """Render time of adaptive samples relative to as many even ones, the median over scenes; "" if not measured."""
    name = f"adaptive {method}"
    each = [row[name]["median"] / row["gpt"]["median"] for row in costs.values() if name in row and "gpt" in row]
    return f"{statistics.median(each):.2f}" if each else ""


if __name__ == "__main__":
    main()
