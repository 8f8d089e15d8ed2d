"""Is the sampler and method that a pilot chooses as good as the best of all, scene by scene, at equal time?

    python -m bench.pipelines --scenes diffuse glossy SCENE.xml ... [--apart SCENE.xml ...] [--size 64 36]
    python -m bench.pipelines --table        print what the file says, with the rules as they are now

All samplers take turns: each renders four parts that take about as long as 64 samples of the first sampler. The cost of
a sample relative to the first sampler is the median of the ratios of the parts, in processor seconds. Errors (trimmed
relMSE against two halves of a reference) are measured for each method on a few samples, on one part and on all four,
with even and with adaptive samples. Stacks are kept in --cache.

The pilot (data_gen/choosing/pipelines.py) gets none of these measurements. The equal times are the time of 16, 64 and
256 samples of the first sampler plus the time of the slowest method. The error at the number of samples that a pipeline
has time for is interpolated between the measured ones, in the logarithms. Regret is the error of the pilot's choice
over the least error of all. Scenes ``--apart`` must not influence any choice.
"""

import argparse
import json
import math
import statistics
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from bench import common
from bench.common import metadata, save
from ngpt.evaluation.config import scene_name
from ngpt.measure.averages import geometric_mean
from ngpt.measure.metrics import relmse_trimmed
from ngpt.merging import merge
from ngpt.methods import reconstruct
from ngpt.stack import GradientStack

LADDER = (16, 64, 256)
PARTS = 4
# The most that a sampler's trial may cost, in samples of the first sampler: twice the limit of the pilot for a 14 times
# larger image in the time of 256 samples, since recording takes half of a pass of such small images. Samplers that cost
# more are left out of the comparison, too.
DEAREST = 1400
_REFERENCE, _SHARED = 1 << 20, 1 << 21


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=[])
    parser.add_argument("--apart", nargs="+", default=[])
    parser.add_argument("--size", type=int, nargs=2, default=(64, 36), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--samplers", nargs="+", help="default: those that `--sampler auto` would compare")
    parser.add_argument("--reference", type=int, default=512, help="samples of a half, in samples of the first sampler")
    parser.add_argument("--cache", type=Path, default=Path("out/pipelines"), help="folder for stacks")
    parser.add_argument("--table", action="store_true", help="print the tables of the file, and measure nothing")
    parser.add_argument("-o", "--output", type=Path, default=Path("bench/results/pipelines.json"))
    args = parser.parse_args()
    result: dict = {"benchmark": "pipelines", "size": list(args.size), "metadata": metadata("mitsuba"), "scenes": {}}
    if args.output.exists():
        result["scenes"] = json.loads(args.output.read_text())["scenes"]
    for path in () if args.table else (*args.scenes, *args.apart):
        start = time.perf_counter()
        result["scenes"][scene_name(path)] = bench_scene(path, args) | {"apart": path in args.apart}
        save(args.output, result)
        print(f"{scene_name(path)}: {time.perf_counter() - start:.0f} s", flush=True)
    print(*table(result), *promises(result), sep="\n")


class Kept:
    """A cache of the stacks and numbers of a scene in a folder."""

    def __init__(self, folder: Path):
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)

    def stack(self, name: str, make: Callable[[], GradientStack]) -> GradientStack:
        return common.kept(self.folder / f"{name}.exr", make)

    def numbers(self, name: str, make: Callable[[], dict]) -> dict:
        path = self.folder / f"{name}.json"
        if not path.exists():
            save(path, make())
        return json.loads(path.read_text())


def bench_scene(path: str, args: argparse.Namespace) -> dict:
    """The measurements of the pilot and the true ones: rows of sampler, method, shared -> errors by samples."""
    load_scene, render_stack = common.renderer()
    from data_gen.adaptive import LEAST, Adaptive
    from data_gen.choosing import pipelines
    from data_gen.choosing.trials import candidates, noise_of
    from data_gen.samplers import SAMPLERS

    scene = load_scene(path, tuple(args.size))
    kept = Kept(args.cache / "{}-{}x{}".format(scene_name(path), *args.size))
    trials = {}
    for name in args.samplers or dict.fromkeys([*candidates(scene), *candidates(scene, gradients=True)]):
        limit = DEAREST * trials[first].seconds if (first := next(iter(trials), None)) else math.inf
        if (trial := _trial(kept, scene, name, limit)) is not None:
            trials[name] = trial
    first, names = next(iter(trials)), list(trials)
    compiled: set[str] = set()

    def render(key: str, name: str, spp: int, seed: int, **more) -> GradientStack:
        def make() -> GradientStack:
            if name not in compiled:
                render_stack(scene, 1, seed, name, unbiased=True)
                compiled.add(name)
            start = time.process_time()
            stack = render_stack(scene, spp, seed, name, unbiased=True, **more)
            stack.attributes["bench:seconds"] = time.process_time() - start
            return stack

        return kept.stack(f"{key}-{spp}-{name}", make)

    part = {}  # samples of a part, by sampler
    for name, trial in trials.items():
        batch = max(1, SAMPLERS[name].batch)
        part[name] = max(
            4 * LEAST // PARTS, 8 * batch, round(64 * trials[first].seconds / trial.seconds / batch) * batch
        )
        part[name] = kept.numbers(f"part-{name}", lambda spp=part[name]: {"spp": spp})["spp"]
    even: dict[str, dict[int, list[GradientStack]]] = {name: {part[name]: []} for name in names}
    shared: dict[str, dict[int, list[GradientStack]]] = {}
    for i in range(PARTS):
        for name in names:
            even[name][part[name]].append(render(f"part{i}", name, part[name], i))
    cost = {name: _cost(even[name][part[name]]) for name in names}
    relative = {
        name: statistics.median(
            _cost([ours]) / _cost([theirs])
            for ours, theirs in zip(even[name][part[name]], even[first][part[first]], strict=True)
        )
        for name in names
    }
    for name in names:
        few = part[name] // 4
        if few >= 2 * SAMPLERS[name].batch:  # else it has no variances
            even[name][few] = [render(f"few{i}", name, few, PARTS + i) for i in range(2)]
        even[name][PARTS * part[name]] = [merge(even[name][part[name]])]
        if not SAMPLERS[name].batch:
            shared[name] = {
                n: [render("shared", name, n, _SHARED, adaptive=Adaptive())] for n in (part[name], PARTS * part[name])
            }
    # The reference is of the sampler with the least noise at equal time.
    middle = sum(even[n][PARTS * part[n]][0]["primal"].astype("f8") for n in names) / len(names)
    noise = {
        n: noise_of(*(s["primal"] for s in even[n][part[n]][:2]), middle) * part[n] * relative[n]
        for n in names
        if not SAMPLERS[n].biased
    }
    quiet = min(noise, key=lambda n: noise[n])
    batch = max(1, SAMPLERS[quiet].batch)
    spp = max(1, round(args.reference / relative[quiet] / batch)) * batch
    spp = kept.numbers(f"reference-{quiet}-{args.reference}", lambda: {"spp": spp})["spp"]
    halves = [render(f"reference{i}", quiet, spp, _REFERENCE | i)["primal"] for i in range(2)]

    rows: list[dict] = []
    for p in pipelines.measure(trials, time.process_time):
        errors, after = {}, []
        for n, stacks in (shared if p.shared else even)[p.sampler].items():
            each = []
            for stack in stacks:
                start = time.process_time()
                image = reconstruct(stack, p.method).image
                after.append(time.process_time() - start)
                each.append(relmse_trimmed(image, *halves))
            errors[str(n)] = max(statistics.mean(each), 1e-9)
        # Relative to the first sampler, whose seconds were measured in the same turns
        rows.append(
            {"pilot": vars(p), "errors": errors}
            | {"seconds": relative[p.sampler] * cost[first], "after": statistics.median(after)}
        )
    return {"reference": [quiet, spp], "first": first, "rows": [rounded(row) for row in rows]}


def rounded(value):
    """Numbers to five digits, in dicts too."""
    if isinstance(value, dict):
        return {name: rounded(one) for name, one in value.items()}
    return float(f"{value:.5g}") if isinstance(value, float) else value


def _trial(kept: Kept, scene, name: str, limit: float):
    """The pilot's stacks of a sampler, rendered or kept; None where it cannot render the scene, or not in the time."""
    from data_gen.choosing.trials import Trial, try_out

    made = []

    def make() -> dict:
        trial, _ = try_out(scene, name, time.process_time, limit)
        if trial is not None:
            made.extend(trial.stacks)
            for i, stack in enumerate(trial.stacks):
                kept.stack(f"pilot{i}-{name}", lambda stack=stack: stack)
        return {"seconds": None if trial is None else trial.seconds}

    seconds = kept.numbers(f"trial-{name}", make)["seconds"]
    if seconds is None:
        return None
    return Trial([kept.stack(f"pilot{i}-{name}", lambda i=i: made[i]) for i in range(4)], seconds)


def _cost(stacks: list[GradientStack]) -> float:
    """Seconds of a sample, the median of stacks."""
    return statistics.median(stack.attributes["bench:seconds"] / stack.attributes["ngpt:spp"] for stack in stacks)


def true_error(errors: dict[str, float], spp: float) -> float:
    """The error at a number of samples, interpolated between the measured ones, or extrapolated beyond them."""
    known = sorted((int(n), e) for n, e in errors.items())
    i = next((i for i in range(1, len(known) - 1) if spp < known[i][0]), len(known) - 1)
    (n0, e0), (n1, e1) = known[i - 1], known[i]
    return e0 * (spp / n0) ** (math.log(e1 / e0) / math.log(n1 / n0))


def cells(entry: dict) -> list[dict]:
    """For each time of ``LADDER`` samples of the first sampler: name -> error, the pilot's choice, and the error by the
    sampler that `--sampler auto` chooses over that by the best, both by a simple method."""
    from data_gen.choosing.pipelines import Pipeline, choose
    from data_gen.choosing.plans import best_of, simple

    pipelines = [Pipeline(**row["pilot"]) for row in entry["rows"]]
    unit = next(row["seconds"] for row in entry["rows"] if row["pilot"]["sampler"] == entry["first"])
    found = []
    for n in LADDER:
        # The time includes the slowest method.
        seconds = n * unit + max(row["after"] for row in entry["rows"])
        errors = {}
        for p, row in zip(pipelines, entry["rows"], strict=True):
            spp = replace(p, seconds=row["seconds"], after=row["after"]).samples(seconds)
            if spp >= max(p.least, 2):
                errors[name_of(p)] = true_error(row["errors"], spp)
        ranked = [p for p in choose(pipelines, seconds) if name_of(p) in errors]
        plain = [p for p in pipelines if p.method == simple(p.sampler) and not p.shared and name_of(p) in errors]
        by_sampler = {p.sampler: errors[name_of(p)] for p in plain}
        auto = by_sampler[best_of(plain, seconds)[0]] / min(by_sampler.values())
        found.append({"spp": n, "errors": errors, "choice": name_of(ranked[0]), "auto": auto})
    return found


def promises(result: dict) -> list[str]:
    """Lines: the true error over the expected one at times the pilot's samples, 10, 50 and 90 % and geometric mean, of
    methods by gradients with a network and of others, on all scenes; samples of ``gpt`` and ``primal``."""
    from data_gen.choosing.pipelines import Pipeline
    from ngpt.methods import METHODS

    found: dict[tuple[bool, int], list[float]] = {(network, n): [] for network in (True, False) for n in LADDER}
    for entry in result["scenes"].values():
        unit = next(row["seconds"] for row in entry["rows"] if row["pilot"]["sampler"] == entry["first"])
        longest = max(row["after"] for row in entry["rows"])
        for row in entry["rows"]:
            p = replace(Pipeline(**row["pilot"]), seconds=row["seconds"], after=row["after"])
            for n in LADDER if p.sampler in ("gpt", "primal") else ():
                spp = p.samples(n * unit + longest)
                if spp >= max(p.least, 2):
                    network = {"dx", "albedo"} <= set(METHODS[p.method].needs)
                    found[network, n].append(true_error(row["errors"], spp) / p.expected(spp))
    lines = []
    for (network, n), ratios in found.items():
        deciles = statistics.quantiles(ratios, n=10)
        ends = ", ".join(f"{deciles[i]:.2f}" for i in (0, 4, 8))
        lines.append(f"{'networks' if network else 'others'} at {n}: {ends}; {geometric_mean(ratios):.2f} in the mean")
    return ["true error over what was expected", *lines]


def name_of(p) -> str:
    return f"{p.sampler} {p.method}" + (" shared" if p.shared else "")


def table(result: dict) -> list[str]:
    """Lines: choice, regret, the best, for each scene and time; then geometric mean and worst; and of fixed choices."""
    lines, fixed = [], {False: {}, True: {}}
    regrets: dict[bool, list] = {False: [], True: []}
    autos: dict[bool, list] = {False: [], True: []}
    for scene, entry in result["scenes"].items():
        for cell in cells(entry):
            least = min(cell["errors"], key=lambda n: cell["errors"][n])
            ratios = {name: e / cell["errors"][least] for name, e in cell["errors"].items()}
            regrets[entry["apart"]].append(ratios[cell["choice"]])
            autos[entry["apart"]].append(cell["auto"])
            for name, ratio in ratios.items():
                fixed[entry["apart"]].setdefault(name, []).append(ratio)
                if not name.endswith(" shared"):
                    best = ratios.get(f"{name} shared", ratio)
                    fixed[entry["apart"]].setdefault(f"{name}, shared where there are enough", []).append(best)
            lines.append(f"| {scene} | {cell['spp']} | `{cell['choice']}` | {ratios[cell['choice']]:.2f} | `{least}` |")
    for apart, title in ((False, "chosen on"), (True, "apart")):
        if rows := regrets[apart]:
            lines.append(
                f"{title}: {geometric_mean(rows):.3f} in the mean, {max(rows):.2f} at worst, {len(rows)} cells"
            )
            by_auto = autos[apart]
            lines.append(f"  sampler auto, of samplers alone: {geometric_mean(by_auto):.3f}, {max(by_auto):.2f}")
            whole_rows = {n: r for n, r in fixed[apart].items() if len(r) == len(rows)}
            whole = {n: geometric_mean(r) for n, r in whole_rows.items()}
            for name in sorted(whole, key=lambda n: whole[n])[:8]:
                ahead = sum(r < 0.98 * ours for r, ours in zip(whole_rows[name], rows, strict=True))
                worst = max(whole_rows[name])
                lines.append(f"  always {name}: {whole[name]:.3f}, {worst:.2f}; ahead by 2 % in {ahead} cells")
    return lines


if __name__ == "__main__":
    main()
