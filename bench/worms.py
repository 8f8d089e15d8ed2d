"""The gain by denoising the light of photons separately: the table of docs/samplers/photons.md.

    python -m bench.worms --folder SCENES --cache out/worms

SCENES has the scenes that are files, after Bitterli's resources. Each scene is rendered by `vcm` and denoised by OIDN:
all light at once, and without the light of photons, which `ngpt.denoisers.caustic` denoises. The reference has two
halves of other seeds, with a smaller radius. Renders are kept in the cache, so an interrupted run can be continued. It
writes bench/results/worms.json and the table between the marks of the page.
"""

import argparse
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import ngpt
from bench.common import metadata, rendered, save, write_page
from ngpt.evaluation.config import scene_name
from ngpt.layers import GATHERED
from ngpt.measure.flip import flip
from ngpt.measure.metrics import relmse, relmse_trimmed
from ngpt.stack import GradientStack

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "samplers" / "photons.md"
RESULT = ROOT / "bench" / "results" / "worms.json"
MARKS = ("<!-- python -m bench.worms: table -->", "<!-- table ends -->")
SEED, REFERENCE_SEEDS, RADIUS = 1, (101, 102), 2.0


class Case(NamedTuple):
    """A scene, samples per pixel, and how each half of its reference is rendered."""

    scene: str
    spp: tuple[int, ...]
    sampler: str = "vcm"
    reference_spp: int = 128
    radius: float = 0.5


CASES = (
    Case("bench/scenes/mirror-caustic/scene.xml", (4, 16, 64), reference_spp=256),
    Case("glossy", (4, 16)),
    # With a small radius `vcm` finds some of this light only by rare bright paths.
    Case("water-caustic/scene.xml", (4, 16), "ppm", 96, 1.0),
    Case("veach-bidir/scene.xml", (16,)),
    Case("glass-of-water/scene.xml", (16,)),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, default=Path(), help="of the scenes that are files")
    parser.add_argument("--size", type=int, nargs=2, default=(192, 108), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--cache", type=Path, required=True, help="folder for what is rendered")
    args = parser.parse_args()
    cells = [cell for case in CASES for cell in of_scene(args, case)]
    found = {"benchmark": "worms", "size": list(args.size), "cells": cells}
    save(RESULT, found | {"metadata": metadata("mitsuba", "mitsuba-oidn")})
    write_page(PAGE, table(cells), MARKS)


def of_scene(args: argparse.Namespace, case: Case) -> list[dict[str, Any]]:
    """The errors of both ways, for each number of samples."""
    scene = args.folder / case.scene if (args.folder / case.scene).exists() else case.scene
    render = partial(rendered, args.cache, args.size, scene)
    halves = [render(case.reference_spp, case.sampler, seed, radius=case.radius)["primal"] for seed in REFERENCE_SEEDS]
    middle, cells = sum(halves) / 2, []
    for spp in case.spp:
        stack = render(spp, "vcm", SEED, radius=RADIUS)
        for apart in (False, True):
            image = ngpt.denoise(GradientStack(stack.layers, {GATHERED: int(apart)}), "oidn")
            errors = {"relMSE": relmse(image, *halves), "relMSE trimmed": relmse_trimmed(image, *halves)}
            cell = {"scene": scene_name(case.scene), "spp": spp, "apart": apart}
            cells.append(cell | errors | {"FLIP": flip(image, middle)[0]})
    return cells


def table(cells: list[dict[str, Any]]) -> str:
    """A row for each scene and number of samples, both ways in it."""
    keys = ("relMSE", "relMSE trimmed", "FLIP")
    lines = [f"| scene, samples | {' | '.join(f'{key}, at once | apart' for key in keys)} |", f"|---|{'--:|' * 6}"]
    for whole, apart in zip(cells[::2], cells[1::2], strict=True):
        shown = [f"{cell[key]:.3f}" if key == "FLIP" else f"{cell[key]:.2g}" for key in keys for cell in (whole, apart)]
        lines.append(f"| {whole['scene']}, {whole['spp']} | {' | '.join(shown)} |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
