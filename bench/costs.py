"""What a sample costs, in CPU time: `gpt` over `primal`, features in both, scene by scene.

    python -m bench.costs --folder SCENES [--scenes coffee ...] [--size 256 144] [-o bench/results/costs.json]

Renders of the samplers take turns, kernels compiled before, so that a busy moment hits all of them alike. Times are CPU
seconds of the whole process, which other programs disturb less than the clock, on one thread unless told otherwise.

    cost      CPU time of a stack over that of `primal` of the same seed: median and quartiles over --repeats seeds
    kernels   share of that time in the largest kernel, in which paths are traced; the rest is recording, film, seeds

A table is printed; all numbers are written as JSON.
"""

import argparse
import statistics
import time
from pathlib import Path

from bench.common import metadata, save, summary

RIVAL = "primal"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, help="folder with a folder for each scene, which holds scene.xml")
    parser.add_argument("--scenes", nargs="*", help="names in that folder and built-in scenes (default: all)")
    parser.add_argument("--samplers", nargs="*", default=["gpt"], help=f"compared with '{RIVAL}'")
    parser.add_argument("--size", type=int, nargs=2, default=(256, 144), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--spp", type=int, default=16)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("-o", "--output", type=Path, default=Path("bench/results/costs.json"))
    args = parser.parse_args()

    from data_gen.backend import use_variant

    use_variant()
    import drjit as dr

    from data_gen.samplers import find
    from data_gen.scenes.builtin import SCENES
    from data_gen.scenes.facts import scene_facts
    from data_gen.scenes.load import load_scene
    from ngpt.errors import NgptError

    dr.set_thread_count(args.threads)
    files = {path.parent.name: path for path in sorted(args.folder.glob("*/scene.xml"))} if args.folder else {}
    setup = {"size": list(args.size), "spp": args.spp, "repeats": args.repeats, "render threads": args.threads}
    result = {"benchmark": "costs"} | setup | {"metadata": metadata("mitsuba", "drjit"), "scenes": {}}
    for name in args.scenes or [*SCENES, *files]:
        scene = load_scene(str(files.get(name, name)), tuple(args.size))
        try:
            for sampler in args.samplers:
                find(sampler, scene_facts(scene))
        except NgptError as error:
            print(f"{name}: left out, {error}", flush=True)
            continue
        row = bench_scene(scene, args)
        result["scenes"][name] = row
        save(args.output, result)
        print(line(name, row, args.samplers), flush=True)
    for sampler in args.samplers:
        costs = [row[sampler]["cost"]["median"] for row in result["scenes"].values()]
        print(f"{sampler}: median {statistics.median(costs):.2f}, worst {max(costs):.2f} of {len(costs)} scenes")


def bench_scene(scene, args: argparse.Namespace) -> dict:
    """CPU seconds of each sampler and its cost."""
    runs: dict[str, list[tuple[float, float]]] = {sampler: [] for sampler in (RIVAL, *args.samplers)}
    for seed in range(args.repeats + 1):
        for sampler, times in runs.items():
            # The first run compiles, and warms the caches.
            measured = cpu_seconds(scene, sampler, args.spp, seed)
            if seed:
                times.append(measured)
    return {
        sampler: {
            "CPU seconds": summary([cpu for cpu, _ in times]),
            "cost": summary([cpu / rival for (cpu, _), (rival, _) in zip(times, runs[RIVAL], strict=True)]),
            "kernels": statistics.median(share for _, share in times),
        }
        for sampler, times in runs.items()
    }


def cpu_seconds(scene, sampler: str, spp: int, seed: int) -> tuple[float, float]:
    """CPU seconds of a render, and the share of the clock's that its largest kernels took."""
    import drjit as dr

    from data_gen.render import render_stack

    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        clock, cpu = time.perf_counter(), time.process_time()
        render_stack(scene, spp, seed, sampler)
        cpu, clock = time.process_time() - cpu, time.perf_counter() - clock
        kernels = dr.kernel_history([dr.KernelType.JIT])
    largest = max(kernel["operation_count"] for kernel in kernels)
    traced = sum(kernel["execution_time"] for kernel in kernels if kernel["operation_count"] == largest)
    return cpu, traced / 1000 / clock


def line(name: str, row: dict, samplers: list[str]) -> str:
    cells = [f"{name:16} {RIVAL} {row[RIVAL]['CPU seconds']['median']:.3f} s"]
    for sampler in samplers:
        cost = row[sampler]["cost"]
        share = row[sampler]["kernels"]
        cells.append(
            f"{sampler} {cost['median']:.2f} ({cost['low']:.2f} .. {cost['high']:.2f}), {share:.0%} in kernels"
        )
    return "  ".join(cells)


if __name__ == "__main__":
    main()
