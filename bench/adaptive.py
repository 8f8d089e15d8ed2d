"""Even, adaptive and oracle sampling side by side, by the error of the final image of each method.

    python -m bench.adaptive --scenes diffuse glossy SCENE.xml ... [--spp 128] [-o bench/results/adaptive.json]
    python -m bench.adaptive --by wcv --scenes diffuse SCENE.xml ... [--cache out/adaptive]
    python -m bench.adaptive --timed diffuse SCENE.xml ... [--timed-size 320 180]
    python -m bench.adaptive --table                                   # of what is in the file

    even      all pixels have the same samples: --spp, half and twice as many
    adaptive  --spp in the mean, shared out by the error that the method is expected to have (data_gen/adaptive.py)
    oracle    shared out by the method's true error, which other even renders and the reference tell

Errors are trimmed relMSE against two halves of a reference, geometric means over --seeds, of small images. What
adaptive samples cost is measured on larger ones, since each pass takes a time to start that a small image does not pay
for: CPU seconds of the process, all threads together, so that others on the machine do not lengthen them. They hold the
runs of the method that the choice needs; the last run, which makes the image, is no part of either. The error of
even samples in the same time is that of as many more samples, by the slope from half of --spp to twice as many.

With --by the samples are shared out for one method, and all methods that can use its stacks are measured on them: a
render a scene instead of one for each method, as without `ngpt render --for`. There are no half and twice as many even
samples then. Stacks are kept in --cache.

`pilot` is what `assess` expects of each method from 16 even samples per pixel, and what is true then; `expected` what
it expects of the adaptive stacks, which is what `--error` goes by. A scene that is
in the file already is measured again; the others are kept.
"""

import argparse
import json
import math
import statistics
import time
from pathlib import Path
from unittest.mock import patch

import numpy as np
from scipy.ndimage import gaussian_filter

from bench.common import metadata, save, summary
from bench.pipelines import Kept
from ngpt.api.uncertainty import SPREAD
from ngpt.evaluation.config import scene_name
from ngpt.measure.metrics import EPSILON, relative_squared_error, relmse_trimmed
from ngpt.methods import METHODS, reconstruct
from ngpt.stack import GradientStack

# method -> the sampler of its stacks
SAMPLER = {
    "l1": "gpt",
    "wcv": "gpt",
    "ngpt-fast": "gpt",
    "ngpt-combine": "gpt",
    "oidn": "primal",
    "ngpt-primal": "primal",
    "primal": "primal",
}
PILOT = 16
# Seeds of the renders that the oracle knows the error from, and of the reference
_KNOWN, _REFERENCE = 1 << 19, 1 << 20


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=[])
    parser.add_argument("--size", type=int, nargs=2, default=(48, 32), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--timed", nargs="+", default=[], help="scenes to measure the cost on")
    parser.add_argument("--timed-size", type=int, nargs=2, default=(320, 180), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--spp", type=int, default=128)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=3, help="of timings")
    parser.add_argument("--known", type=int, default=3, help="renders that the oracle knows the error from")
    parser.add_argument("--reference-spp", type=int, default=4096)
    parser.add_argument("--methods", nargs="+", default=[name for name in SAMPLER if not METHODS[name].missing()])
    parser.add_argument("--by", choices=[m for m, s in SAMPLER.items() if s == "gpt"], help="one method shares out")
    parser.add_argument("--cache", type=Path, default=Path("out/adaptive"), help="folder for stacks, with --by")
    parser.add_argument("--table", action="store_true", help="print the tables of the file, and measure nothing")
    parser.add_argument("-o", "--output", type=Path, default=Path("bench/results/adaptive.json"))
    args = parser.parse_args()
    if args.table:
        result = json.loads(args.output.read_text())
        for lines in (table(result), *(table_by(result, by) for by in result.get("by", {}))):
            print(*lines, "", sep="\n")
        return

    from data_gen.backend import use_variant

    use_variant()
    result: dict = {"benchmark": "adaptive", "size": list(args.size), "spp": args.spp}
    result |= {"metadata": metadata("mitsuba", "onnxruntime", "mitsuba-oidn"), "scenes": {}, "by": {}, "costs": {}}
    if args.output.exists():
        before = json.loads(args.output.read_text())
        result |= {part: before[part] for part in ("scenes", "by", "costs") if part in before}
    for path in args.scenes:
        if args.by:
            result["by"].setdefault(args.by, {})[scene_name(path)] = bench_by(path, args)
        else:
            result["scenes"][scene_name(path)] = bench_scene(path, args)
        save(args.output, result)
        print(scene_name(path), flush=True)
    for path in args.timed:
        result["costs"][scene_name(path)] = bench_costs(path, args)
        save(args.output, result)
        print(scene_name(path), result["costs"][scene_name(path)], flush=True)


def bench_scene(path: str, args: argparse.Namespace) -> dict:
    """Method -> errors of its images, even (by samples), adaptive and oracle, one of each seed; and the pilot's."""
    from data_gen import adaptive, passes
    from data_gen.render import render_stack
    from data_gen.scenes.load import load_scene

    scene = load_scene(path, tuple(args.size))
    reference = {"spp": args.reference_spp // 2, "sampler": "primal", "with_features": False}
    halves = [render_stack(scene, seed=_REFERENCE | i, **reference)["primal"] for i in range(2)]

    def error(stack: GradientStack, method: str) -> float:
        # Above 0: of the two halves' noise more may be taken off than there is, where hardly any error is left.
        return max(relmse_trimmed(reconstruct(stack, method).image, *halves), 1e-9)

    result: dict = {"setup": {name: getattr(args, name) for name in ("seeds", "known", "reference_spp")}, "methods": {}}
    # Long passes: each takes time to start.
    with patch.object(passes, "PASS_SECONDS", 60.0):
        for sampler in sorted({SAMPLER[method] for method in args.methods}):
            methods = [method for method in args.methods if SAMPLER[method] == sampler]
            known = [render_stack(scene, args.spp // 2, _KNOWN + seed, sampler) for seed in range(args.known)]
            small = render_stack(scene, PILOT, 0, sampler)
            even = {
                n: [render_stack(scene, n, seed, sampler) for seed in range(args.seeds)]
                for n in (args.spp // 2, args.spp, 2 * args.spp)
            }
            for method in methods:
                need = true_error(known, method, halves) * math.sqrt(args.spp // 2)

                def told(stack, method, need=need):
                    n = stack["samples"].ravel() if "samples" in stack else float(stack.attributes["ngpt:spp"])
                    return adaptive.Assessment(need / np.sqrt(n), 0.0, method)

                shared = {"adaptive": adaptive.assess, "oracle": told}
                row: dict = {"sampler": sampler, "even": {}}
                row["pilot"] = {"expected": adaptive.assess(small, method).error ** 2, "true": error(small, method)}
                for n, stacks in even.items():
                    row["even"][str(n)] = [error(stack, method) for stack in stacks]
                options = {"sampler": sampler, "adaptive": adaptive.Adaptive(None, method)}
                for name, criterion in shared.items():
                    with patch.object(adaptive, "assess", criterion):
                        stacks = [render_stack(scene, args.spp, seed, **options) for seed in range(args.seeds)]
                    row[name] = [error(stack, method) for stack in stacks]
                    if name == "adaptive":
                        row["expected"] = [adaptive.assess(stack, method).error ** 2 for stack in stacks]
                result["methods"][method] = row
    return result


def bench_by(path: str, args: argparse.Namespace) -> dict:
    """Method -> errors of its images of even samples, of those that ``args.by`` shared out by itself, and by its true
    errors, one of each seed; and of the pilot's. All of sampler `gpt`."""
    from data_gen import adaptive, passes
    from data_gen.render import render_stack
    from data_gen.scenes.load import load_scene

    scene = load_scene(path, tuple(args.size))
    kept = Kept(args.cache / f"{scene_name(path)}-{'x'.join(map(str, args.size))}-{args.spp}-{args.by}")

    def render(name: str, spp: int, seed: int, **more) -> GradientStack:
        more = {"sampler": "gpt"} | more
        return kept.stack(f"{name}-{spp}-{seed}", lambda: render_stack(scene, spp, seed, **more))

    with patch.object(passes, "PASS_SECONDS", 60.0):
        half = {"spp": args.reference_spp // 2, "sampler": "primal", "with_features": False}
        halves = [render("reference", seed=_REFERENCE | i, **half)["primal"] for i in range(2)]
        known = [render("known", args.spp // 2, _KNOWN + seed) for seed in range(args.known)]
        need = true_error(known, args.by, halves) * math.sqrt(args.spp // 2)

        def told(stack, method):
            n = stack["samples"].ravel() if "samples" in stack else float(stack.attributes["ngpt:spp"])
            return adaptive.Assessment(need / np.sqrt(n), 0.0, method)

        shared = {"adaptive": adaptive.Adaptive(None, args.by)}
        stacks = {"pilot": [render("pilot", PILOT, 0)]}
        stacks["even"] = [render("even", args.spp, seed) for seed in range(args.seeds)]
        stacks["adaptive"] = [render("adaptive", args.spp, seed, **shared) for seed in range(args.seeds)]
        with patch.object(adaptive, "assess", told):
            stacks["oracle"] = [render("oracle", args.spp, seed, **shared) for seed in range(args.seeds)]
    result: dict = {"setup": {name: getattr(args, name) for name in ("seeds", "known", "reference_spp")}, "methods": {}}
    for method in (m for m in args.methods if SAMPLER[m] == "gpt"):
        row: dict = {}
        for name, each in stacks.items():
            # Above 0: see bench_scene.
            row[name] = [max(relmse_trimmed(reconstruct(stack, method).image, *halves), 1e-9) for stack in each]
        row["expected"] = {
            name: [adaptive.assess(stack, method).error ** 2 for stack in stacks[name]]
            for name in ("pilot", "even", "adaptive")
        }
        result["methods"][method] = row
    return result


def true_error(stacks: list[GradientStack], method: str, halves: list[np.ndarray]) -> np.ndarray:
    """The true error of a method on such stacks, relative to the light, over about 9x9 pixels; (pixels)."""
    squares = np.mean([relative_squared_error(reconstruct(s, method).image, *halves) for s in stacks], axis=0)
    # Fireflies would have all samples.
    most = np.quantile(np.abs(squares), 0.999)
    smooth = gaussian_filter(np.clip(squares, -most, most).mean(axis=-1).astype(np.float64), SPREAD, truncate=3)
    return np.sqrt(np.maximum(smooth, EPSILON * max(float(smooth.max()), 1e-12))).ravel()


def bench_costs(path: str, args: argparse.Namespace) -> dict:
    """CPU seconds of even renders by sampler, and of adaptive ones by method, in turn."""
    from data_gen.adaptive import Adaptive
    from data_gen.render import render_stack
    from data_gen.scenes.load import load_scene

    scene = load_scene(path, tuple(args.timed_size))
    calls: dict[str, dict] = {s: {"sampler": s} for s in sorted({SAMPLER[method] for method in args.methods})}
    calls |= {f"adaptive {m}": {"sampler": SAMPLER[m], "adaptive": Adaptive(None, m)} for m in args.methods}
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    for repeat in range(args.repeats + 1):
        for name, options in calls.items():
            start = time.process_time()
            # The first compiles.
            render_stack(scene, args.spp if repeat else 32, repeat, **options)
            if repeat:
                seconds[name].append(time.process_time() - start)
    return {"size": list(args.timed_size), "spp": args.spp} | {name: summary(each) for name, each in seconds.items()}


def mean_log(values: list[float]) -> float:
    return math.exp(statistics.mean(math.log(v) for v in values))


def slope(row: dict) -> float:
    """By which power of the samples errors of even samples fall, from the fewest to the most; between -1.2 and 0."""
    counts = sorted(row["even"], key=int)
    fall = math.log(mean_log(row["even"][counts[-1]]) / mean_log(row["even"][counts[0]]))
    return min(max(fall / math.log(int(counts[-1]) / int(counts[0])), -1.2), 0.0)


def price(costs: dict, method: str) -> float:
    """Seconds of adaptive samples over those of as many even ones, the median of scenes; nan if not measured."""
    name = f"adaptive {method}"
    each = [row[name]["median"] / row[SAMPLER[method]]["median"] for row in costs.values() if name in row]
    return statistics.median(each) if each else math.nan


def table(result: dict) -> list[str]:
    """Lines of tables in Markdown: errors over those of even samples, scene by scene, and their geometric means; and
    errors that were expected over the true ones."""
    methods = list(dict.fromkeys(m for entry in result["scenes"].values() for m in entry["methods"]))
    head = ["| scene | " + " | ".join(f"`{m}`" for m in methods) + " |", "|---|" + "--:|" * len(methods)]
    found: dict[str, list[tuple[float, ...]]] = {m: [] for m in methods}
    lines, foretold = list(head), ["", *head]
    for scene, entry in result["scenes"].items():
        cells, told = [], []
        for m in methods:
            if (row := entry["methods"].get(m)) is None:
                cells.append("")
                told.append("")
                continue
            even = mean_log(row["even"][str(result["spp"])])
            adaptive, oracle = (mean_log(row[name]) / even for name in ("adaptive", "oracle"))
            found[m].append((adaptive, oracle, adaptive / price(result["costs"], m) ** slope(row)))
            cells.append(f"{adaptive:.2f}, {oracle:.2f}")
            start = math.sqrt(row["pilot"]["expected"] / row["pilot"]["true"])
            end = math.sqrt(mean_log(row["expected"]) / mean_log(row["adaptive"])) if "expected" in row else math.nan
            told.append(f"{start:.2f}, {end:.2f}".replace(", nan", ""))
        lines.append(f"| {scene} | " + " | ".join(cells) + " |")
        foretold.append(f"| {scene} | " + " | ".join(told) + " |")
    for title, cell in {
        "mean": lambda rows: ", ".join(f"{mean_log([row[i] for row in rows]):.2f}" for i in (0, 1)),
        "worse than even": lambda rows: ", ".join(str(sum(row[i] > 1 for row in rows)) for i in (0, 1)),
        "mean, equal time": lambda rows: f"{mean_log([row[2] for row in rows]):.2f}",
    }.items():
        lines.append(f"| {title} | " + " | ".join(cell(found[m]) for m in methods) + " |")
    lines.append("| seconds over even | " + " | ".join(f"{price(result['costs'], m):.2f}" for m in methods) + " |")
    return lines + foretold


def table_by(result: dict, by: str) -> list[str]:
    """Lines of two tables in Markdown, of samples that one method shared out: errors of adaptive and of the oracle's
    samples over those of even ones; and errors that were expected over the true ones, of the pilot, even and
    adaptive."""
    scenes = result["by"][by]
    methods = list(dict.fromkeys(m for entry in scenes.values() for m in entry["methods"]))
    head = ["| scene | " + " | ".join(f"`{m}`" for m in methods) + " |", "|---|" + "--:|" * len(methods)]
    found: dict[str, list[tuple[float, ...]]] = {m: [] for m in methods}
    lines, foretold = list(head), ["", *head]
    for scene, entry in scenes.items():
        told = []
        for m, row in entry["methods"].items():
            even = mean_log(row["even"])
            found[m].append(tuple(mean_log(row[name]) / even for name in ("adaptive", "oracle")))
            ratios = (math.sqrt(mean_log(e) / mean_log(row[name])) for name, e in row["expected"].items())
            told.append(", ".join(f"{ratio:.2f}" for ratio in ratios))
        lines.append(f"| {scene} | " + " | ".join(", ".join(f"{x:.2f}" for x in found[m][-1]) for m in methods) + " |")
        foretold.append(f"| {scene} | " + " | ".join(told) + " |")
    means = (", ".join(f"{mean_log([row[i] for row in found[m]]):.2f}" for i in (0, 1)) for m in methods)
    worse = (", ".join(str(sum(row[i] > 1 for row in found[m])) for i in (0, 1)) for m in methods)
    lines += ["| mean | " + " | ".join(means) + " |", "| worse than even | " + " | ".join(worse) + " |"]
    return lines + foretold


if __name__ == "__main__":
    main()
