"""Is the sampler that a pilot chooses about the best one: scene by scene, at equal time, against a long render.

    python -m bench.pilot --scenes diffuse glossy SCENE.xml ... [--size 96 64] [--seconds 4]
    python -m bench.pilot --also vcm gvcm --reference-by vcm --scenes bench/scenes/mirror-caustic/scene.xml

Time is processor time of all threads together, so that other work on the machine does not change the comparison.

    trial     seconds of each sampler's trial in the pilot, kernels recorded and compiled
    pilot     seconds to the error that the scene's own sampler has in the end, over the least, as `--sampler auto`
              estimates them (data_gen/choosing/pilot.py)
    relMSE    of renders of as many samples as --seconds buy, reconstructed as the pilot does, trimmed, the geometric
              mean over --seeds; kernels are recorded before
    loss      that of the sampler that the pilot chooses, over the least

Of each: without the samplers that are named by --also, and with them tried last. The pilot's images may have a size of
their own (--pilot-size), and what a render takes is scaled with the pixels. The reference is two halves of
--reference-spp samples each by --reference-by; photons are gathered within half a pixel at first there.
"""

import argparse
import math
import statistics
import time

from bench.common import metadata, save
from ngpt.evaluation.config import scene_name
from ngpt.measure.metrics import relmse_trimmed
from ngpt.methods import reconstruct

REFERENCE_RADIUS = 0.5


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", required=True)
    parser.add_argument("--also", nargs="*", default=[], metavar="SAMPLER", help="tried after all those of a pilot")
    parser.add_argument("--size", type=int, nargs=2, default=(96, 64), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--pilot-size", type=int, nargs=2, metavar=("WIDTH", "HEIGHT"), help="default: --size")
    parser.add_argument("--seconds", type=float, default=4.0, help="processor time of a render")
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--reference-spp", type=int, default=512, help="of each half")
    parser.add_argument("--reference-by", metavar="SAMPLER", default="primal", help="default: %(default)s")
    parser.add_argument("-o", "--output", default="bench/results/pilot.json")
    args = parser.parse_args()
    args.pilot_size = args.pilot_size or args.size

    from data_gen.backend import use_variant

    use_variant()
    names = ("size", "pilot_size", "seconds", "seeds", "also")
    setup = {name.replace("_", " "): getattr(args, name) for name in names}
    result: dict = {"benchmark": "pilot"} | setup | {"metadata": metadata("mitsuba"), "scenes": {}}
    for scene in args.scenes:
        row = result["scenes"][scene_name(scene)] = bench_scene(scene, args)
        save(args.output, result)
        print(scene_name(scene), row, flush=True)


def bench_scene(path: str, args: argparse.Namespace) -> dict:
    """The choices, their losses, and errors and times by sampler."""
    from data_gen.choosing.pilot import best_of, seen, simple, times_to_the_end
    from data_gen.choosing.trials import candidates, try_out
    from data_gen.render import render_stack
    from data_gen.samplers import SAMPLERS
    from data_gen.scenes.load import load_scene

    small = load_scene(path, tuple(args.pilot_size))
    usual = candidates(small, biased=True)
    trials, took = {}, {}
    for name in dict.fromkeys([*usual, *args.also]):
        start = time.process_time()
        if (trial := try_out(small, name, time.process_time)) is not None:
            trials[name], took[name] = trial, round(time.process_time() - start, 2)
    seconds = args.seconds * math.prod(args.pilot_size) / math.prod(args.size)

    scene = load_scene(path, tuple(args.size))
    options = {"radius": REFERENCE_RADIUS} if SAMPLERS[args.reference_by].biased else {}
    halves = [
        render_stack(scene, args.reference_spp, 1 << 20 | i, args.reference_by, **options)["primal"] for i in range(2)
    ]
    errors, samples = {}, {}
    for name in trials:
        batch = SAMPLERS[name].batch
        spp = samples[name] = max(2, 2 * batch, round(args.seconds / cost(scene, name)))
        stacks = [render_stack(scene, spp, seed, name) for seed in range(args.seeds)]
        logs = [math.log(max(relmse_trimmed(reconstruct(s, simple(name)).image, *halves), 1e-9)) for s in stacks]
        errors[name] = math.exp(statistics.mean(logs))
    row: dict = {
        "trial": took,
        "samples": samples,
        "relMSE": {name: float(f"{error:.4g}") for name, error in errors.items()},
        "reference": args.reference_by,
        "error of half a reference": relmse_trimmed(*halves),
    }
    for which, names in (("without", [n for n in trials if n in usual and n not in args.also]), ("with", list(trials))):
        expected = seen({name: trials[name] for name in names})
        times = times_to_the_end(expected, seconds)
        choice, reason = best_of(expected, seconds)
        row[which] = {
            "choice": choice,
            "reason": reason,
            "loss": round(errors[choice] / min(errors[name] for name in trials), 3),
            "pilot": {name: float(f"{t / min(times.values()):.3g}") for name, t in times.items()},
            "expected": {p.sampler: [float(f"{v:.3g}") for v in (p.error, p.doubt, p.seconds)] for p in expected},
        }
    return row


def cost(scene, sampler: str) -> float:
    """Processor seconds of a sample: by two renders, of which the first samples are not counted."""
    from data_gen.render import render_stack
    from data_gen.samplers import SAMPLERS

    def took(spp: int) -> float:
        start = time.process_time()
        render_stack(scene, spp, 1, sampler)
        return time.process_time() - start

    batch = SAMPLERS[sampler].batch
    few, many = (batch, 3 * batch) if batch > 1 else (3, 9) if batch else (16, 64)
    took(few)  # compiles
    few_took, many_took = (min(took(spp) for _ in range(2)) for spp in (few, many))
    return max(many_took - few_took, 1e-3) / (many - few)


if __name__ == "__main__":
    main()
