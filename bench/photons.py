"""Photons with and without gradients, path tracing with and without: errors at equal time on scenes with caustics.

    python -m bench.photons --cache out/photons --scenes glossy SCENE.xml ... --picture docs/images/photons.jpg --docs
    python -m bench.photons --table                                                         # of what is in the file

Time is processor time of all threads together, so that other work on the machine does not change the comparison. What a
sample costs is measured between two renders of one sampler, the least of two, all samplers in turn; each gets as many
as --seconds buy. What it takes to record the kernels of a render is not in that: images here are small, and renders
short. The reference is made by photons, in two halves with their own seeds, of --reference-spp passes each with 16
light paths for each pixel, gathered within 1 pixel at first: path tracing does not find all the light here. Its blur is
that of the photon maps, a little, on the photons' side. Errors are the trimmed relMSE.

Scenes with media have `vpm`, `bre`, `beams` and `planes` for `ppm`, and their gradient twins. Samplers that refuse a
scene are left out of it. With --reference-by the reference is by another sampler: `primal` or `bdpt`, which are right
where they find the light, of --reference-spp samples. With --samplers others are compared. With --seeds each is
rendered so often: errors are the medians, and those of all seeds are in the file.

Scenes of the file that are not named stay as they are, each with its own setup, so scenes with references of several
kinds are several calls. Scenes that are in the cache are not rendered again. The picture has a row for each scene of
the call. --docs puts the tables into the page.
"""

import argparse
import json
import statistics
import time
from pathlib import Path

import numpy as np

import ngpt
from bench import panels
from bench.common import metadata, save, write_page
from ngpt.errors import NgptError
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
    "primal": ("primal", "oidn"),
    "bdpt": ("primal", "oidn"),
    "vcm": ("primal", "oidn"),
    "gvcm": ("primal", "l1", "wcv"),
    "gbdpt": ("l1", "wcv"),
}
METHODS_IN_MEDIA = {
    "vpm": ("primal", "oidn"),
    "gvpm": ("primal", "l1", "wcv"),
    "bre": ("primal", "oidn"),
    "gbre": ("primal", "l1", "wcv"),
    "beams": ("primal", "oidn"),
    "gbeams": ("primal", "l1", "wcv"),
    "planes": ("primal", "oidn"),
    "gplanes": ("primal", "l1", "wcv"),
    "gpt": ("l1", "wcv"),
    "primal": ("primal", "oidn"),
}
# Each photon sampler, its gradient twin, and the dimensions in which it blurs, in media
TWINS = {"ppm": ("gpm", 2), "vpm": ("gvpm", 3), "bre": ("gbre", 2), "beams": ("gbeams", 1), "planes": ("gplanes", 0)}
PHOTONS = (*TWINS, *(twin for twin, _ in TWINS.values()))
TWINS |= {"vcm": ("gvcm", 2)}
# Samplers whose passes take long; and those with one sample of each pixel in a pass, or a few
LONG = ("beams", "gbeams", "planes", "gplanes")
IN_PASSES = (*PHOTONS, "bdpt", "gbdpt", "vcm", "gvcm")
DEFAULT = (*PHOTONS, "vcm", "gvcm", "gbdpt", "gpt", "primal")
# Columns of the picture: samplers on surfaces and in media, and the method
SHOWN = (
    (("ppm", "vpm"), "primal"),
    (("gpm", "gvpm"), "l1"),
    (("gpt", "gpt"), "l1"),
    (("primal", "primal"), "oidn"),
)
TITLES = {"primal": "path", "l1": "l1", "wcv": "wcv", "oidn": "OIDN"}
SETUP = ("size", "seconds", "seeds", "radius", "photons")
REFERENCE = {"radius": 1.0, "photons": 16}
PAGE = Path("docs/samplers/photons.md")
MARKS = "<!-- python -m bench.photons -->", "<!-- ends here -->"
TILE = 192


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=[])
    parser.add_argument("--size", type=int, nargs=2, default=(96, 54), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--seconds", type=float, default=8.0, help="processor time of a render")
    parser.add_argument("--seeds", type=int, default=1, help="renders of each sampler (default: %(default)s)")
    parser.add_argument("--reference-spp", type=int, default=96, help="of each half")
    parser.add_argument("--reference-by", metavar="SAMPLER", help="default: ppm, or bre in media")
    parser.add_argument("--samplers", nargs="+", default=DEFAULT, help="default: %(default)s")
    parser.add_argument("--radius", type=float, default=3.0, help="of the photons that are compared, in pixels")
    parser.add_argument("--vcm-radius", type=float, help="that of vcm and gvcm (default: their own)")
    parser.add_argument("--photons", type=int, default=1, help="light paths of a pass for each pixel")
    parser.add_argument("--cache", type=Path, default="out/photons", help="folder for what is rendered, of one setup")
    parser.add_argument("--picture", type=Path)
    parser.add_argument("-o", "--output", type=Path, default="bench/results/photons.json")
    parser.add_argument("--table", action="store_true", help="print the tables of the file, and measure nothing")
    parser.add_argument("--docs", action="store_true", help=f"write the tables into {PAGE}")
    args = parser.parse_args()
    if args.table:
        print(table(json.loads(args.output.read_text())))
        return

    from data_gen.backend import use_variant

    use_variant()
    before = json.loads(args.output.read_text())["scenes"] if args.output.exists() else {}
    result: dict = {"benchmark": "photons", "metadata": metadata("mitsuba"), "scenes": before}
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
        if len(images) > len(SHOWN):
            rows.append(images)
        save(args.output, result)
        print(scene_name(scene), row, flush=True)
    if args.picture and rows:
        panels.save(args.picture, picture(rows))
    if args.docs:
        write_page(PAGE, table(result), MARKS)


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
    row: dict = {name: getattr(args, name) for name in SETUP}
    row |= {"media": foggy, "reference": by, "error of half a reference": relmse_trimmed(halves[0], halves[1])}
    wanted = {
        sampler: {"radius": args.radius, "photons": args.photons} if sampler in PHOTONS else {}
        for sampler in (METHODS_IN_MEDIA if foggy else METHODS)
        if sampler in args.samplers
    }
    if args.vcm_radius:
        wanted |= {sampler: {"radius": args.vcm_radius} for sampler in ("vcm", "gvcm") if sampler in wanted}
    shown = {}
    for sampler, (_, each) in costs_of(scene, wanted).items():
        spp = max(2, round(args.seconds / each))
        stacks = [render_stack(scene, spp, seed, sampler, **wanted[sampler]) for seed in range(args.seeds)]
        row[sampler] = {"spp": spp, "milliseconds": round(1e3 * each, 3), "seeds": {}}
        for method in METHODS_IN_MEDIA[sampler] if foggy else METHODS[sampler]:
            made = [denoise(stack, method) for stack in stacks]
            shown[sampler, method] = made[0]
            errors = row[sampler]["seeds"][method] = [float(f"{relmse_trimmed(i, *halves):.4g}") for i in made]
            row[sampler][method] = statistics.median(errors)
    columns = [(samplers[foggy], method) for samplers, method in SHOWN]
    return row, [shown[which] for which in columns if which in shown] + [(halves[0] + halves[1]) / 2]


def costs_of(scene, samplers: dict[str, dict], rounds: int = 2) -> dict[str, tuple[float, float]]:
    """Of samplers with their options: seconds of a render of no samples, and of a sample.

    By the least of some rounds of a short render and of a long one: of their differences, the least would be chance.
    Samplers take turns. Those that refuse the scene are left out.
    """
    from data_gen.render import render_stack

    def cost(sampler: str, spp: int) -> float:
        start = time.process_time()
        render_stack(scene, spp, 1, sampler, **samplers[sampler])
        return time.process_time() - start

    def turns(sampler: str) -> tuple[int, int]:
        return (1, 3) if sampler in LONG else (3, 9) if sampler in IN_PASSES else (16, 64)

    counts = {sampler: turns(sampler) for sampler in samplers}
    least: dict[str, tuple[float, float]] = {}
    for turn in range(1 + rounds):
        for sampler, (few, many) in list(counts.items()):
            try:
                short = cost(sampler, few)
            except NgptError as refusal:
                print(refusal)
                del counts[sampler]
                continue
            # The first turn compiles the kernels.
            if turn:
                before = least.get(sampler, (np.inf, np.inf))
                least[sampler] = min(before[0], short), min(before[1], cost(sampler, many))
    found = {}
    for sampler, (short, long) in least.items():
        few, many = counts[sampler]
        each = max(long - short, 1e-3) / (many - few)
        found[sampler] = short - few * each, each
    return found


def table(result: dict) -> str:
    """Tables in Markdown: errors in media and on surfaces; and those of photons alone, in brackets with OIDN, over
    their twins'."""
    scenes = result["scenes"]
    lines = []
    for foggy, methods in ((True, METHODS_IN_MEDIA), (False, METHODS)):
        if rows := {name: row for name, row in scenes.items() if row["media"] == foggy}:
            lines += [*errors_of(rows, methods), ""]
    lines += [
        "| scene | photons | blurred in | passes | cost of a pass | `l1` | `wcv` |",
        "|---|---|--:|--:|--:|--:|--:|",
    ]
    for name, row in scenes.items():
        for sampler, (twin, dimensions) in TWINS.items():
            if sampler in row and twin in row:
                one, other = row[sampler], row[twin]
                gains = (f"{one['primal'] / other[m]:.2g} ({one['oidn'] / other[m]:.2g})" for m in ("l1", "wcv"))
                cost = other["milliseconds"] / one["milliseconds"]
                cells = (
                    f"`{sampler}`, `{twin}`",
                    f"{dimensions}D",
                    f"{one['spp']}, {other['spp']}",
                    f"{cost:.2g}",
                    *gains,
                )
                lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def errors_of(scenes: dict[str, dict], methods: dict[str, tuple]) -> list[str]:
    """The lines of a table of errors, a column for each scene: of several seeds the median, and in the last line the
    largest over the least, the median and the largest such ratio of all methods."""
    lines = ["| method | " + " | ".join(scenes) + " |", "|---|" + "--:|" * len(scenes)]
    found = [(s, m) for s, several in methods.items() for m in several]
    found = [(s, m) for s, m in found if any(m in row.get(s, {}) for row in scenes.values())]
    least = {name: min(row[s][m] for s, m in found if m in row.get(s, {})) for name, row in scenes.items()}
    for sampler, method in found:
        title = f"`{TITLES['primal'] if sampler == 'primal' else sampler}`"
        cells = []
        for name, row in scenes.items():
            error = row.get(sampler, {}).get(method)
            cells.append("" if error is None else f"**{error:.2g}**" if error == least[name] else f"{error:.2g}")
        lines.append(f"| {title}{'' if method == 'primal' else f' and {TITLES[method]}'} | {' | '.join(cells)} |")
    spreads = []
    for row in scenes.values():
        seeds = [row[s]["seeds"][m] for s, m in found if m in row.get(s, {}).get("seeds", {})]
        ratios = [max(errors) / min(errors) for errors in seeds if len(errors) > 1]
        spreads.append(f"{statistics.median(ratios):.2g}, {max(ratios):.2g}" if ratios else "")
    halves = (f"{row['error of half a reference']:.2g}, `{row['reference']}`" for row in scenes.values())
    setups = (f"{'x'.join(map(str, row['size']))}, {row['seconds']:g} s, {row['seeds']}" for row in scenes.values())
    lines.append(f"| most of the seeds over the least: median, worst | {' | '.join(spreads)} |")
    lines.append(f"| half a reference | {' | '.join(halves)} |")
    return [*lines, f"| size, time, seeds | {' | '.join(setups)} |"]


def picture(rows: list[list[np.ndarray]]) -> np.ndarray:
    headings: list[list[str]] = []
    for samplers, method in SHOWN:
        names = " or ".join(dict.fromkeys(TITLES["primal"] if s == "primal" else s for s in samplers))
        what = names if method == "primal" else f"{names} and {TITLES[method]}"
        headings.append([what])
    headings.append(["reference"])
    stops = [auto_exposure(images[-1]) for images in rows]
    tiles = []
    for column in range(len(headings)):
        shapes = [images[0].shape for images in rows]
        sizes = [(TILE, TILE * height // width) for height, width, _ in shapes]
        tiles.append(
            [
                panels.scaled(to_srgb8(images[column], stop), size)
                for images, stop, size in zip(rows, stops, sizes, strict=True)
            ]
        )
    return panels.columns(headings, tiles)


if __name__ == "__main__":
    main()
