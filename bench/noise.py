"""The noise of independent points and uniform lamps, compared to the noise of better samples, and both denoised.

    python -m bench.noise diffuse

writes docs/images/points.jpg. Numbers are the relative RMSE of the crop that is shown, against many samples.
"""

import argparse
import os
from pathlib import Path

import numpy as np

from bench import panels
from bench.common import renderer
from ngpt.image.display import auto_exposure, to_srgb8
from ngpt.methods import reconstruct

BEFORE = {"points": "independent", "lamps": "uniform"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", help="a scene file or a built-in scene")
    parser.add_argument("--size", type=int, nargs=2, default=(360, 240), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--crop", type=int, nargs=4, default=(120, 70, 120, 80), metavar=("X", "Y", "WIDTH", "HEIGHT"))
    parser.add_argument("--spp", type=int, default=4)
    parser.add_argument("--reference", type=int, default=1024)
    parser.add_argument("--method", default="oidn")
    parser.add_argument("--picture", type=Path, default=Path("docs/images/points.jpg"))
    args = parser.parse_args()
    load_scene, render_stack = renderer()
    scene = load_scene(os.fspath(args.scene), tuple(args.size))
    x, y, width, height = args.crop
    crop = np.s_[y : y + height, x : x + width]
    reference = render_stack(scene, args.reference, 1, "primal", features=False)["primal"][crop]
    exposure = auto_exposure(reference)
    headings, tiles = [], []
    for name, options in (("before", BEFORE), ("better samples", {})):
        stack = render_stack(scene, args.spp, 0, "primal", **options)
        images = [stack["primal"][crop], reconstruct(stack, args.method).image[crop]]
        errors = [np.sqrt(np.square(image - reference).mean()) / reference.mean() for image in images]
        headings.append([name, f"error {errors[0]:.3f}", f"{args.method}: {errors[1]:.3f}"])
        tiles.append([panels.scaled(to_srgb8(image, exposure), (3 * width, 3 * height)) for image in images])
        print(*headings[-1])
    headings.append(["reference", f"{args.reference} spp", ""])
    blank = np.full((3 * height, 3 * width, 3), 255, np.uint8)
    tiles.append([panels.scaled(to_srgb8(reference, exposure), (3 * width, 3 * height)), blank])
    panels.save(args.picture, panels.columns(headings, tiles))


if __name__ == "__main__":
    main()
