"""Error of every reconstruction method by scene and samples per pixel: the table and pictures of
docs/methods/classical.md.

    python -m bench.methods --scenes diffuse glossy environment lens SCENE.xml ... --cache /tmp/stacks

Renders a stack for each sample count and a reference for each scene (kept in the cache folder, and taken from there the
next time), runs every method, and writes bench/results/methods.json, docs/lab/classical-table.md and, with --pictures
docs/images, a picture for each method of the place where it does worst compared with the others, METHOD-fails.png.
"""

import argparse
from pathlib import Path

import numpy as np

import ngpt
from bench.common import metadata, save
from ngpt.evaluation.config import scene_name
from ngpt.evaluation.references import reference_noise
from ngpt.measure.metrics import compare, relative_squared_error
from ngpt.methods import METHODS, reconstruct
from ngpt.report.display import auto_exposure, to_srgb8
from ngpt.report.png import encode_png
from ngpt.stack import GradientStack
from ngpt.system.files import atomic_output
from ngpt.system.writing import write_text

METRIC = "relMSE trimmed"
CROP = 48  # pixels, shown four times as large


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", required=True, help="built-in scenes and Mitsuba scene files")
    parser.add_argument("--spp", nargs="+", type=int, default=[4, 16, 64])
    parser.add_argument("--reference-spp", type=int, default=2048)
    parser.add_argument("--size", type=int, nargs=2, default=(320, 180), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--cache", type=Path, required=True, help="folder for the rendered stacks and references")
    parser.add_argument("--table", type=Path, default=Path("docs/lab/classical-table.md"))
    parser.add_argument("--pictures", type=Path, help="folder for the places where each method does worst")
    parser.add_argument("-o", "--output", default="bench/results/methods.json")
    args = parser.parse_args()

    from data_gen.backend import use_variant

    use_variant()
    args.cache.mkdir(parents=True, exist_ok=True)
    names = {scene: scene_name(scene) for scene in args.scenes}
    references = {names[s]: cached(s, args.reference_spp, "primal", 1, args) for s in args.scenes}
    stacks = {(names[s], spp): cached(s, spp, "auto", 0, args) for s in args.scenes for spp in args.spp}
    images, cells = {}, {}
    for (name, spp), stack in stacks.items():
        for method, entry in METHODS.items():
            if not entry.missing() and all(layer in stack for layer in entry.needs):
                result = reconstruct(stack, method)
                images[name, spp, method] = result.image
                reference = references[name]["primal"]
                energy = float(result.image.mean(dtype=np.float64) / reference.mean(dtype=np.float64))
                cells[name, spp, method] = compare(result.image, reference) | {"energy": energy}
        print(name, spp, {m: round(cells[name, spp, m][METRIC], 5) for m in METHODS if (name, spp, m) in cells})
    noise = {name: reference_noise(reference) for name, reference in references.items()}
    rows = [{"scene": n, "spp": s, "method": m, "metrics": c} for (n, s, m), c in cells.items()]
    setup = {"size": args.size, "reference spp": args.reference_spp, "reference noise": noise}
    save(args.output, {"benchmark": "methods", **setup, "rows": rows, "metadata": metadata("mitsuba")})
    write_text(args.table, table(cells, noise) + "\n" + energy_table(cells))
    for method in METHODS if args.pictures else ():
        if any(key[2] == method for key in cells) and method != "primal":
            write_picture(args.pictures / f"{method}-fails.png", method, cells, images, references)


def cached(scene: str, spp: int, sampler: str, seed: int, args: argparse.Namespace) -> GradientStack:
    """A rendered stack, from the cache if it is there."""
    from data_gen.render import render_stack
    from data_gen.scenes.load import load_scene

    width, height = args.size
    path = args.cache / f"{scene_name(scene)}-{sampler}-{spp}-{width}x{height}.exr"
    if not path.exists():
        print(f"rendering {path.name}", flush=True)
        ngpt.write(path, render_stack(load_scene(scene, (width, height)), spp, seed, sampler))
    return ngpt.read(path)


def table(cells: dict, noise: dict) -> str:
    """Markdown: a row for each scene and sample count, the best method bold, and geometric means below."""
    methods = [method for method in METHODS if any(key[2] == method for key in cells)]
    lines = ["| scene | spp | " + " | ".join(f"`{m}`" for m in methods) + " | reference noise |"]
    lines.append("|---|--:|" + "--:|" * (len(methods) + 1))
    counts = sorted({spp for _, spp, _ in cells})
    for name in noise:
        for spp in counts:
            values = {m: cells[name, spp, m][METRIC] for m in methods if (name, spp, m) in cells}
            best = min(values.values())
            texts = [f"**{v:.4f}**" if v == best else f"{v:.4f}" for v in values.values()]
            lines.append(f"| {name} | {spp} | " + " | ".join(texts) + f" | {noise[name]:.5f} |")
    for spp in counts:
        means = [np.exp(np.mean([np.log(cells[name, spp, m][METRIC]) for name in noise])) for m in methods]
        texts = [f"**{v:.4f}**" if v == min(means) else f"{v:.4f}" for v in means]
        lines.append(f"| *geometric mean* | {spp} | " + " | ".join(texts) + " | |")
    return "\n".join(lines) + "\n"


def energy_table(cells: dict) -> str:
    """Markdown: how much of the reference's energy a method keeps, median and lowest of the scenes."""
    methods = [method for method in METHODS if any(key[2] == method for key in cells)]
    lines = ["| energy kept, median (lowest) | " + " | ".join(f"`{m}`" for m in methods) + " |"]
    lines.append("|---|" + "--:|" * len(methods))
    for spp in sorted({spp for _, spp, _ in cells}):
        kept = [[c["energy"] for (_, s, m), c in cells.items() if (s, m) == (spp, method)] for method in methods]
        lines.append(f"| {spp} spp | " + " | ".join(f"{np.median(k):.3f} ({min(k):.3f})" for k in kept) + " |")
    return "\n".join(lines) + "\n"


def write_picture(path: Path, method: str, cells: dict, images: dict, references: dict) -> None:
    """The place where ``method`` does worst beside the best other: method, best other, reference, side by side."""

    def disadvantage(key):
        name, spp, _ = key
        others = [c[METRIC] for k, c in cells.items() if k[:2] == (name, spp) and k[2] not in (method, "primal")]
        return cells[key][METRIC] / min(others)

    name, spp, _ = max((key for key in cells if key[2] == method), key=disadvantage)
    rivals = [m for n, s, m in cells if (n, s) == (name, spp) and m not in (method, "primal")]
    rival = min(rivals, key=lambda m: cells[name, spp, m][METRIC])
    reference = references[name]["primal"]
    errors = [relative_squared_error(images[name, spp, m], reference).mean(axis=-1) for m in (method, rival)]
    # Capped, so that a place with many bad pixels wins over a single firefly.
    excess = np.minimum(errors[0], 1) - np.minimum(errors[1], 1)
    sums = np.cumsum(np.cumsum(np.pad(excess, ((1, 0), (1, 0))), axis=0), axis=1)
    windows = sums[CROP:, CROP:] - sums[:-CROP, CROP:] - sums[CROP:, :-CROP] + sums[:-CROP, :-CROP]
    y, x = np.unravel_index(np.argmax(windows), windows.shape)
    crops = [i[y : y + CROP, x : x + CROP] for i in (images[name, spp, method], images[name, spp, rival], reference)]
    exposure = auto_exposure(crops[-1])
    tiles = [np.kron(to_srgb8(crop, exposure), np.ones((4, 4, 1), np.uint8)) for crop in crops]
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_output(path, overwrite=True) as temporary:
        temporary.write_bytes(encode_png(np.ascontiguousarray(np.concatenate(tiles, axis=1))))
    print(f"{path}: {name}, {spp} spp, {method} | {rival} | reference, at ({x}, {y})")


if __name__ == "__main__":
    main()
