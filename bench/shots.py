"""Frames of a moving camera: error and flicker of results made frame by frame, and over time.

    python -m bench.shots --folder SCENES --scenes diffuse glossy coffee --out OUT
    python -m bench.shots --folder SCENES --scenes diffuse glossy --shots slow fast object light --pairs 2 --out OUT

Three shots move a scene's own camera sideways: ``static``, ``slow`` (half a pixel per frame, at the median distance of
visible surfaces) and ``fast`` (8 pixels per frame, to and fro). ``object`` and ``light`` move a shape, see ``MOVES``.
relMSE is without the worst 0.1 % of the pixels, flicker is ``ngpt.measure.flicker``; both are means over all frames but
the first, minus the contribution of the references' noise. ``+ temporal`` is `ngpt denoise --temporal`, ``+ rules`` the
same without its network. With ``--plain``, methods that read no gradients get stacks without gradients, of this number
of samples. With ``--pairs``, there is one more row, ``wcv + dt``, at ``--spp``. Since pairs take time, all other rows
then use stacks without differences in time, at ``--spp-without``.
"""

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np

import ngpt
from bench.common import metadata, renderer, save
from ngpt.io.frames import shot_files
from ngpt.measure.flicker import flicker
from ngpt.measure.metrics import relmse_trimmed
from ngpt.methods import METHODS
from ngpt.sequence.history import Temporal
from ngpt.sequence.network import shipped
from ngpt.sequence.wcv_windows import reconstruct_shot

# Scene and shot -> the parameter that moves, and by how much a frame. "lamp": the first shape that shines.
MOVES = {
    ("diffuse", "object"): ("ball", (0.03, 0, 0)),
    ("glossy", "object"): ("gold", (-0.03, 0, 0)),
    ("cornell-box", "object"): ("ShortBox", (-0.02, 0, 0.01)),
    ("veach-mis", "object"): ("Glossy", (0, 0.05, 0)),
    ("diffuse", "light"): ("lamp", (0.04, 0, 0)),
    ("glossy", "light"): ("lamp", (-0.04, 0, 0)),
    ("cornell-box", "light"): ("Light", (0.03, 0, 0)),
    ("coffee", "light"): ("lamp", (0.03, 0, 0)),
    ("veach-mis", "light"): ("Null_0002", (0, 0, 0.1)),
}
SPEEDS = {"static": 0.0, "slow": 0.5, "fast": 8.0}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, help="folder of scenes: NAME/scene.xml")
    parser.add_argument("--scenes", nargs="*", default=["diffuse", "glossy"])
    parser.add_argument("--shots", nargs="*", default=list(SPEEDS), choices=[*SPEEDS, "object", "light"])
    parser.add_argument("--methods", nargs="*", default=["wcv", "ngpt-fast", "oidn"], choices=METHODS)
    parser.add_argument("--frames", type=int, default=10)
    parser.add_argument("--size", default="96x54")
    parser.add_argument("--spp", type=int, default=8)
    parser.add_argument("--pairs", type=int, default=0, help="of differences in time (default: 0, none)")
    parser.add_argument("--spp-without", type=int, default=12, help="of stacks without them (default: 12)")
    parser.add_argument("--plain", type=int, default=0, help="samples of stacks without gradients (default: none)")
    parser.add_argument("--reference-spp", type=int, default=512)
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    rows = []
    for scene in args.scenes:
        for shot in args.shots:
            folder = args.out / scene / shot
            if shot not in SPEEDS and (scene, shot) not in MOVES:
                continue
            kinds = render_stacks(args, scene, shot, folder)
            stacks, paired, references, plain = (
                [ngpt.read(f) for f in shot_files(str(folder / kind))] if kind else [] for kind in kinds
            )
            found = []
            for method in args.methods:
                apart = bool(args.plain) and not {"dx", "dx_var"} & {*METHODS[method].needs, *METHODS[method].estimates}
                found += judge(plain if apart else stacks, references, method)
            if args.pairs:
                images = [result.image for _, _, result in reconstruct_shot(paired)]
                found += measured(paired, references, {"wcv + dt": images})
            for row in found:
                rows.append({"scene": scene, "shot": shot} | row)
                print(line(rows[-1]), flush=True)
    save(args.out / "shots.json", {"rows": rows, "metadata": metadata("mitsuba-oidn")})


def judge(stacks: list, references: list, method: str) -> list[dict]:
    """Rows of a method, frame by frame and over time."""
    results = [ngpt.reconstruct(stack, method) for stack in stacks]
    images = {method: [result.image for result in results]}
    for name, corrections in (("rules", None), ("temporal", shipped())):
        temporal, begun = Temporal(corrections), time.perf_counter()
        images[f"{method} + {name}"] = [temporal.next(s, r.image) for s, r in zip(stacks, results, strict=True)]
        print(f"{method} + {name}: {(time.perf_counter() - begun) / len(stacks):.3f} s a frame")
    return measured(stacks, references, images)


def measured(stacks: list, references: list, images: dict[str, list[np.ndarray]]) -> list[dict]:
    """A row for each list of images; ``references`` are stacks, a single one for a static shot."""
    truth = [reference["primal"] for reference in references]
    rng = np.random.default_rng(0)
    noise = [np.sqrt(reference["primal_var"]) * rng.standard_normal(truth[0].shape) for reference in references]
    truth, noise = ([*images] * (len(stacks) // len(images)) for images in (truth, noise))
    motions = [stack["motion"] for stack in stacks]

    def errors_of(found: list[np.ndarray]) -> tuple[float, float]:
        errors = [relmse_trimmed(image, reference) for image, reference in zip(found[1:], truth[1:], strict=True)]
        return float(np.mean(errors)), flicker(found, truth, motions)

    floor = errors_of([reference + own for reference, own in zip(truth, noise, strict=True)])
    rows = []
    for name, found in images.items():
        error, change = errors_of(found)
        bias = float(
            np.mean([image.mean() / reference.mean() - 1 for image, reference in zip(found, truth, strict=True)])
        )
        rows.append(
            {"method": name, "relMSE": error - floor[0], "flicker": change - floor[1], "floor": floor, "bias": bias}
        )
    return rows


def line(row: dict) -> str:
    return f"| {row['scene']} | {row['shot']} | {row['method']} | {row['relMSE']:.5f} | {row['flicker']:.5f} |"


def render_stacks(args: argparse.Namespace, scene: str, shot: str, folder: Path) -> tuple[str, str, str, str]:
    """Renders stacks, stacks with pairs (without ``--pairs``: the same), references, and with ``--plain`` stacks
    without gradients; returns the folder names, "" for none. Existing files are kept.
    """
    renderer()
    from data_gen.session import render_frames

    rests = SPEEDS.get(shot) == 0
    stacks: dict = {"in": {"spp": args.spp, "seed": 1, "sampler": "gpt", "dt": args.pairs}}
    if args.pairs:
        stacks["without"] = {"spp": args.spp_without, "seed": 3, "sampler": "gpt"}
    if args.plain:
        stacks["plain"] = {"spp": args.plain, "seed": 4, "sampler": "primal"}
    reference = {
        "spp": args.reference_spp * (4 if rests else 1),
        "seed": 2,
        "sampler": "primal",
        "features": False,
    }
    for kind, options in (stacks | {"ref": reference}).items():
        (folder / kind).mkdir(parents=True, exist_ok=True)
        # A shot at rest has one reference.
        frames = range(1 if rests and kind == "ref" else args.frames)
        target = {frame: folder / kind / f"{frame:04d}.exr" for frame in frames}
        missing = [frame for frame, file in target.items() if not file.exists()]
        moving = shot_of(args.folder, scene, shot, args.size)
        how = {"skip": lambda f, m=missing: f not in m, "unbiased": True, "subpixels": 1} | options
        for frame, stack in render_frames(moving, frames, **how):
            ngpt.write(target[frame], stack)
    return ("without" if args.pairs else "in"), "in", "ref", "plain" if args.plain else ""


def shot_of(folder: Path | None, scene: str, shot: str, size: str) -> Any:
    """A scene, from the folder or built in, with the motion of that shot."""
    from data_gen.frames.shot import Shot

    pixels = tuple(map(int, size.split("x")))
    name = str(folder / scene / "scene.xml") if folder and (folder / scene).is_dir() else scene
    if shot not in SPEEDS:
        return Shot(lambda frame: (name, {}), pixels, update=mover(*MOVES[scene, shot]))
    path = sideways(Shot(lambda frame: (name, {}), pixels).at(0), SPEEDS[shot])
    return Shot(lambda frame: (name, {}), pixels, path)


def mover(shape: str, way: tuple[float, float, float]):
    """A function that moves a shape by ``way`` in each frame: see ``data_gen.frames.shot.Shot``."""
    import mitsuba as mi

    from data_gen.scenes.geometry import put_vertices, vertices, vertices_name

    start: dict = {}

    def update(params, frame: int) -> None:
        names = list(params.keys())
        who = shape
        if shape == "lamp" and "lamp.to_world" not in names:
            who = next(name for name in names if name.endswith(".emitter.radiance.value")).split(".")[0]
        far = [frame * step for step in way]
        if f"{who}.to_world" in names:
            before = start.setdefault(who, mi.Transform4f(params[f"{who}.to_world"]))
            params[f"{who}.to_world"] = mi.Transform4f(mi.ScalarTransform4f().translate(far)) @ before
        else:
            name = vertices_name(params, who)
            put_vertices(params, name, start.setdefault(who, vertices(params, name)) + far)

    return update


def sideways(scene, speed: float):
    """A path of the camera to its right, ``speed`` pixels a frame at the median distance; if fast, to and fro."""
    from data_gen.frames.camera_path import CameraPath, Key
    from data_gen.frames.motion import seen, snapshot

    film = snapshot(scene).film
    what = seen(scene)
    hits = what.points[what.shape >= 0]
    pixels_per_unit = np.linalg.norm(film[0, :3]) / np.median(hits @ film[3])
    sensor = scene.sensors()[0]
    start = np.array(sensor.world_transform().matrix, np.float64).reshape(4, 4, -1)[..., 0]
    left = start[:3, 0] / np.linalg.norm(start[:3, 0])

    def key(frame: int, pixels: float) -> Key:
        matrix = start.copy()
        matrix[:3, 3] -= left * pixels / pixels_per_unit
        return Key(frame, matrix)

    if speed < 4:
        return CameraPath([key(-1, 0), key(999, 1000 * speed)])
    # To and fro, so that the camera stays in the room.
    return CameraPath([key(frame, speed * (2 if frame % 8 == 2 else -2)) for frame in range(-2, 200, 4)])


if __name__ == "__main__":
    main()
