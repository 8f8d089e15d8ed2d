"""What stacks say of their noise, against the noise over seeds.

    python -m bench.claims coffee.xml staircase.xml --spp 16 64

prints, scene by scene, the real variance over the one that the stack claims: of pixels, and of means over 8x8 pixels,
`primal` (without the layer `caustic`), `dx` and `dy`. The noisiest 1 % of pixels and 3 % of blocks are left out, since
few seeds say nothing of them. Blocks of `dx` and `dy` are below 1 with independent samples, too: pixels share paths.
"""

import argparse
import os

import numpy as np

from ngpt.evaluation.config import scene_name


def blocks(image: np.ndarray, side: int = 8) -> np.ndarray:
    """Means over blocks of (..., H, W, C)."""
    *n, h, w, c = image.shape
    image = image[..., : h // side * side, : w // side * side, :]
    return image.reshape(*n, h // side, side, w // side, side, c).mean(axis=(-4, -2))


def ratio(real: np.ndarray, claimed: np.ndarray, quiet: float) -> float:
    """Real over claimed of the ``quiet`` share of (H, W, C)."""
    total = claimed.sum(axis=-1)
    among = total <= np.quantile(total, quiet)
    return float(real[among].sum() / claimed[among].sum())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+")
    parser.add_argument("--sampler", default="gpt")
    parser.add_argument("--points", default="sobol")
    parser.add_argument("--spp", type=int, nargs="+", default=[16, 64])
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--size", type=int, nargs=2, default=(160, 96))
    args = parser.parse_args()
    from data_gen.backend import use_variant
    from data_gen.render import render_stack
    from data_gen.scenes.load import load_scene

    use_variant("llvm_ad_rgb")
    print("| scene, spp | primal: pixels, blocks | dx | dy |\n|---|--:|--:|--:|")
    for name in args.scenes:
        scene = load_scene(os.fspath(name), tuple(args.size))
        for spp in args.spp:
            stacks = [render_stack(scene, spp, s, args.sampler, points=args.points) for s in range(args.seeds)]
            texts = []
            for layer in ("primal", "dx", "dy"):
                if layer not in stacks[0].names:
                    continue
                images = np.array([stack[layer] for stack in stacks], np.float64)
                if layer == "primal" and "caustic" in stacks[0].names:
                    images -= np.array([stack["caustic"] for stack in stacks])
                claimed = np.mean([stack[f"{layer}_var"] for stack in stacks], axis=0, dtype=np.float64)
                pixels = ratio(images.var(axis=0, ddof=1), claimed, 0.99)
                means = ratio(blocks(images).var(axis=0, ddof=1), blocks(claimed) / 64, 0.97)
                texts.append(f"{pixels:.2f}, {means:.2f}")
            print(f"| `{scene_name(name)}`, {spp} | {' | '.join(texts)} |", flush=True)


if __name__ == "__main__":
    main()
