"""Photons with and without gradients, path tracing with and without: errors at equal time on scenes with caustics.

    python -m bench.photons --cache out/photons --scenes glossy SCENE.xml ... --picture docs/images/photons.jpg

Time is processor time of all threads together, so that other work on the machine does not change the comparison. What a
sample costs is measured between two renders of one sampler; each gets as many as --seconds buy. The time in which the
kernels of a pass are recorded counts, which is most of it for small images with few photons. The reference is made by
photons, in two halves with their own seeds, of --reference-spp passes each with 16 light paths for each pixel, gathered
within 1 pixel at first: path tracing does not find all the light here. Its blur is that of the photon maps, a little,
on the photons' side. Errors are the trimmed relMSE.

Scenes with media have `bre` and `beams` for `ppm`, their gradient twins, and `vpm`. With --reference-by the reference
is by another sampler: `primal` or `bdpt`, which are right where they find the light, of --reference-spp samples. With
--samplers others are compared than those of the picture, which has a row for each scene of surfaces alone. Scenes that
are in the cache are not rendered again.
"""

import argparse
import json
import time
from pathlib import Path

import numpy as np

import ngpt
from bench import panels
from bench.common import metadata, save
from ngpt.evaluation.config import scene_name
from ngpt.io.exr import read_image
from ngpt.measure.metrics import relmse_trimmed
from ngpt.methods import denoise
from ngpt.report.display import auto_exposure, to_srgb8

# Sampler -> its reconstructions
METHODS = {
    "ppm": ("primal", "oidn"),
    "gpm": ("primal", "l1", "wcv"),
    "gpt": ("l1", "wcv"),
    "primal": ("oidn",),
    "bdpt": ("primal", "oidn"),
    "vcm": ("primal", "oidn"),
    "gvcm": ("primal", "l1", "wcv"),
    "gbdpt": ("l1", "wcv"),
}
METHODS_IN_MEDIA = {
    "bre": ("primal", "oidn"),
    "gbre": ("primal", "l1", "wcv"),
    "beams": ("primal", "oidn"),
    "gbeams": ("primal", "l1", "wcv"),
    "planes": ("primal", "oidn"),
    "gplanes": ("primal", "l1", "wcv"),
    "vpm": ("primal", "oidn"),
    "gpt": ("l1", "wcv"),
    "primal": ("primal", "oidn"),
}
PHOTONS = ("ppm", "gpm", "vpm", "bre", "gbre", "beams", "gbeams", "planes", "gplanes")
# Samplers with one sample of each pixel in a pass, or a few
IN_PASSES = (*PHOTONS, "bdpt", "gbdpt", "vcm", "gvcm")
DEFAULT = (*PHOTONS, "gpt", "primal")
SHOWN = (("ppm", "primal"), ("gpm", "l1"), ("gpm", "wcv"), ("gpt", "l1"), ("primal", "oidn"))
TITLES = {"primal": "path", "l1": "l1", "wcv": "wcv", "oidn": "OIDN"}
SETUP = ("size", "seconds", "radius", "photons", "reference_spp")
REFERENCE = {"radius": 1.0, "photons": 16}
TILE = 192


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", required=True)
    parser.add_argument("--size", type=int, nargs=2, default=(96, 54), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--seconds", type=float, default=8.0, help="processor time of a render")
    parser.add_argument("--reference-spp", type=int, default=96, help="of each half")
    parser.add_argument("--reference-by", metavar="SAMPLER", help="default: ppm, or bre in media")
    parser.add_argument("--samplers", nargs="+", default=DEFAULT, help="default: %(default)s")
    parser.add_argument("--radius", type=float, default=3.0, help="of the photons that are compared, in pixels")
    parser.add_argument("--vcm-radius", type=float, help="that of vcm and gvcm (default: their own)")
    parser.add_argument("--photons", type=int, default=1, help="light paths of a pass for each pixel")
    parser.add_argument("--cache", type=Path, required=True, help="folder for what is rendered, of one setup")
    parser.add_argument("--picture", type=Path)
    parser.add_argument("-o", "--output", default="bench/results/photons.json")
    args = parser.parse_args()

    from data_gen.backend import use_variant

    use_variant()
    setup = {name: getattr(args, name) for name in SETUP}
    result: dict = {"benchmark": "photons"} | setup | {"metadata": metadata("mitsuba"), "scenes": {}}
    rows = []
    for scene in args.scenes:
        folder = args.cache / scene_name(scene)
        if not (folder / "row.json").exists():
            row, images = bench_scene(scene, args)
            folder.mkdir(parents=True, exist_ok=True)
            for i, image in enumerate(images):
                ngpt.write(folder / f"{i}.exr", np.float32(image), overwrite=True)
            save(folder / "row.json", row)
        row = json.loads((folder / "row.json").read_text())
        images = [read_image(path) for path in sorted(folder.glob("*.exr"))]
        result["scenes"][scene_name(scene)] = row
        if len(images) > len(SHOWN) and all(sampler in row for sampler, _ in SHOWN):
            rows.append(images)
        save(args.output, result)
        print(scene_name(scene), row, flush=True)
        if args.picture and rows:
            panels.save(args.picture, picture(rows, result["scenes"]))


def bench_scene(path: str, args: argparse.Namespace) -> tuple[dict, list[np.ndarray]]:
    """Sampler -> samples and errors by method; and what the picture shows."""
    from data_gen.render import render_stack
    from data_gen.scenes.facts import media_of
    from data_gen.scenes.load import load_scene

    scene = load_scene(path, tuple(args.size))
    foggy = bool(media_of(scene))
    by = args.reference_by or ("bre" if foggy else "ppm")
    options = REFERENCE if by in PHOTONS else {}
    halves = [
        render_stack(scene, args.reference_spp, 1 << 20 | i, by, **options)["primal"].astype(np.float64)
        for i in range(2)
    ]
    row: dict = {"reference": by, "error of half a reference": relmse_trimmed(halves[0], halves[1])}
    shown = {}
    for sampler, methods in (METHODS_IN_MEDIA if foggy else METHODS).items():
        if sampler not in args.samplers:
            continue
        options = {"radius": args.radius, "photons": args.photons} if sampler in PHOTONS else {}
        if sampler in ("vcm", "gvcm") and args.vcm_radius:
            options = {"radius": args.vcm_radius}
        spp = samples_within(scene, sampler, args.seconds, options)
        stack = render_stack(scene, spp, 0, sampler, **options)
        row[sampler] = {"spp": spp}
        for method in methods:
            image = shown[sampler, method] = denoise(stack, method)
            row[sampler][method] = float(f"{relmse_trimmed(image, *halves):.4g}")
    return row, [shown[which] for which in SHOWN if which in shown] + [(halves[0] + halves[1]) / 2]


def samples_within(scene, sampler: str, seconds: float, options: dict) -> int:
    """How many samples per pixel so much processor time buys, at least 2."""
    from data_gen.render import render_stack

    def cost(spp: int) -> float:
        start = time.process_time()
        render_stack(scene, spp, 1, sampler, **options)
        return time.process_time() - start

    few, many = (4, 12) if sampler in IN_PASSES else (16, 64)
    cost(few)  # compiles the kernels
    fixed = cost(few)
    each = max(cost(many) - fixed, 1e-3) / (many - few)
    return max(2, round(1 + (seconds - fixed) / each))


def picture(rows: list[list[np.ndarray]], scenes: dict) -> np.ndarray:
    headings = []
    for sampler, method in SHOWN:
        name = TITLES[sampler] if sampler == "primal" else sampler
        what = name if method == "primal" else f"{name} and {TITLES[method]}"
        headings.append([what, ", ".join(f"{scene[sampler][method]:.3g}" for scene in scenes.values())])
    headings.append(["reference", "error (relMSE), by rows"])
    stops = [auto_exposure(row[-1]) for row in rows]
    tiles = []
    for column in range(len(headings)):
        size = TILE, TILE * rows[0][0].shape[0] // rows[0][0].shape[1]
        tiles.append([panels.scaled(to_srgb8(row[column], stop), size) for row, stop in zip(rows, stops, strict=True)])
    return panels.columns(headings, tiles)


if __name__ == "__main__":
    main()
