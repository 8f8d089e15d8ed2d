"""The picture of the idea: a noisy image, its two sampled gradients, and what a reconstruction makes of the three.

    python -m bench.idea --scene diffuse

renders one small stack (seconds for a built-in scene) and writes docs/images/idea.jpg. The reconstruction is the
classical `wcv`, which sees nothing but these layers and their variances.
"""

import argparse
from pathlib import Path

import numpy as np

from bench import panels
from bench.common import renderer
from ngpt.image.display import auto_exposure, signed_map, to_srgb8
from ngpt.methods import reconstruct

TILE = (392, 220)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", default="diffuse", help="a built-in scene or a Mitsuba scene file")
    parser.add_argument("--spp", type=int, default=16)
    parser.add_argument("--method", default="wcv")
    parser.add_argument("--picture", type=Path, default=Path("docs/images/idea.jpg"))
    args = parser.parse_args()
    load_scene, render_stack = renderer()
    stack = render_stack(load_scene(args.scene, TILE), args.spp)
    result = reconstruct(stack, args.method)
    exposure = auto_exposure(result.image)
    # The last column of dx and the last row of dy are no differences.
    dx, dy = (np.where(np.isfinite(stack[name]), stack[name], 0) for name in ("dx", "dy"))
    tiles = [to_srgb8(stack["primal"], exposure), signed_map(dx), signed_map(dy), to_srgb8(result.image, exposure)]
    lines = [
        ["primal", f"the noisy image, {args.spp} spp"],
        ["dx", "differences to the right neighbour"],
        ["dy", "differences to the neighbour below"],
        ["result", f"reconstructed from the three by {args.method}"],
    ]
    panels.save(args.picture, panels.columns(lines, [[tile] for tile in tiles]))


if __name__ == "__main__":
    main()
