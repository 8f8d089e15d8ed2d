"""Compares the variances that stacks claim with the variances over seeds.

    python -m bench.claims coffee.xml staircase.xml --spp 16 64
    python -m bench.claims diffuse --sampler ppm --spp 5 9 17 --size 64 40

prints, for each scene and number of samples, the real variance divided by the one that the stack claims: of pixels, and
of means over 8x8 pixels, for `primal` (without the layer `caustic`), `caustic`, `dx` and `dy`. The noisiest 1 % of
pixels and 3 % of blocks are left out, since few seeds cannot measure them. Blocks of `dx` and `dy` are below 1 even
with independent samples, because pixels share paths.
"""

import argparse

import numpy as np

from bench.common import blocks, renderer, table
from ngpt.evaluation.config import scene_name

LAYERS = ("primal", "caustic", "dx", "dy")


def ratio(real: np.ndarray, claimed: np.ndarray, quiet: float) -> float:
    """The sum of the real variances over the sum of the claimed ones, (H, W, C), of the ``quiet`` share of pixels."""
    total = claimed.sum(axis=-1)
    among = total <= np.quantile(total, quiet)
    return float(real[among].sum() / claimed[among].sum())


def real_over_claimed(stacks: list[dict[str, np.ndarray]]) -> dict[str, str]:
    """Layer -> real over claimed variance of pixels and of blocks. ``stacks`` hold the layers (H, W, C) of one seed."""
    found = dict.fromkeys(LAYERS, "-")
    for layer in (layer for layer in LAYERS if f"{layer}_var" in stacks[0]):
        images = np.array([stack[layer] for stack in stacks], np.float64)
        if layer == "primal" and "caustic" in stacks[0]:
            images -= np.array([stack["caustic"] for stack in stacks])
        claimed = np.mean([stack[f"{layer}_var"] for stack in stacks], axis=0, dtype=np.float64)
        pixels = ratio(images.var(axis=0, ddof=1), claimed, 0.99)
        found[layer] = f"{pixels:.2f}, {ratio(blocks(images).var(axis=0, ddof=1), blocks(claimed) / 64, 0.97):.2f}"
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+")
    parser.add_argument("--sampler", default="gpt")
    parser.add_argument("--points", default="sobol")
    parser.add_argument("--tails", default="paths", help="shared: paths end in a cache, docs/samplers/tails.md")
    parser.add_argument("--spp", type=int, nargs="+", default=[16, 64])
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--size", type=int, nargs=2, default=(160, 96))
    args = parser.parse_args()
    load_scene, render_stack = renderer()
    options = {"points": args.points} | ({} if args.tails == "paths" else {"tails": args.tails})
    lines = []
    for name in args.scenes:
        scene = load_scene(name, tuple(args.size))
        for spp in args.spp:
            stacks = [render_stack(scene, spp, s, args.sampler, unbiased=True, **options) for s in range(args.seeds)]
            found = real_over_claimed([stack.layers for stack in stacks])
            lines.append([f"`{scene_name(name)}`, {spp}", *found.values()])
    table(["scene, spp", "primal: pixels, blocks", *LAYERS[1:]], lines)


if __name__ == "__main__":
    main()
