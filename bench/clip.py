"""A clip of a moving camera: paths without gradients, results frame by frame and over time, side by side.

    python -m bench.clip --scene glossy --cache out/clip --picture docs/images/shot.webp

All three take about the same time: ``--spp`` samples with gradients, ``--plain`` without. The camera moves as in
``bench.shots``.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from PIL import Image

import ngpt
from bench.common import renderer
from bench.shots import SPEEDS, shot_of
from ngpt.image.display import auto_exposure, to_srgb8
from ngpt.sequence.history import Temporal


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", default="glossy", help="a file, or a built-in scene")
    parser.add_argument("--shot", default="slow", choices=SPEEDS)
    parser.add_argument("--method", default="ngpt-fast")
    parser.add_argument("--frames", type=int, default=16)
    parser.add_argument("--size", default="176x132")
    parser.add_argument("--spp", type=int, default=8)
    parser.add_argument("--plain", type=int, default=16)
    parser.add_argument("--cache", type=Path, required=True, help="folder for what is rendered; files there are kept")
    parser.add_argument("--picture", type=Path, required=True)
    args = parser.parse_args()
    pages = [Image.fromarray(page) for page in frames(args)]
    args.picture.parent.mkdir(parents=True, exist_ok=True)
    pages[0].save(args.picture, save_all=True, append_images=pages[1:], duration=125, loop=0, quality=80, method=6)


def frames(args: argparse.Namespace) -> Iterator[np.ndarray]:
    """(H, 3 W, 3) bytes of each frame."""
    renderer()
    from data_gen.frames.shot import render_shot

    shot = shot_of(None, args.scene, args.shot, args.size)
    kinds = []
    for sampler, spp in (("gpt", args.spp), ("primal", args.plain)):
        files = [args.cache / sampler / f"{frame:04d}.exr" for frame in range(args.frames)]
        files[0].parent.mkdir(parents=True, exist_ok=True)
        there = [file.exists() for file in files]
        for frame, stack in render_shot(shot, range(args.frames), spp, 1, skip=there.__getitem__, sampler=sampler):
            ngpt.write(files[frame], stack)
        kinds.append([ngpt.read(file) for file in files])
    temporal, exposure = Temporal(), None
    for stack, noisy in zip(*kinds, strict=True):
        image = ngpt.denoise(stack, method=args.method)
        blended = temporal.next(stack, image)
        exposure = auto_exposure(blended) if exposure is None else exposure
        yield to_srgb8(np.concatenate([noisy["primal"], image, blended], axis=1), exposure)


if __name__ == "__main__":
    main()
