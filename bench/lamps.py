"""What the choice of lamps is worth: variance and time by place, and uniform, relative to weights of the whole scene.

    python -m bench.hall out/hall.xml
    python -m bench.lamps out/hall.xml bistro-chalice/scene.xml

prints, scene by scene, the variance over seeds of pixels of the primal (without the layer `caustic`) and of means over
8x8 pixels, and both for `dx`; then the processor time of a sample, without the pilot. The noisiest 1 % of pixels and
3 % of blocks, over all ways together, are left out, since few seeds cannot measure them. The promise is the pilot's
estimate for direct light: lamps are chosen by place where it is below `data_gen.scenes.lamps.PROMISE`.
"""

import argparse
import os
import time

import numpy as np

from bench.claims import blocks
from ngpt.evaluation.config import scene_name

# By place where the pilot promises less than so much of the variance, and the option that goes with it
WAYS = {"whole": (0.0, "power"), "place": (np.inf, "power"), "alike": (0.0, "uniform")}


def variances(stacks: list) -> dict[str, np.ndarray]:
    """Variances of pixels and of blocks over seeds, summed over the colour channels."""
    found = {}
    for layer in ("primal", "dx"):
        if layer not in stacks[0].names:
            continue
        images = np.array([stack[layer] for stack in stacks], np.float64)
        if layer == "primal" and "caustic" in stacks[0].names:
            images -= np.array([stack["caustic"] for stack in stacks])
        found[layer] = images.var(axis=0, ddof=1).sum(axis=-1)
        found[f"{layer}, blocks"] = blocks(images).var(axis=0, ddof=1).sum(axis=-1)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+")
    parser.add_argument("--samplers", nargs="+", default=["gpt", "primal"])
    parser.add_argument("--spp", type=int, default=16)
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--size", type=int, nargs=2, default=(96, 64))
    args = parser.parse_args()
    from data_gen.backend import use_variant
    from data_gen.render import render_stack
    from data_gen.scenes import lamps
    from data_gen.scenes.load import load_scene

    use_variant("llvm_ad_rgb")
    lamps.MANY = 2
    print("| scene, sampler | lamps | promise | by place | time | alike |\n|---|--:|--:|--:|--:|--:|")
    for name in args.scenes:
        scene = load_scene(os.fspath(name), tuple(args.size))
        promise = f"{lamps.promised(scene, lamps.lamp_weights(scene))[0]:.2f}"
        for sampler in args.samplers:
            found, seconds = {}, {}
            for way, (lamps.PROMISE, option) in WAYS.items():
                stacks, took = [], []
                for seed in range(args.seeds + 1):
                    passes: list[float] = []
                    report = lambda *_, passes=passes: passes.append(time.process_time())  # noqa: E731
                    stacks.append(render_stack(scene, args.spp, seed, sampler, report, lamps=option))
                    took.append(passes[-1] - passes[0])
                # The first one compiles.
                found[way], seconds[way] = variances(stacks[1:]), min(took[1:])
            ratios = {}
            for layer in found["whole"]:
                total = sum(each[layer] for each in found.values())
                quiet = total <= np.quantile(total, 0.97 if "blocks" in layer else 0.99)
                sums = {way: each[layer][quiet].sum() for way, each in found.items()}
                for way, value in sums.items():
                    ratios.setdefault(way, []).append(f"{value / sums['whole']:.2f}")
            more = f"{seconds['place'] / seconds['whole']:.2f}"
            cells = [str(len(scene.emitters())), promise, ", ".join(ratios["place"]), more, ", ".join(ratios["alike"])]
            print(f"| `{scene_name(name)}`, `{sampler}` | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
