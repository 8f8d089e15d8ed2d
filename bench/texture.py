"""The gain by dividing the light of photons by the texture under them: docs/lab/log, 2026-W48.

    python -m bench.texture --cache out/texture

A point lamp shines through a ball of glass and into a ring of gold, onto a floor with checks, or with a cloudy texture.
`vcm` renders the scene. OIDN denoises the light that is not from photons. The benchmark prints two errors: with
photons' light as gathered (`ngpt.denoisers.caustic.denoised`), and divided by the albedo (`of_photons`). The reference
has two halves of other seeds, with a smaller radius. Renders are kept in the cache.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import mitsuba as mi
import numpy as np
from scipy.ndimage import gaussian_filter

from bench.common import kept
from data_gen.backend import use_variant
from data_gen.render import render_stack
from ngpt.denoisers import caustic
from ngpt.measure.flip import flip
from ngpt.measure.metrics import relmse_trimmed
from ngpt.methods import reconstruct
from ngpt.repair import repair
from ngpt.stack import GradientStack

SIZE = (128, 96)
# Samples and seeds; radius in pixels
CASES, RADIUS = ((4, 1), (16, 1), (16, 2), (64, 1)), 2.0
REFERENCES, REFERENCE_RADIUS = ((192, 101), (192, 102)), 0.5


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cache", type=Path, required=True, help="folder for what is rendered")
    args = parser.parse_args()
    use_variant("llvm_ad_rgb")
    for floor in ("checks", "clouds"):
        halves = [photons(args.cache, floor, *case, REFERENCE_RADIUS)["primal"] for case in REFERENCES]
        for spp, seed in CASES:
            stack = photons(args.cache, floor, spp, seed, RADIUS)
            after, data = reconstruct(stack, "oidn").image, repair(stack)
            before = after - caustic.of_photons(data) + caustic.denoised(data)
            for name, image in (("before", before), ("after", after)):
                errors = relmse_trimmed(image, *halves), flip(image, sum(halves) / 2)[0]
                print(f"{floor:7} {spp:3} spp, seed {seed}, {name:6}: relMSE trimmed %.5f, FLIP %.4f" % errors)


def photons(cache: Path, floor: str, spp: int, seed: int, radius: float) -> GradientStack:
    """A stack by ``vcm``, from the cache if it is there."""
    file = cache / f"{floor}-{spp}-{seed}.exr"
    return kept(file, lambda: render_stack(scene(floor), spp, seed, "vcm", radius=radius))


def scene(floor: str) -> mi.Scene:
    to = mi.ScalarTransform4f()
    matte = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": texture(floor)}}
    gold = {"type": "twosided", "bsdf": {"type": "conductor", "material": "Au"}}
    film = {"type": "hdrfilm", "width": SIZE[0], "height": SIZE[1], "rfilter": {"type": "box"}}
    view = to.look_at(origin=[0, 2.6, 3.6], target=[0, 0.25, 0], up=[0, 1, 0])
    parts = {
        "sensor": {"type": "perspective", "fov": 38, "to_world": view, "film": film},
        "floor": {"type": "rectangle", "to_world": to.rotate([1, 0, 0], -90).scale([4, 4, 1]), "bsdf": matte},
        "ball": {"type": "sphere", "center": [0, 0.7, 0], "radius": 0.6, "bsdf": {"type": "dielectric"}},
        "ring": {"type": "cylinder", "p0": [-1.3, 0, 0.2], "p1": [-1.3, 0.5, 0.2], "radius": 0.45, "bsdf": gold},
        "sky": {"type": "constant", "radiance": 0.08},
        "lamp": {"type": "point", "position": [1.2, 3, 0.8], "intensity": {"type": "rgb", "value": [9, 8, 7]}},
    }
    whole = {"type": "scene", "integrator": {"type": "path", "max_depth": 12}} | parts
    return mi.load_dict(whole, parallel=False, optimize=False)


def texture(floor: str) -> dict:
    if floor == "checks":
        light, dark = ({"type": "rgb", "value": colour} for colour in ([0.75, 0.7, 0.6], [0.2, 0.12, 0.08]))
        tiles = mi.ScalarTransform4f().scale([9, 9, 1])
        return {"type": "checkerboard", "color0": light, "color1": dark, "to_uv": tiles}
    noise, clouds = np.random.default_rng(3), np.zeros((256, 256))
    for sigma in (1, 2, 4, 8, 16):
        clouds += gaussian_filter(noise.normal(size=clouds.shape), sigma, mode="wrap") * sigma
    clouds = (clouds - clouds.min()) / np.ptp(clouds)
    colours = np.stack([0.1 + 0.75 * clouds, 0.08 + 0.6 * clouds, 0.05 + 0.45 * clouds], axis=-1)
    return {"type": "bitmap", "bitmap": mi.Bitmap(colours.astype(np.float32)), "raw": True}


if __name__ == "__main__":
    main()
