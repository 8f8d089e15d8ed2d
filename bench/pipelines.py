"""Is the sampler and method that a pilot chooses as good as the best of all: scene by scene, at equal time.

    python -m bench.pipelines --scenes diffuse glossy SCENE.xml ... [--apart SCENE.xml ...] [--size 96 54]
    python -m bench.pipelines --table        print what the file says, with the rules as they are now

Measured are, for each sampler, method, and samples even or shared out, the errors (trimmed relMSE against two halves of
a reference) at some numbers of samples, and the seconds of a sample and of the method. Seconds are of the processor, on
all cores together, so that a busy machine counts little. The pilot (data_gen/pipelines.py) is not told any of it. At
equal time, which is that of 16, 64 and 256 samples of ``gpt``, each pipeline has the error between the two measured
ones next to it, on a straight line of logarithms. Regret is the error of what the pilot chose over the least.

Nothing may be chosen by scenes ``--apart``.
"""

import argparse
import json
import math
import statistics
import time
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

from bench.common import metadata, save
from ngpt.evaluation.config import scene_name
from ngpt.measure.metrics import relmse_trimmed
from ngpt.merging import merge
from ngpt.methods import reconstruct

LADDER = (16, 64, 256)
# Samples of these cost several of gpt.
SLOW = ("bdpt", "gbdpt", "ppm", "gpm")
_REFERENCE = 1 << 20


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=[])
    parser.add_argument("--apart", nargs="+", default=[])
    parser.add_argument("--size", type=int, nargs=2, default=(96, 54), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--samplers", nargs="+", help="default: those that `--sampler auto` would compare")
    parser.add_argument("--reference-spp", type=int, default=2048)
    parser.add_argument("--table", action="store_true", help="print the tables of the file, and measure nothing")
    parser.add_argument("-o", "--output", type=Path, default=Path("bench/results/pipelines.json"))
    args = parser.parse_args()

    from data_gen.backend import use_variant

    use_variant()
    result: dict = {"benchmark": "pipelines", "size": list(args.size), "metadata": metadata("mitsuba"), "scenes": {}}
    if args.output.exists():
        result["scenes"] = json.loads(args.output.read_text())["scenes"]
    for path in () if args.table else (*args.scenes, *args.apart):
        start = time.perf_counter()
        result["scenes"][scene_name(path)] = bench_scene(path, args) | {"apart": path in args.apart}
        save(args.output, result)
        print(f"{scene_name(path)}: {time.perf_counter() - start:.0f} s", flush=True)
    print(*table(result), sep="\n")


def bench_scene(path: str, args: argparse.Namespace) -> dict:
    """What the pilot saw, and what is true: rows of sampler, method, shared -> errors by samples."""
    from data_gen import passes, pilot, pipelines
    from data_gen.adaptive import Adaptive
    from data_gen.render import render_stack
    from data_gen.samplers import SAMPLERS
    from data_gen.scenes.load import load_scene

    scene = load_scene(path, tuple(args.size))
    names = args.samplers or pilot.candidates(scene)
    found = pipelines.try_pipelines(scene, names, clock=time.process_time)
    names = list(dict.fromkeys(p.sampler for p in found))
    rows: list[dict] = []
    cost: dict[str, float] = {}
    stacks: dict[str, dict[int, object]] = {}
    with patch.object(passes, "PASS_SECONDS", 60.0):
        for name in names:
            ladder = LADDER[:2] if name in SLOW else LADDER
            stacks[name], done, start = {}, 0, time.process_time()
            for n in ladder:
                more = render_stack(scene, n - done, n, name)
                stacks[name][n] = more if not done else merge([stacks[name][done], more])
                done = n
            cost[name] = (time.process_time() - start) / done
        # The reference is of the sampler with the least noise at equal time.
        fair = [name for name in names if not SAMPLERS[name].biased]
        variance = {n: pilot_noise(stacks[n][16], stacks[n][64]) * cost[n] for n in fair}
        quiet = min(variance, key=lambda n: variance[n])
        spp = max(int(args.reference_spp // 2 * min(1.0, cost.get("primal", cost[quiet]) / cost[quiet])), 128)
        halves = [render_stack(scene, spp, _REFERENCE | i, quiet)["primal"] for i in range(2)]
        shared: dict[str, dict[int, object]] = {}
        for name in {p.sampler for p in found if p.shared}:
            shared[name] = {n: render_stack(scene, n, n, name, adaptive=Adaptive()) for n in (64, 256)}
    for p in found:
        errors, after = {}, []
        for n, stack in (shared if p.shared else stacks)[p.sampler].items():
            start = time.process_time()
            image = reconstruct(stack, p.method).image
            after.append(time.process_time() - start)
            errors[str(n)] = max(relmse_trimmed(image, *halves), 1e-9)
        rows.append({"pilot": vars(p), "errors": errors, "seconds": cost[p.sampler], "after": statistics.median(after)})
    return {"reference": [quiet, spp], "first": names[0], "rows": rows}


def pilot_noise(few, many) -> float:
    """Relative noise of a sample by the difference of an image and a longer one that holds it."""
    return relmse_trimmed(few["primal"], many["primal"]) / (1 / 16 - 1 / 64)


def true_error(errors: dict[str, float], spp: float) -> float:
    """At a number of samples, between those that were measured; beyond them the last line goes on."""
    known = sorted((int(n), e) for n, e in errors.items())
    i = next((i for i in range(1, len(known) - 1) if spp < known[i][0]), len(known) - 1)
    (n0, e0), (n1, e1) = known[i - 1], known[i]
    return e0 * (spp / n0) ** (math.log(e1 / e0) / math.log(n1 / n0))


def cells(entry: dict) -> list[dict]:
    """For each time of ``LADDER`` samples of the first sampler: name -> error, and the pilot's choice."""
    from data_gen.pipelines import FROM, Pipeline, choose

    pipelines = [Pipeline(**row["pilot"] | {"steps": tuple(row["pilot"]["steps"])}) for row in entry["rows"]]
    unit = next(row["seconds"] for row in entry["rows"] if row["pilot"]["sampler"] == entry["first"])
    found = []
    for n in LADDER:
        # So much that samples and the slowest of the methods fit.
        seconds = n * unit + max(row["after"] for row in entry["rows"]) / 2
        errors = {}
        for p, row in zip(pipelines, entry["rows"], strict=True):
            spp = replace(p, seconds=row["seconds"], after=row["after"]).samples(seconds)
            if spp >= (FROM if p.shared else 2):
                errors[name_of(p)] = true_error(row["errors"], spp)
        ranked = [p for p in choose(pipelines, seconds) if name_of(p) in errors]
        found.append({"spp": n, "errors": errors, "choice": name_of(ranked[0])})
    return found


def name_of(p) -> str:
    return f"{p.sampler} {p.method}" + (" shared" if p.shared else "")


def table(result: dict) -> list[str]:
    """Lines: choice, regret, the best, for each scene and time; then geometric mean and worst; and of fixed choices."""
    lines, regrets, fixed = [], {False: [], True: []}, {False: {}, True: {}}
    for scene, entry in result["scenes"].items():
        for cell in cells(entry):
            least = min(cell["errors"], key=lambda n: cell["errors"][n])
            ratios = {name: e / cell["errors"][least] for name, e in cell["errors"].items()}
            regrets[entry["apart"]].append(ratios[cell["choice"]])
            for name, ratio in ratios.items():
                fixed[entry["apart"]].setdefault(name, []).append(ratio)
            lines.append(f"| {scene} | {cell['spp']} | `{cell['choice']}` | {ratios[cell['choice']]:.2f} | `{least}` |")
    for apart, title in ((False, "chosen on"), (True, "apart")):
        if rows := regrets[apart]:
            lines.append(f"{title}: {mean_log(rows):.3f} in the mean, {max(rows):.2f} at worst, {len(rows)} cells")
            whole = {n: mean_log(r) for n, r in fixed[apart].items() if len(r) == len(rows)}
            for name in sorted(whole, key=lambda n: whole[n])[:6]:
                lines.append(f"  always {name}: {whole[name]:.3f}, {max(fixed[apart][name]):.2f}")
    return lines


def mean_log(values: list[float]) -> float:
    return math.exp(statistics.mean(math.log(v) for v in values))


if __name__ == "__main__":
    main()
