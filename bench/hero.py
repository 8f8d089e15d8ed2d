"""The first picture of README.md: path tracing, OIDN at equal rendering time, ngpt, reference; and two crops of each.

    python -m bench.hero SCENE.xml --cache out/hero --references 8

The gradient stack has --spp samples per pixel. What a sample costs is measured on the same scene and size, in turn,
and path tracing with features gets as many samples as the same time buys. Time is processor time of all threads
together, so that other work on the machine does not change the comparison. The time to denoise is stated apart.
Nothing is chosen by hand: the camera is the scene's own, the crops are the place where ngpt gains most over OIDN and
the place where it loses most (or gains least).

The reference is path traced in --references parts of --reference-spp samples, each with its own seed. Even and odd
parts make two independent halves A and B. relMSE is the mean of (x - A)(x - B) / (m² + 0.001) with m = (A + B) / 2, so
that the noise of the reference drops out in expectation; the 0.1 % of the pixels that are farthest from m are left out,
as in the tables. FLIP is computed against m and recorded beside its floor, the FLIP of A and B. The two crops of the
reference are rendered again with --crop-spp samples, for the eye alone. All renders are kept in the cache, so a run
that was broken off goes on. Written are the picture and bench/results/hero.json.
"""

import argparse
import json
import time
from pathlib import Path

import numpy as np

import ngpt
from bench import panels
from bench.common import metadata, save, summary
from ngpt.evaluation.config import scene_name
from ngpt.measure.metrics import EPSILON
from ngpt.measure.perceptual import flip
from ngpt.methods import reconstruct
from ngpt.report.display import auto_exposure, to_srgb8
from ngpt.stack import GradientStack
from ngpt.system.files import atomic_output

REFERENCE_SEED = 1 << 20  # far from the seed 0 of what is judged
TIMING_SPP, REPEATS = 16, 3
TRIMMED = 0.001  # share of the pixels that relMSE leaves out
ZOOM = 3
COLUMN, ROW = 130 * ZOOM, 66 * ZOOM  # size of a crop in the picture
COLOURS = ("#ff5500", "#00a2ff")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", help="a Mitsuba scene file or a built-in scene")
    parser.add_argument("--method", default="auto", help="what stands for ngpt")
    parser.add_argument("--spp", type=int, default=64)
    parser.add_argument("--size", type=int, nargs=2, default=(640, 360), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--references", type=int, default=8, metavar="N", help="parts of the reference, an even number")
    parser.add_argument("--reference-spp", type=int, default=128, help="of each part")
    parser.add_argument("--crop-spp", type=int, default=4096, help="of the crops of the reference")
    parser.add_argument("--cache", type=Path, required=True, help="folder for what is rendered")
    parser.add_argument("--picture", type=Path, default=Path("docs/images/hero.jpg"))
    parser.add_argument("-o", "--output", type=Path, default=Path("bench/results/hero.json"))
    args = parser.parse_args()
    args.cache.mkdir(parents=True, exist_ok=True)

    from data_gen.backend import use_variant

    use_variant()
    cost = costs(args)
    equal = round(args.spp * cost["auto"]["median"] / cost["primal"]["median"])
    gradients, path = rendered(args, "auto", args.spp, 0), rendered(args, "primal", equal, 0)
    parts = [rendered(args, "primal", args.reference_spp, REFERENCE_SEED + i) for i in range(args.references)]
    halves = [np.mean([part["primal"] for part in parts[i::2]], axis=0) for i in (0, 1)]
    inputs = {"path tracing": (path, "primal"), "OIDN": (path, "oidn"), "ngpt": (gradients, args.method)}
    seconds, results = {}, {}
    for name, (stack, method) in inputs.items():
        reconstruct(stack, method)  # loads what the method needs
        start = time.process_time()
        results[name] = reconstruct(stack, method)
        seconds[name] = time.process_time() - start
    reference = np.mean(halves, axis=0)
    errors = {name: squared_error(result.image, halves) for name, result in results.items()}
    numbers = {
        name: {
            "method": result.method,
            "spp": args.spp if name == "ngpt" else equal,
            "render CPU seconds": args.spp * cost["auto"]["median"],
            "reconstruction CPU seconds": seconds[name],
            "relMSE trimmed": trimmed_mean(errors[name], result.image, reference),
            "FLIP": flip(result.image, reference)[0],
        }
        for name, result in results.items()
    }
    floor = flip(*halves)[0]
    noise = float(np.mean((halves[0] - halves[1]) ** 2 / (reference**2 + EPSILON))) / 4
    spp = args.references * args.reference_spp
    boxes = extremes(errors["OIDN"] - errors["ngpt"], COLUMN // ZOOM, ROW // ZOOM)
    save(
        args.output,
        {"benchmark": "hero", "scene": scene_name(args.scene), "size": list(args.size), "cost": cost}
        | {
            "results": numbers,
            "reference": {"spp": spp, "relMSE of its noise": noise, "FLIP of its halves": floor},
            "crops": boxes,
        }
        | {"metadata": metadata("mitsuba", "mitsuba-oidn", "flip-evaluator")},
    )
    images = {name: result.image for name, result in results.items()} | {"reference": reference}
    clean = [reference_crop(args, box) for box in boxes]
    panels.save(args.picture, picture(images, headings(numbers, spp, args.crop_spp), boxes, clean))


def costs(args: argparse.Namespace) -> dict[str, dict[str, float]]:
    """CPU seconds per sample of each pixel, kernels compiled, by sampler: medians and quartiles of renders in turn."""
    from data_gen.render import render_stack
    from data_gen.scenes.load import load_scene

    file = args.cache / f"{scene_name(args.scene)}-cost-{args.size[0]}x{args.size[1]}.json"
    if not file.exists():
        scene = load_scene(args.scene, tuple(args.size))
        seconds: dict[str, list[float]] = {"auto": [], "primal": []}
        for repeat in range(REPEATS + 1):
            for sampler, values in seconds.items():
                start = time.process_time()
                render_stack(scene, TIMING_SPP, repeat, sampler)
                if repeat:  # the first one compiles
                    values.append((time.process_time() - start) / TIMING_SPP)
        with atomic_output(file) as temporary:
            temporary.write_text(json.dumps({sampler: summary(values) for sampler, values in seconds.items()}))
    return json.loads(file.read_text())


def rendered(args: argparse.Namespace, sampler: str, spp: int, seed: int) -> GradientStack:
    """A stack, from the cache if it is there."""
    width, height = args.size
    file = args.cache / f"{scene_name(args.scene)}-{sampler}-{spp}-{seed}-{width}x{height}.exr"
    if not file.exists():
        from data_gen.render import render_stack
        from data_gen.scenes.load import load_scene

        print(f"rendering {file.name}", flush=True)
        ngpt.write(file, render_stack(load_scene(args.scene, (width, height)), spp, seed, sampler))
    # Without gradients beside it the reader takes the name "direct" for direct light.
    return ngpt.read(file, {"direct": "direct"} if sampler == "primal" else None)


def reference_crop(args: argparse.Namespace, box: tuple[int, int, int, int]) -> np.ndarray:
    """The box (left, top, width, height) of the reference with --crop-spp samples, from the cache if it is there."""
    left, top, width, height = box
    file = args.cache / f"{scene_name(args.scene)}-crop-{args.crop_spp}-{left}-{top}-{width}x{height}.exr"
    if not file.exists():
        import mitsuba as mi

        from data_gen.render import render_stack
        from data_gen.scenes.load import load_scene

        print(f"rendering {file.name}", flush=True)
        scene = load_scene(args.scene, tuple(args.size))
        film = mi.traverse(scene.sensors()[0])
        film["film.crop_size"], film["film.crop_offset"] = [width, height], [left, top]
        film.update()
        ngpt.write(file, render_stack(scene, args.crop_spp, REFERENCE_SEED, "primal", with_features=False))
    return ngpt.read(file)["primal"]


def squared_error(image: np.ndarray, halves: list[np.ndarray]) -> np.ndarray:
    """(H, W): relative squared error of each pixel against two independent halves of a reference; may be negative."""
    a, b = halves
    return np.mean((image - a) * (image - b) / (((a + b) / 2) ** 2 + EPSILON), axis=-1)


def trimmed_mean(error: np.ndarray, image: np.ndarray, reference: np.ndarray) -> float:
    """The mean of ``error`` without the TRIMMED share of the pixels that differ most from the reference."""
    distance = np.mean((image - reference) ** 2 / (reference**2 + EPSILON), axis=-1).ravel()
    kept = np.argsort(distance)[: distance.size - int(TRIMMED * distance.size)]
    return float(error.ravel()[kept].mean())


def extremes(gain: np.ndarray, width: int, height: int) -> list[tuple[int, int, int, int]]:
    """The (left, top, width, height) where the mean of ``gain`` is largest, and where it is least, not overlapping."""
    # Bounded, so that a place with many pixels that differ wins over a single firefly.
    sums = np.pad(np.clip(gain, -1, 1), ((1, 0), (1, 0))).cumsum(axis=0).cumsum(axis=1)
    windows = sums[height:, width:] - sums[:-height, width:] - sums[height:, :-width] + sums[:-height, :-width]
    y, x = np.unravel_index(np.argmax(windows), windows.shape)
    windows[max(0, y - height) : y + height, max(0, x - width) : x + width] = np.inf
    other_y, other_x = np.unravel_index(np.argmin(windows), windows.shape)
    return [(int(x), int(y), width, height), (int(other_x), int(other_y), width, height)]


def headings(numbers: dict[str, dict], spp: int, crop_spp: int) -> list[list[str]]:
    titles = {"path tracing": "Path tracing", "OIDN": "Open Image Denoise", "ngpt": "ngpt"}
    lines = []
    for name, row in numbers.items():
        kind = "spp with gradients" if name == "ngpt" else "spp"
        title = f"ngpt ({row['method']})" if name == "ngpt" else titles[name]
        extra = "" if name == "path tracing" else f" + {row['reconstruction CPU seconds']:.0f}"
        scores = f"relMSE {row['relMSE trimmed']:.4f}"
        lines.append([title, f"{row['spp']} {kind}: {row['render CPU seconds']:.0f}{extra} s of CPU", scores])
    return [*lines, ["Reference", f"path tracing, {spp} spp", f"crops: {crop_spp} spp"]]


def picture(images: dict, lines: list[list[str]], boxes: list[tuple], clean: list[np.ndarray]) -> np.ndarray:
    """A column for each image: the whole with the crops marked, and the crops; ``clean`` are the reference's."""
    exposure = auto_exposure(images["reference"])
    tiles = []
    for name, image in images.items():
        shown = to_srgb8(image, exposure)
        height = round(shown.shape[0] * COLUMN / shown.shape[1])
        whole = panels.scaled(panels.framed(shown, boxes, COLOURS), (COLUMN, height))
        parts = [shown[y : y + h, x : x + w] for x, y, w, h in boxes]
        if name == "reference":
            parts = [to_srgb8(crop, exposure) for crop in clean]
        crops = [panels.scaled(part, (COLUMN, ROW)) for part in parts]
        frame = [(0, 0, COLUMN, ROW)]
        tiles.append([whole, *(panels.framed(c, frame, [k]) for c, k in zip(crops, COLOURS, strict=True))])
    return panels.columns(lines, tiles)


if __name__ == "__main__":
    main()
