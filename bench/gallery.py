"""Makes the pictures of docs/gallery.md: twelve scenes, each noisy, denoised and converged, side by side.

    python -m bench.gallery --folder SCENES --cache out/gallery
    python -m bench.gallery --wipe glossy --size 640 360 --cache out/gallery
    python -m bench.gallery --which --folder SCENES --cache out/gallery

SCENES is the folder of scene files. Each row of SCENES_SHOWN is rendered with the command on the page, and denoised by
the default method of `ngpt denoise`. References are rendered with whole paths, in two halves with other seeds. Renders
are kept in the cache. The program writes docs/images/gallery, bench/results/gallery.json, and the table between the
marks of the page. With --wipe it writes docs/images/wipe.webp: a line moves over the noisy image and uncovers the
result. With --which it writes docs/images/which-sampler.webp. This picture compares path tracing with the samplers of
WHICH. Each of its images was rendered for WHICH_SECONDS of processor time.
"""

import argparse
import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image, ImageDraw, ImageFont

import data_gen
import ngpt
from bench.common import kept, metadata, save, write_page
from bench.judging import RIVAL, timed
from ngpt.image.display import auto_exposure, to_srgb8
from ngpt.measure.metrics import relmse_trimmed
from ngpt.stack import GradientStack
from ngpt.system.files import atomic_output
from ngpt.system.writing import markdown_table

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "gallery.md"
RESULT = ROOT / "bench" / "results" / "gallery.json"
MARKS = ("<!-- python -m bench.gallery: rows -->", "<!-- rows ends -->")
REFERENCE_SEED = 1 << 20
PAPER, INK, GAP, HEADING = (255, 255, 255), (20, 20, 20), 8, 30  # colours, then pixels
HEADINGS = ("Noisy", "Denoised", "Reference")
WIPE_FRAMES, WIPE_MS, REST_MS = (
    24,
    60,
    1400,
)  # frames of one way; milliseconds of a frame, and at each end


class Shown(NamedTuple):
    """A row of the gallery: a scene, the options of its command, and the sampler and samples of its reference."""

    scene: str
    spp: int = 16
    sampler: str = "auto"
    reference: str = "primal"
    reference_spp: int = 256  # of each half


SCENES_SHOWN = (
    Shown("diffuse"),
    Shown("glossy"),
    Shown("environment"),
    Shown("lens"),
    Shown("living-room/scene.xml"),
    Shown("staircase/scene.xml"),
    Shown("haze", reference_spp=64),
    Shown("lamp/scene.xml"),
    Shown("veach-bidir/scene.xml", 64, "bdpt", "bdpt", 64),
    Shown("coffee/scene.xml"),
    Shown("bedroom/scene.xml"),
    Shown("bathroom/scene.xml", 4),
)

WHICH = {
    "living-room/scene.xml": "auto",
    "veach-bidir/scene.xml": "bdpt",
    "bench/scenes/mirror-caustic/scene.xml": "vcm",
    "haze": "auto",
}
WHICH_SECONDS = 20


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, default=Path(), help="folder of the scene files")
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME", help="only make these scenes again")
    parser.add_argument("--wipe", metavar="NAME", help="write only the moving picture of this scene")
    parser.add_argument("--which", action="store_true", help="write only which-sampler.webp")
    parser.add_argument("--size", type=int, nargs=2, default=(320, 180), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--cache", type=Path, required=True, help="folder for renders")
    args = parser.parse_args()
    if args.wipe:
        row = next(row for row in SCENES_SHOWN if name_of(row) == args.wipe)
        stack = rendered(args, row, row.sampler, row.spp, 0, unbiased=False)
        result = ngpt.denoise(stack)
        shown = [to_srgb8(image, auto_exposure(result)) for image in (stack["primal"], result)]
        write_wipe(ROOT / "docs" / "images" / "wipe.webp", *shown)
        return
    if args.which:
        write_which(args, ROOT / "docs" / "images" / "which-sampler.webp")
        return
    before = json.loads(RESULT.read_text()) if args.only else {"rows": {}}
    rows = {}
    for row in SCENES_SHOWN:
        name = name_of(row)
        if args.only and name not in args.only:
            rows[name] = before["rows"][name]
            continue
        shown, rows[name] = images(args, row)
        exposure = auto_exposure(shown[-1])
        tiles = dict(zip(HEADINGS, (to_srgb8(image, exposure) for image in shown), strict=True))
        written(ROOT / "docs" / "images" / "gallery" / f"{name}.webp", [beside(tiles)], quality=88)
    found = {"benchmark": "gallery", "size": list(args.size), "rows": rows}
    save(RESULT, found | {"metadata": metadata("mitsuba", "mitsuba-oidn")})
    write_page(PAGE, table(found), MARKS)


def name_of(row: Shown) -> str:
    return Path(row.scene).parent.name or row.scene


def options(row: Shown) -> str:
    return f"--spp {row.spp}" + ("" if row.sampler == "auto" else f" --sampler {row.sampler}")


def images(args: argparse.Namespace, row: Shown) -> tuple[list[np.ndarray], dict[str, Any]]:
    """[noisy image, result, reference], (H, W, 3) scene-linear, and the entries of the table's row."""
    stack = rendered(args, row, row.sampler, row.spp, 0, unbiased=False)
    ngpt.reconstruct(stack)  # a warm-up
    result, seconds = timed(lambda: ngpt.reconstruct(stack))
    rival = rendered(args, row, "primal", row.spp, 0, unbiased=True, **RIVAL)
    reference = (args, row, row.reference, row.reference_spp)
    halves = [rendered(*reference, REFERENCE_SEED + i, unbiased=True)["primal"] for i in (0, 1)]
    facts = {
        "options": options(row),
        "sampler": stack.attributes["ngpt:sampler"],
        "method": result.method,
        "CPU seconds": float(stack.attributes["gallery:seconds"]) + seconds,
        "noisy": relmse_trimmed(stack["primal"], *halves),
        "result": relmse_trimmed(result.image, *halves),
        "mitsuba": relmse_trimmed(ngpt.denoise(rival, "oidn"), *halves),
        "light": float(result.image.mean() / np.mean(halves)),
    }
    return [stack["primal"], result.image, np.mean(halves, axis=0)], facts


def rendered(
    args: argparse.Namespace, row: Shown, sampler: str, spp: int, seed: int, unbiased: bool, **options: str
) -> GradientStack:
    """A stack, from the cache if it is there. Its attribute gallery:seconds is processor time with compilation."""
    made_by = "-".join([sampler, *options.values()])
    file = args.cache / f"{name_of(row)}-{made_by}-{spp}-{seed}-{args.size[0]}x{args.size[1]}.exr"

    def make() -> GradientStack:
        scene, how = scene_of(args, row.scene), {"size": tuple(args.size), "unbiased": unbiased}
        made, seconds = timed(lambda: data_gen.render_scene(scene, spp, seed, sampler, **how, **options))
        made.stack.attributes["gallery:seconds"] = seconds
        return made.stack

    return kept(file, make)


def scene_of(args: argparse.Namespace, name: str) -> Path | str:
    """Returns the scene file in --folder. If there is none, ``name`` is a built-in scene or a path."""
    file = args.folder / name
    return file if file.exists() else name


def table(found: dict[str, Any]) -> str:
    heads = ["scene", "options", "sampler, method", "seconds", "error, noisy", "result", "Mitsuba + OIDN", "light"]
    rows = []
    for name, row in found["rows"].items():
        how = [f"`{row['sampler']}`, `{row['method']}`", f"{row['CPU seconds']:.0f}"]
        errors = [f"{row[key]:.4f}" for key in ("noisy", "result", "mitsuba")]
        rows.append([f"[{name}](#{name})", f"`{row['options']}`", *how, *errors, f"{row['light']:.2f}"])
    return "\n".join(markdown_table(heads, rows, 3))


def write_wipe(path: Path, before: np.ndarray, after: np.ndarray) -> None:
    """Writes an animated WebP of (H, W, 3) uint8 images: a white line uncovers ``after`` and then goes back."""
    height, width = before.shape[:2]
    places = [round(width * (1 - np.cos(np.pi * i / WIPE_FRAMES)) / 2) for i in range(WIPE_FRAMES + 1)]
    frames = []
    for x in [*places, *places[-2:0:-1]]:
        frame = Image.fromarray(np.concatenate([after[:, :x], before[:, x:]], axis=1))
        draw = ImageDraw.Draw(frame)
        draw.rectangle((x - 1, 0, x, height), fill=PAPER)
        font, edge = ImageFont.load_default(15), {"stroke_width": 2, "stroke_fill": INK}
        for text, place, shown in (("denoised", 6, x > width / 4), ("noisy", width - 52, x < width * 3 / 4)):
            if shown:
                draw.text((place, height - 22), text, PAPER, font, **edge)
        frames.append(frame)
    waits = [REST_MS if i in (0, WIPE_FRAMES) else WIPE_MS for i in range(len(frames))]
    written(path, frames, duration=waits, loop=0, quality=70)


def write_which(args: argparse.Namespace, path: Path) -> None:
    """Writes a picture with one row for each scene of WHICH.

    A row shows Mitsuba's path tracing, the same image denoised by OIDN, and the result of the sampler.
    """
    rows = []
    for name, sampler in WHICH.items():
        scene, how = scene_of(args, name), {"cpu_seconds": WHICH_SECONDS, "size": tuple(args.size)}
        paths, _ = data_gen.render_scene(scene, sampler="primal", unbiased=True, **how, **RIVAL)
        stack, _ = data_gen.render_scene(scene, sampler=sampler, **how)
        result = ngpt.reconstruct(stack)
        shown = paths["primal"], ngpt.denoise(paths, "oidn"), result.image
        heads = ("Path tracing", "Path tracing, OIDN", f"{stack.attributes['ngpt:sampler']}, {result.method}")
        exposure = auto_exposure(result.image)
        rows.append(beside({head: to_srgb8(image, exposure) for head, image in zip(heads, shown, strict=True)}))
    written(path, [Image.fromarray(np.vstack(rows))], quality=88)


def beside(tiles: dict[str, np.ndarray]) -> Image.Image:
    """One picture of (H, W, 3) uint8 images of the same size, side by side, each below its heading."""
    height, width = next(iter(tiles.values())).shape[:2]
    canvas = Image.new("RGB", (len(tiles) * (width + GAP) - GAP, HEADING + height), PAPER)
    for i, (text, tile) in enumerate(tiles.items()):
        ImageDraw.Draw(canvas).text((i * (width + GAP), 0), text, INK, ImageFont.load_default(19))
        canvas.paste(Image.fromarray(tile), (i * (width + GAP), HEADING))
    return canvas


def written(path: Path, frames: list[Image.Image], **options: Any) -> None:
    """Writes one picture, or an animation of several frames, as WebP."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_output(path, overwrite=True) as temporary:
        frames[0].save(temporary, "WEBP", save_all=len(frames) > 1, append_images=frames[1:], **options)
    print(f"{path}: {frames[0].width}x{frames[0].height}, {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
