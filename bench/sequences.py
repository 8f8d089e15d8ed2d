"""Frames of a moving camera: error and flicker of results made frame by frame, and over time.

    python -m bench.sequences --folder SCENES --scenes diffuse glossy coffee --out OUT

Each shot moves a scene's own camera sideways: ``static``, ``slow`` (half a pixel a frame, at the distance of what it
sees in the median) and ``fast`` (8 pixels a frame, to and fro). Stacks and references are rendered once and kept in
OUT. relMSE is without the worst 0.1 % of the pixels, flicker is ``ngpt.measure.flicker``; both are means over all
frames but the first. What the references' own noise adds to both, by their variances, is taken off. ``+ temporal`` is
`ngpt denoise --temporal`.
"""

import argparse
from pathlib import Path

import numpy as np

import ngpt
from bench.common import metadata, save
from ngpt.measure.flicker import flicker
from ngpt.measure.metrics import relmse_trimmed
from ngpt.methods import METHODS
from ngpt.temporal import Temporal

SPEEDS = {"static": 0.0, "slow": 0.5, "fast": 8.0}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, help="folder of scenes: NAME/scene.xml")
    parser.add_argument("--scenes", nargs="*", default=["diffuse", "glossy"])
    parser.add_argument("--shots", nargs="*", default=list(SPEEDS), choices=SPEEDS)
    parser.add_argument("--methods", nargs="*", default=["wcv", "ngpt-fast", "oidn"], choices=METHODS)
    parser.add_argument("--frames", type=int, default=10)
    parser.add_argument("--size", default="96x54")
    parser.add_argument("--spp", type=int, default=8)
    parser.add_argument("--reference-spp", type=int, default=512)
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    rows = []
    for scene in args.scenes:
        for shot in args.shots:
            folder = args.out / scene / shot
            render_shot(args, scene, SPEEDS[shot], folder)
            stacks, references = ([ngpt.read(f) for f in sorted((folder / k).glob("*.exr"))] for k in ("in", "ref"))
            for method in args.methods:
                for row in judge(stacks, references, method):
                    rows.append({"scene": scene, "shot": shot} | row)
                    print(line(rows[-1]), flush=True)
    save(args.out / "sequences.json", {"rows": rows, "metadata": metadata("mitsuba-oidn")})


def judge(stacks: list, references: list, method: str) -> list[dict]:
    """Rows of a method, frame by frame and over time; ``references`` are stacks, one alone for a shot at rest."""
    truth = [reference["primal"] for reference in references]
    rng = np.random.default_rng(0)
    noise = [np.sqrt(reference["primal_var"]) * rng.standard_normal(truth[0].shape) for reference in references]
    truth, noise = ([*images] * (len(stacks) // len(images)) for images in (truth, noise))
    results = [ngpt.reconstruct(stack, method) for stack in stacks]
    temporal = Temporal()
    images = {
        method: [result.image for result in results],
        f"{method} + temporal": [temporal.next(s, r.image) for s, r in zip(stacks, results, strict=True)],
    }
    motions = [stack["motion"] for stack in stacks]

    def measured(found: list[np.ndarray]) -> tuple[float, float]:
        errors = [relmse_trimmed(image, reference) for image, reference in zip(found[1:], truth[1:], strict=True)]
        return float(np.mean(errors)), flicker(found, truth, motions)

    floor = measured([reference + own for reference, own in zip(truth, noise, strict=True)])
    rows = []
    for name, found in images.items():
        error, change = measured(found)
        rows.append({"method": name, "relMSE": error - floor[0], "flicker": change - floor[1], "floor": floor})
    return rows


def line(row: dict) -> str:
    return f"| {row['scene']} | {row['shot']} | {row['method']} | {row['relMSE']:.5f} | {row['flicker']:.5f} |"


def render_shot(args: argparse.Namespace, scene: str, speed: float, folder: Path) -> None:
    """Stacks in ``folder/in``, references in ``folder/ref``; what is there already is kept."""
    from data_gen.backend import DEFAULT_VARIANT, use_variant

    use_variant(DEFAULT_VARIANT)
    from data_gen.frames.sequence import Shot, render_sequence

    size = tuple(map(int, args.size.split("x")))
    name = str(args.folder / scene / "scene.xml") if args.folder and (args.folder / scene).is_dir() else scene
    path = sideways(Shot(lambda frame: (name, {}), size).at(0), speed)
    for kind, options in (
        ("in", {"spp": args.spp, "seed": 1, "sampler": "gpt"}),
        (
            "ref",
            {"spp": args.reference_spp * (1 if speed else 4), "seed": 2, "sampler": "primal", "with_features": False},
        ),
    ):
        (folder / kind).mkdir(parents=True, exist_ok=True)
        # A shot at rest has one reference.
        frames = range(args.frames if speed or kind == "in" else 1)
        target = {frame: folder / kind / f"{frame:04d}.exr" for frame in frames}
        shot = Shot(lambda frame: (name, {}), size, path)
        missing = [frame for frame, file in target.items() if not file.exists()]
        for frame, stack in render_sequence(shot, frames, skip=lambda f, m=missing: f not in m, **options):
            ngpt.write(target[frame], stack)


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
    # To and fro, that it stays in the room.
    return CameraPath([key(frame, speed * (2 if frame % 8 == 2 else -2)) for frame in range(-2, 200, 4)])


if __name__ == "__main__":
    main()
