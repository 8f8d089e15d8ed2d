"""Cost of our samplers as a ratio to Mitsuba's own `path` at the same samples per pixel, in one run.

    python -m bench.sampler -o bench/results/sampler.json

Times are of whole renders, features and film included, with kernels compiled before.
"""

import argparse

from bench.common import measure, metadata, save


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", required=True)
    parser.add_argument("--size", type=int, default=256, help="edge of the square image in pixels")
    parser.add_argument("--spp", type=int, default=16)
    parser.add_argument("--repeats", type=int, default=7)
    args = parser.parse_args()

    from data_gen.backend import use_variant

    use_variant()
    import drjit as dr
    import mitsuba as mi

    from data_gen.builtin import SCENES
    from data_gen.render import load_scene, render_stack

    result = {"benchmark": "sampler", "size": args.size, "spp": args.spp, "scenes": {}}
    for name in SCENES:
        scene = load_scene(name, (args.size, args.size))

        def path(scene=scene):
            dr.eval(mi.render(scene, spp=args.spp))
            dr.sync_thread()

        calls = {"path": path}
        for sampler in ("primal", "gpt-basic"):
            calls[sampler] = lambda scene=scene, sampler=sampler: render_stack(scene, args.spp, sampler=sampler)
        times = measure(calls, args.repeats)
        ratios = {sampler: times[sampler]["median"] / times["path"]["median"] for sampler in ("primal", "gpt-basic")}
        result["scenes"][name] = {"seconds": times, "ratio to path": ratios}
        print(f"{name:12} " + "  ".join(f"{sampler} {ratio:.2f} x path" for sampler, ratio in ratios.items()))
    save(args.output, result | {"metadata": metadata("mitsuba", "drjit")})


if __name__ == "__main__":
    main()
