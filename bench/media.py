"""What gradients cost and gain in scenes with media: the first table of docs/samplers/media.md.

    python -m bench.media --scenes haze smoke cloud SCENE.xml ... [-o bench/results/media.json]

    cost      seconds of a stack of `gpt` (features, variances, film) over those of Mitsuba's integrator of the scene at
              the same samples per pixel, rendered in turn, kernels compiled before: median and quartiles
    gain      variance of the differences of independent pixels over that of `dx` and `dy`. Both are variances between
              --renders renders with seeds of their own, and of the light that has differences: what is in the layers
              `direct` and `caustic` is taken off. Over the sum of all pixels, and in the median pixel
    failed    the share of shifts that are rejected
    caustic   the share of light that is in the layer `caustic`, and has no differences

A table is printed; all numbers are written as JSON.
"""

import argparse
import time

import numpy as np

from bench.common import metadata, save, summary
from ngpt.evaluation.config import scene_name
from ngpt.io.exr import pass_through

FAILURES = "diagnostics.shiftFailures"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=["haze", "smoke", "cloud"])
    parser.add_argument("--size", type=int, nargs=2, default=(96, 54), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--spp", type=int, default=16)
    parser.add_argument("--renders", type=int, default=16, help="of which variances are taken")
    parser.add_argument("--timing-spp", type=int, default=64)
    parser.add_argument("--repeats", type=int, default=4, help="of times")
    parser.add_argument("-o", "--output", default="bench/results/media.json")
    args = parser.parse_args()

    from data_gen.backend import use_variant

    use_variant()
    setup = {"size": list(args.size), "spp": args.spp, "renders": args.renders, "timing spp": args.timing_spp}
    result: dict = {"benchmark": "media"} | setup | {"metadata": metadata("mitsuba", "drjit"), "scenes": {}}
    print("| scene | cost | gain, sum | gain, median pixel | failed shifts | light in `caustic` |")
    print("|---|--:|--:|--:|--:|--:|")
    for scene in args.scenes:
        row = result["scenes"][scene_name(scene)] = bench_scene(scene, args)
        save(args.output, result)
        print(line(scene_name(scene), row), flush=True)


def bench_scene(file: str, args: argparse.Namespace) -> dict:
    from data_gen.render import render_stack
    from data_gen.scenes.load import load_scene

    scene = load_scene(file, (args.size[0], args.size[1]))
    stacks = (render_stack(scene, args.spp, 100 + seed, "gpt", diagnostics=True) for seed in range(args.renders))
    return {"cost": cost(scene, args)} | gains(list(stacks))


def cost(scene, args: argparse.Namespace) -> dict[str, float]:
    """Of `gpt` over the scene's own integrator, in ratios of two renders one after the other."""
    import drjit as dr
    import mitsuba as mi

    from data_gen.render import render_stack

    ratios = []
    for seed in range(args.repeats + 1):
        start = time.perf_counter()
        dr.eval(mi.render(scene, spp=args.timing_spp, seed=seed))
        dr.sync_thread()
        between = time.perf_counter()
        render_stack(scene, args.timing_spp, seed, "gpt")
        # The first of each compiles kernels.
        if seed:
            ratios.append((time.perf_counter() - between) / (between - start))
    return summary(ratios)


def gains(stacks: list) -> dict[str, float]:
    """Of renders of one scene, (H, W, 3) layers each."""
    # Scenes without polished surfaces have no layer `caustic`.
    light, direct, caustic = (
        np.array([stack[name] for stack in stacks if name in stack.layers] or [0.0], np.float64)
        for name in ("primal", "direct", "caustic")
    )
    even = light - direct - caustic
    of_light = even.var(axis=0, ddof=1).sum(axis=-1)
    independent, correlated = [], []
    for name, here, there in (("dx", np.s_[:, :-1], np.s_[:, 1:]), ("dy", np.s_[:-1], np.s_[1:])):
        independent.append((of_light[here] + of_light[there]).ravel())
        differences = np.array([stack[name][here] for stack in stacks], np.float64)
        correlated.append(differences.var(axis=0, ddof=1).sum(axis=-1).ravel())
    theirs, ours = np.concatenate(independent), np.concatenate(correlated)
    lit = (theirs > 0) & (ours > 0)
    return {
        "gain": float(theirs.sum() / ours.sum()),
        "gain in the median pixel": float(np.median(theirs[lit] / ours[lit])),
        "failed shifts": float(np.mean([pass_through(stack)[FAILURES].mean() for stack in stacks])),
        "light in caustic": float(caustic.sum() / light.sum()),
    }


def line(name: str, row: dict) -> str:
    cells = [name, f"{row['cost']['median']:.2f}", f"{row['gain']:.2g}", f"{row['gain in the median pixel']:.2g}"]
    cells += [f"{row['failed shifts']:.1%}", f"{row['light in caustic']:.0%}"]
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    main()
