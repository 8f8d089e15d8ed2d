"""Samplers at equal time, each with the methods that suit it: `gmlt` and `gpt-tiles` beside others.

    python -m bench.metropolis --scenes ajar keyhole lantern diffuse --seconds 20

For each scene, seed and sampler, an image is rendered in --seconds of processor time, kernels compiled. Errors are
trimmed relMSE without the noise of a reference, two halves by --reference with --reference-spp samples each, medians
over seeds. Scenes are built-in ones, files, and these, which are made here:

    ajar       a room that is lit through a door, 5 cm open, from a lamp that it does not see
    keyhole    the same, 1 cm, and the lamp five times as bright
    lantern    the same, 20 cm, and the lamp is in a ball of clear glass, which no connection goes through
    bulb       a room whose only lamp is in a ball of clear glass
    cove       a matte room whose lamp shines at the ceiling

--table prints the table of the file.
"""

import argparse
import json
import statistics
import time
from pathlib import Path

import numpy as np

import ngpt
from bench.common import metadata, save
from bench.photons import costs_of
from ngpt.evaluation.config import scene_name
from ngpt.io.exr import read_image
from ngpt.measure.metrics import relmse_trimmed
from ngpt.methods import METHODS, reconstruct

# Sampler -> its methods
COLUMNS = {
    "gmlt": ("primal", "l1", "wcv", "oidn", "ngpt-fast", "ngpt-combine"),
    "gpt": ("primal", "l1", "wcv", "ngpt-fast", "ngpt-combine"),
    "gpt-tiles": ("primal", "l1", "wcv", "oidn", "ngpt-combine"),
    "primal": ("primal", "oidn", "ngpt-primal"),
    "gbdpt": ("primal", "l1", "wcv", "ngpt-fast", "ngpt-combine"),
    "bdpt": ("oidn",),
    "gpm": ("primal", "l1", "wcv"),
}
_REFERENCE_SEED = 1 << 20


def ajar(width: float = 0.05, glass: bool = False, light: float = 1) -> dict:
    """A room, and another behind its right wall whose lamp shines away from the door, open by ``width`` metres.

    With ``glass`` the lamp is a small ball in a larger one of glass. ``light`` is by how much it is brighter.
    """
    from data_gen.scenes.builtin import _box, _diffuse, _light, _path, _room, _sphere, _wall, diffuse

    scene = diffuse()
    for name in ("lamp", "right"):
        del scene[name]
    white = _diffuse(0.75, 0.73, 0.7)
    scene |= _room(4.5, scene["floor"]["bsdf"]) | {"integrator": _path(8)}
    del scene["right"]
    # The right wall has a slit from the floor to 2 m, at 0.5 m from the back wall.
    for name, (low, high, back, front) in {
        "behind": (0, 2, -1.5, -1.0),
        "before": (0, 2, -1.0 + width, 4.5),
        "over": (2, 2.4, -1.5, 4.5),
    }.items():
        scene[f"right_{name}"] = _box(
            [1.55, (low + high) / 2, (back + front) / 2], [0.1, high - low, front - back], 0, white
        )
    for name, center, normal, size in (
        ("floor", (3.1, 0, 1.5), (0, 1, 0), (3, 6)),
        ("ceiling", (3.1, 2.4, 1.5), (0, -1, 0), (3, 6)),
        ("far", (4.6, 1.2, 1.5), (-1, 0, 0), (6, 2.4)),
        ("back", (3.1, 1.2, -1.5), (0, 0, 1), (3, 2.4)),
        ("front", (3.1, 1.2, 4.5), (0, 0, -1), (3, 2.4)),
    ):
        scene[f"other_{name}"] = _wall(list(center), list(normal), size, white)
    scene["front"] = _wall([0, 1.2, 4.5], [0, 0, -1], (3, 2.4), white)
    scene["ball2"] = _sphere([-0.7, 0.25, 0.7], 0.25, _diffuse(0.3, 0.42, 0.6))
    if glass:
        scene |= _bulb([3.1, 1.3, 0.2], 0.1, (1600, 1400, 1200))
    else:
        scene["lamp"] = _light([1.7, 1.2, -0.4], [1, 0, 0], (0.8, 1.2), (400 * light, 360 * light, 300 * light))
    return scene


def bulb() -> dict:
    """The room of `diffuse`, whose lamp is a small ball in one of glass."""
    from data_gen.scenes.builtin import _path, diffuse

    scene = diffuse() | {"integrator": _path(8)}
    del scene["lamp"]
    return scene | _bulb([0, 1.9, -0.2], 0.05, (1600, 1400, 1200))


def cove() -> dict:
    """The room of `diffuse`, whose lamp is turned around: all light that the camera sees has met the ceiling."""
    from data_gen.scenes.builtin import _light, diffuse

    return diffuse() | {"lamp": _light([0, 1.9, -0.2], [0, 1, 0], (0.8, 0.6), (60, 52, 40))}


def _bulb(center: list[float], radius: float, radiance: tuple[float, float, float]) -> dict:
    from data_gen.scenes.builtin import _rgb, _sphere

    inner = {"type": "sphere", "center": center, "radius": radius, "bsdf": {"type": "diffuse"}}
    inner["emitter"] = {"type": "area", "radiance": _rgb(*radiance)}
    return {"lamp": inner, "bulb": _sphere(center, 3 * radius, {"type": "dielectric", "int_ior": 1.5})}


MADE = {
    "ajar": ajar,
    "keyhole": lambda: ajar(0.01, light=5),
    "lantern": lambda: ajar(0.2, True),
    "bulb": bulb,
    "cove": cove,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=[])
    parser.add_argument("--size", type=int, nargs=2, default=(64, 48), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--seconds", type=float, default=8.0, help="processor time of a render")
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--samplers", nargs="+", default=list(COLUMNS))
    parser.add_argument("--reference", default="gbdpt", help="sampler of the reference (default %(default)s)")
    parser.add_argument("--reference-spp", type=int, default=4096, help="of each half")
    parser.add_argument("--cache", type=Path, default=Path("out/metropolis"), help="folder of references, of one size")
    parser.add_argument("--table", action="store_true", help="print the table of the file, and measure nothing")
    parser.add_argument("-o", "--output", type=Path, default=Path("bench/results/metropolis.json"))
    args = parser.parse_args()
    if args.table:
        print(table(json.loads(args.output.read_text())["scenes"]))
        return

    from data_gen.backend import use_variant

    use_variant()
    result: dict = {"benchmark": "metropolis", "size": list(args.size), "seeds": args.seeds, "scenes": {}}
    if args.output.exists():
        result["scenes"] = json.loads(args.output.read_text())["scenes"]
    for name in args.scenes:
        row = result["scenes"].setdefault(scene_name(name), {})
        row |= bench_scene(name, args)
        save(args.output, result | {"metadata": metadata("mitsuba", "onnxruntime", "mitsuba-oidn")})
        print(name, json.dumps(row), flush=True)


def bench_scene(name: str, args: argparse.Namespace) -> dict:
    """Sampler -> samples, seconds, and the errors by method."""
    from data_gen.render import render_stack

    scene = load(name, tuple(args.size))
    halves = [reference(scene, name, half, args) for half in range(2)]
    rows: dict = {"seconds": args.seconds, "error of half a reference": relmse_trimmed(halves[0], halves[1])}
    for sampler, (start, each) in costs_of(scene, {sampler: {} for sampler in args.samplers}).items():
        spp = max(2, round((args.seconds - start) / each))
        errors: dict[str, list[float]] = {}
        spent, light = [], []
        for seed in range(1, args.seeds + 1):
            start = time.process_time()
            stack = render_stack(scene, spp, seed, sampler)
            spent.append(time.process_time() - start)
            light.append(float(stack["primal"].mean() / (halves[0] + halves[1]).mean() * 2))
            for method in COLUMNS[sampler]:
                if not METHODS[method].missing():
                    errors.setdefault(method, []).append(relmse_trimmed(reconstruct(stack, method).image, *halves))
        rows[sampler] = {"spp": spp, "seconds": statistics.median(spent), "light": light}
        rows[sampler] |= {method: float(f"{statistics.median(found):.4g}") for method, found in errors.items()}
        print(name, sampler, rows[sampler], flush=True)
    return rows


def reference(scene, name: str, half: int, args: argparse.Namespace) -> np.ndarray:
    """One of two independent images, (H, W, 3), from the cache if it is there."""
    from data_gen.render import render_stack

    path = args.cache / f"{scene_name(name)}-{'ab'[half]}.exr"
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        ngpt.write(path, render_stack(scene, args.reference_spp, _REFERENCE_SEED + half, args.reference))
    return read_image(path)


def load(name: str, size: tuple[int, int]):
    """A scene of ``MADE``, a built-in one, or a file."""
    import mitsuba as mi

    from data_gen.scenes.load import load_scene, set_film_size

    if name not in MADE:
        return load_scene(name, size)
    scene = mi.load_dict(MADE[name]())
    set_film_size(scene, size)
    return scene


def table(scenes: dict) -> str:
    """Markdown: errors over the least of the scene, and at the end what that is."""
    lines = ["| sampler, method | " + " | ".join(scenes) + " |", "|---|" + "--:|" * len(scenes)]
    least = {
        name: min(row[s][m] for s in COLUMNS if s in row for m in COLUMNS[s] if m in row[s])
        for name, row in scenes.items()
    }
    for sampler, methods in COLUMNS.items():
        for method in methods:
            found = [row.get(sampler, {}).get(method) for row in scenes.values()]
            ratios = [None if e is None else e / best for e, best in zip(found, least.values(), strict=True)]
            cells = ["" if r is None else "**1**" if r == 1 else f"{r:.2f}" for r in ratios]
            lines.append(f"| `{sampler}`, `{method}` | " + " | ".join(cells) + " |")
    return "\n".join([*lines, "| least error | " + " | ".join(f"{e:.3g}" for e in least.values()) + " |"])


if __name__ == "__main__":
    main()
