"""Is the sampler that a pilot chooses within 1.3 times of the best one: scene by scene, against a long render.

    python -m bench.pilot --scenes diffuse glossy SCENE.xml ... [--size 96 64]

    pilot     seconds to the error that the scene's own sampler has after --spp samples, over the least, as
              `--sampler auto` estimates them (data_gen/pilot.py)
    measured  the same from renders of --spp samples, reconstructed as the pilot does: their trimmed relMSE against two
              halves of a reference, times their seconds. The reference is that of the sampler with the least noise, of
              as many samples as --reference-spp.
    loss      the measured time of the sampler that the pilot chooses, over that of the best

Renders of the samplers take turns; seconds are the least of --seeds.
"""

import argparse
import math
import statistics

from bench.common import metadata, save
from ngpt.evaluation.config import scene_name
from ngpt.measure.metrics import relmse_trimmed
from ngpt.methods import reconstruct


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", required=True)
    parser.add_argument("--size", type=int, nargs=2, default=(96, 64), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--spp", type=int, default=32)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--reference-spp", type=int, default=512)
    parser.add_argument("-o", "--output", default="bench/results/pilot.json")
    args = parser.parse_args()

    from data_gen.backend import use_variant

    use_variant()
    setup = {"size": list(args.size), "spp": args.spp, "seeds": args.seeds, "reference spp": args.reference_spp}
    result: dict = {"benchmark": "pilot"} | setup | {"metadata": metadata("mitsuba"), "scenes": {}}
    for scene in args.scenes:
        row = result["scenes"][scene_name(scene)] = bench_scene(scene, args)
        save(args.output, result)
        ratios = [f"{name} {row['pilot'][name]:.3g} / {row['measured'][name]:.3g}" for name in row["pilot"]]
        print(f"{scene_name(scene):16} {row['choice']:8} loss {row['loss']:.2f}  {',  '.join(ratios)}", flush=True)
    losses = [row["loss"] for row in result["scenes"].values()]
    print(f"within 1.3: {sum(loss <= 1.3 for loss in losses)} of {len(losses)}, worst {max(losses):.2f}")


def bench_scene(path: str, args: argparse.Namespace) -> dict:
    """The choice, its loss, and times over the least by sampler."""
    from data_gen.pilot import best_of, seen, simple, times_to_the_end
    from data_gen.render import render_stack
    from data_gen.scenes.load import load_scene
    from data_gen.trials import candidates, try_all

    scene = load_scene(path, tuple(args.size))
    trials = try_all(scene, candidates(scene))
    expected = seen(trials)
    seconds = args.spp * expected[0].seconds
    pilot = times_to_the_end(expected, seconds)
    choice, reason = best_of(expected, seconds)
    stacks: dict[str, list] = {name: [] for name in trials}
    for seed in range(args.seeds):
        for name, rendered in stacks.items():
            rendered.append(render_stack(scene, args.spp, seed, name))
    quietest = min(stacks, key=lambda name: relmse_trimmed(*(stack["primal"] for stack in stacks[name][:2])))
    halves = [render_stack(scene, args.reference_spp // 2, 1 << 20 | i, quietest)["primal"] for i in range(2)]
    errors, measured = {}, {}
    for name, rendered in stacks.items():
        logs = [math.log(max(relmse_trimmed(reconstruct(s, simple(name)).image, *halves), 1e-9)) for s in rendered]
        errors[name] = math.exp(statistics.mean(logs))
        measured[name] = errors[name] * min(float(stack.attributes["ngpt:seconds"]) for stack in rendered)
    least = {"pilot": min(pilot.values()), "measured": min(measured.values())}
    return {
        "choice": choice,
        "reason": reason,
        "loss": measured[choice] / least["measured"],
        "pilot": {name: value / least["pilot"] for name, value in pilot.items()},
        "measured": {name: value / least["measured"] for name, value in measured.items()},
        "relMSE": errors,
        "reference": quietest,
    }


if __name__ == "__main__":
    main()
