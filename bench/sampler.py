"""Cost of our samplers as a ratio to Mitsuba's own `path` at the same samples per pixel, in one run, and what
gradients are worth: the variance of a difference of pixels over that of `dx` and `dy`.

    python -m bench.sampler -o bench/results/sampler.json

Times are of whole renders, features and film included, with kernels compiled before. Variances leave out pixels where
the camera sees a light, whose emission is in the primal but not in the gradients.
"""

import argparse
from functools import partial

import numpy as np

from bench.common import measure, metadata, save

SAMPLERS = ("primal", "gpt-basic", "gpt")


def variance_ratios(layers: dict[str, np.ndarray]) -> dict[str, float]:
    """Sum over the image of the variance of independent differences of neighbours, over that of the gradients."""
    dark = layers["direct"].sum(axis=-1) == 0
    ratios = {}
    for axis, name in ((1, "dx"), (0, "dy")):
        here, there = (np.s_[:, :-1], np.s_[:, 1:]) if axis == 1 else (np.s_[:-1], np.s_[1:])
        used = dark[here] & dark[there]
        independent = (layers["primal_var"][here] + layers["primal_var"][there])[used]
        ratios[name] = float(independent.sum() / layers[f"{name}_var"][here][used].sum())
    return ratios


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", required=True)
    parser.add_argument("--size", default="256x256", help="WxH in pixels")
    parser.add_argument("--scenes", nargs="*", help="scene files or built-in scenes (default: the built-in ones)")
    parser.add_argument("--spp", type=int, default=16)
    parser.add_argument("--repeats", type=int, default=7)
    args = parser.parse_args()

    from data_gen.backend import use_variant

    use_variant()
    import drjit as dr
    import mitsuba as mi

    from data_gen.builtin import SCENES
    from data_gen.render import load_scene, render_stack

    width, height = (int(n) for n in args.size.split("x"))
    result = {"benchmark": "sampler", "size": [width, height], "spp": args.spp, "scenes": {}}
    for name in args.scenes or SCENES:
        scene = load_scene(name, (width, height))
        stacks = {}

        def path(scene=scene):
            dr.eval(mi.render(scene, spp=args.spp))
            dr.sync_thread()

        def stack(sampler, scene=scene, stacks=stacks):
            stacks[sampler] = render_stack(scene, args.spp, sampler=sampler).layers

        times = measure({"path": path} | {sampler: partial(stack, sampler) for sampler in SAMPLERS}, args.repeats)
        cost = {sampler: times[sampler]["median"] / times["path"]["median"] for sampler in SAMPLERS}
        variance = {sampler: variance_ratios(stacks[sampler]) for sampler in ("gpt-basic", "gpt")}
        result["scenes"][name] = {"seconds": times, "ratio to path": cost, "variance ratio": variance}
        print(
            f"{name:12} "
            + "  ".join(f"{sampler} {ratio:.2f} x path" for sampler, ratio in cost.items())
            + "; variance "
            + "  ".join(f"{sampler} {v['dx']:.1f} {v['dy']:.1f}" for sampler, v in variance.items()),
            flush=True,
        )
    save(args.output, result | {"metadata": metadata("mitsuba", "drjit")})


if __name__ == "__main__":
    main()
