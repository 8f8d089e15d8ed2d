"""The cost and the value of gradients, scene by scene, in one run: bench/results/sampler.json.

    python -m bench.sampler --folder SCENES [--maps NAME ...]

It renders the built-in scenes and each FOLDER/*/scene.xml that `gpt` can render (the others are named and left out):

    cost       time of `gpt` (whole stacks with features, variances and film) relative to Mitsuba's C++ `path` at the
               same samples per pixel, --timing-spp; alternating, with kernels compiled beforehand
    compile    seconds to compile the kernels of each, from an empty cache
    variance   variance of independent differences of neighbouring pixels relative to the variance of `dx` and `dy`,
               each summed over the image. Pixels where the camera sees a light are left out: its emission is in the
               primal, not in the gradients
    relMSE     (without the worst 0.1 % of the pixels) of reconstructions from `gpt`, relative to `path` with as many
               samples as fit into the same time; the time to reconstruct is not counted, but listed in the results

References are rendered for a fixed time and kept in CACHE for the next run. An interrupted run continues where it ended
if it is started with the same arguments. The script writes the results and, for each scene named by --maps,
docs/images/NAME-gradients.png, see bench/gradientmap.py.
"""

import argparse
import json
import os
import statistics
import tempfile
import time
from pathlib import Path

import numpy as np

import ngpt
from bench.common import kept, metadata, renderer, save
from bench.gradientmap import variances_of_differences, write_map
from ngpt.evaluation.config import scene_name
from ngpt.evaluation.references import reference_noise
from ngpt.measure.averages import summary
from ngpt.measure.metrics import compare
from ngpt.methods import reconstruct
from ngpt.stack import GradientStack

METHODS = ("l2", "l1", "wcv")
METRIC = "relMSE trimmed"
# Far from the seeds 0, 1 ... of the measured renders.
REFERENCE_SEED, EQUAL_TIME_SEED = 1 << 20, 1 << 21


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, help="folder with a folder for each scene, which holds scene.xml")
    parser.add_argument("--scenes", nargs="*", help="scene files and built-in scenes (default: all)")
    parser.add_argument("--size", type=int, nargs=2, default=(160, 90), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--spp", type=int, default=16, help="of the stacks that are judged")
    parser.add_argument(
        "--timing-spp", type=int, default=64, help="enough to make little of what a render costs to start"
    )
    parser.add_argument("--repeats", type=int, default=3, help="of times and of errors")
    parser.add_argument("--reference-seconds", type=float, default=30.0)
    parser.add_argument("--cache", type=Path, default=Path("out/bench"), help="folder for references")
    parser.add_argument("--maps", nargs="*", default=[], metavar="NAME", help="write a map of the gradients' worth")
    parser.add_argument("--docs", type=Path, default=Path("docs"))
    parser.add_argument("-o", "--output", type=Path, default=Path("bench/results/sampler.json"))
    args = parser.parse_args()
    # Kernels from an earlier run would hide the time to compile them. This must be set before Dr.Jit is loaded.
    with tempfile.TemporaryDirectory() as empty:
        os.environ["DRJIT_CACHE_DIR"] = empty
        run(args)


def run(args: argparse.Namespace) -> None:
    renderer()
    from data_gen.scenes.builtin import SCENES

    files = [str(path) for path in sorted(args.folder.glob("*/scene.xml"))] if args.folder else []
    scenes = args.scenes or [*SCENES, *files]
    setup = {"size": list(args.size), "spp": args.spp, "timing spp": args.timing_spp, "repeats": args.repeats}
    result = {"benchmark": "sampler"} | setup | {"metadata": metadata("mitsuba", "drjit"), "scenes": {}}
    if args.output.exists():
        earlier = json.loads(args.output.read_text())
        if all(earlier.get(key) == result[key] for key in ("metadata", *setup)):
            result["scenes"] = earlier["scenes"]
    for scene in scenes:
        name = scene_name(scene)
        if name not in result["scenes"] or name in args.maps:
            start = time.perf_counter()
            row = bench_scene(scene, name, args)
            if row is None:
                print(f"{name}: left out, gpt cannot render it", flush=True)
                continue
            result["scenes"][name] = row
            save(args.output, result)
            print(f"{line(name, row)} {time.perf_counter() - start:.0f} s", flush=True)


def bench_scene(scene_file: str, name: str, args: argparse.Namespace) -> dict | None:
    """All numbers of one scene; None if `gpt` cannot render it."""
    load_scene, render_stack = renderer()
    import drjit as dr
    import mitsuba as mi

    from data_gen.samplers import choose
    from data_gen.scenes.facts import scene_facts

    size = (args.size[0], args.size[1])
    scene = load_scene(scene_file, size)
    if choose(scene_facts(scene))[0] != "gpt":
        return None

    def path(seed: int) -> None:
        dr.eval(mi.render(scene, spp=args.timing_spp, seed=seed))
        dr.sync_thread()

    compiled = {"path": compile_seconds(lambda: path(0))}
    compiled["gpt"] = compile_seconds(lambda: render_stack(scene, args.spp, 0, "gpt", unbiased=True))
    seconds: dict[str, list[float]] = {"path": [], "gpt": []}
    for seed in range(args.repeats):
        start = time.perf_counter()
        path(seed)
        between = time.perf_counter()
        render_stack(scene, args.timing_spp, seed, "gpt", unbiased=True)
        seconds["path"].append(between - start)
        seconds["gpt"].append(time.perf_counter() - between)
    ratios = [ours / theirs for ours, theirs in zip(seconds["gpt"], seconds["path"], strict=True)]
    cost = summary(ratios)
    spp = max(1, round(args.spp * cost["median"]))
    stacks = [render_stack(scene, args.spp, seed, "gpt", unbiased=True) for seed in range(args.repeats)]
    file = args.cache / f"{name}-reference-{size[0]}x{size[1]}-{args.reference_seconds:g}s.exr"
    reference = kept(
        file, lambda: render_stack(scene, None, REFERENCE_SEED, "primal", seconds=args.reference_seconds, unbiased=True)
    )
    errors = {
        "path": [
            render_stack(scene, spp, EQUAL_TIME_SEED + i, "primal", unbiased=True)["primal"]
            for i in range(args.repeats)
        ]
    }
    solver = {}
    for method in METHODS:
        results = [reconstruct(stack, method) for stack in stacks]
        errors[method] = [result.image for result in results]
        solver[method] = statistics.median(result.seconds for result in results)
    merged = ngpt.merge(stacks)
    if name in args.maps:
        write_map(args.docs / "images" / f"{name}-gradients.png", merged)
    return {
        "seconds": {key: summary(values) for key, values in seconds.items()},
        "seconds per sample": {
            key: statistics.median(values) / (size[0] * size[1] * args.timing_spp) for key, values in seconds.items()
        },
        "cost": cost,
        "compile seconds": compiled,
        "variance": variance_ratios(merged),
        "spp at equal time": spp,
        **{
            metric: {
                key: summary([compare(image, reference["primal"])[metric] for image in images])
                for key, images in errors.items()
            }
            for metric in ("relMSE", METRIC)
        },
        "reconstruction seconds": solver,
        "reference": {"spp": int(reference.attributes["ngpt:spp"]), "noise": reference_noise(reference)},
    }


def compile_seconds(call) -> float:
    """Seconds that ``call`` spends on generating and compiling kernels."""
    import drjit as dr

    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        call()
        kernels = dr.kernel_history([dr.KernelType.JIT])
    return sum(kernel["codegen_time"] + kernel["backend_time"] for kernel in kernels) / 1000


def variance_ratios(stack: GradientStack) -> dict[str, float]:
    """Variance of independent differences of neighbours over variance of the gradients, each summed over the image."""
    ratios = {}
    for name, independent in zip(("dx", "dy"), variances_of_differences(stack), strict=True):
        used = np.isfinite(independent) & np.isfinite(stack[f"{name}_var"])
        ratios[name] = float(independent[used].sum() / stack[f"{name}_var"][used].sum())
    return ratios


def line(name: str, row: dict) -> str:
    medians = {method: row[METRIC][method]["median"] for method in ("path", *METHODS)}
    errors = "  ".join(f"{method} {medians[method] / medians['path']:.2f}" for method in METHODS)
    return (
        f"{name:16} cost {row['cost']['median']:.2f}  variance dx {row['variance']['dx']:.1f} "
        f"dy {row['variance']['dy']:.1f}  error over path: {errors}"
    )


if __name__ == "__main__":
    main()
