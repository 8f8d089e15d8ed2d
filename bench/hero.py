"""The first picture of docs/index.md: path tracing, OIDN at equal rendering time, ngpt, reference; two crops of each.

    python -m bench.hero SCENE.xml --cache out/hero --references 8

The gradient stack has --spp samples per pixel. The cost of a sample is measured on the same scene and size, in turn,
and path tracing with features gets as many samples as fit into the same time. Time is processor time of all threads
together, so that other work on the machine does not change the comparison. The time to denoise is stated separately.
Nothing is chosen by hand: the camera is the scene's own, and the crops are the place where ngpt gains most over OIDN
and the place where it loses most (or gains least).

The reference is path traced in --references parts of --reference-spp samples, each with its own seed. Even and odd
parts make two independent halves A and B. relMSE is the mean of (x - A)(x - B) / (m² + 0.001) with m = (A + B) / 2, so
that the noise of the reference drops out in expectation; the 0.1 % of the pixels that are farthest from m are left out,
as in the tables. Pixels within SPREAD of a light that the camera sees are left out too, in numbers and crops: ngpt
keeps such light separate and OIDN does not, so only the other pixels are compared. Also recorded are the numbers of the
whole image, of OIDN with such light kept separate, and of ngpt without gradients. FLIP is computed against m and
recorded with its floor, the FLIP of A and B. For display only, not for any number, the two crops of the reference are
rendered again with --crop-spp samples. For display, too, pixels of the reference whose own standard error exceeds
UNSETTLED are replaced by the median of 3x3: these are fireflies, which path tracing never loses. All renders are kept
in the cache, so an interrupted run can continue. The script writes the picture and bench/results/hero.json.
"""

import argparse
import json
import time
from pathlib import Path

import numpy as np
from scipy.ndimage import binary_dilation, median_filter

from bench import panels
from bench.common import kept, metadata, rendered, save, summary
from ngpt.evaluation.config import scene_name
from ngpt.image.display import auto_exposure, to_srgb8
from ngpt.measure.flip import flip
from ngpt.measure.metrics import relative_squared_error, relmse, relmse_trimmed
from ngpt.methods import reconstruct
from ngpt.stack import GradientStack
from ngpt.system.writing import write_json

REFERENCE_SEED = 1 << 20  # far from the seed 0 of what is judged
TIMING_SPP, REPEATS = 16, 3
SPREAD = 3  # pixels
UNSETTLED = 0.1  # standard error over the light of a pixel
ZOOM = 3
COLUMN, ROW = 130 * ZOOM, 66 * ZOOM  # size of a crop in the picture
TITLES = {"path tracing": "Path tracing", "OIDN": "Open Image Denoise", "ngpt": "ngpt ({method})"}
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
    gradients, path = of_scene(args, "auto", args.spp, 0), of_scene(args, "primal", equal, 0)
    parts = [of_scene(args, "primal", args.reference_spp, REFERENCE_SEED + i) for i in range(args.references)]
    halves = [np.mean([part["primal"] for part in parts[i::2]], axis=0) for i in (0, 1)]
    apart = path.replace(primal=path["primal"] - path["direct"], direct=np.zeros_like(path["direct"]))
    inputs = {"path tracing": (path, "primal"), "OIDN": (path, "oidn"), "ngpt": (gradients, args.method)}
    inputs |= {"OIDN, lights apart": (apart, "oidn"), "without gradients": (path, "ngpt-primal")}
    seconds, images, methods = {}, {}, {}
    for name, (stack, method) in inputs.items():
        reconstruct(stack, method)  # loads what the method needs
        start = time.process_time()
        result = reconstruct(stack, method)
        seconds[name] = time.process_time() - start
        images[name], methods[name] = result.image + (path["direct"] if stack is apart else 0), result.method
    reference = np.mean(halves, axis=0)
    judged = ~binary_dilation((path["direct"] > 0).any(axis=-1), iterations=SPREAD)
    numbers = {
        name: {
            "method": methods[name],
            "spp": args.spp if name == "ngpt" else equal,
            "render CPU seconds": args.spp * cost["auto"]["median"],
            "reconstruction CPU seconds": seconds[name],
            "relMSE trimmed": relmse_trimmed(*(part[judged][None] for part in (image, *halves))),
            "relMSE trimmed, whole image": relmse_trimmed(image, *halves),
            "FLIP": flip(image, reference)[0],
        }
        for name, image in images.items()
    }
    floor = flip(*halves)[0]
    noise = relmse((halves[0] - halves[1]) / 2 + reference, reference)
    spp = args.references * args.reference_spp
    errors = [relative_squared_error(images[name], *halves).mean(axis=-1) for name in ("OIDN", "ngpt")]
    boxes = extremes(errors[0] - errors[1], judged, COLUMN // ZOOM, ROW // ZOOM)
    setup = {"benchmark": "hero", "scene": scene_name(args.scene), "size": args.size, "CPU seconds per spp": cost}
    quality = {"spp": spp, "crop spp": args.crop_spp, "relMSE of its noise": noise, "FLIP of its halves": floor}
    where = metadata("mitsuba", "mitsuba-oidn", "flip-evaluator")
    save(args.output, setup | {"results": numbers, "reference": quality, "crops": boxes, "metadata": where})
    variance = np.mean([part["primal_var"] for part in parts], axis=0) / len(parts)
    shown = {name: images[name] for name in TITLES} | {"reference": settled(reference, variance)}
    clean = [reference_crop(args, box) for box in boxes]
    panels.save(args.picture, picture(shown, headings(numbers, spp, args.crop_spp), boxes, clean))


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
        write_json(file, {sampler: summary(values) for sampler, values in seconds.items()})
    return json.loads(file.read_text())


def of_scene(args: argparse.Namespace, sampler: str, spp: int, seed: int) -> GradientStack:
    # Without gradients beside it the reader takes the name "direct" for direct light.
    names = {"direct": "direct"} if sampler == "primal" else None
    return rendered(args.cache, args.size, args.scene, spp, sampler, seed, names)


def reference_crop(args: argparse.Namespace, box: tuple[int, int, int, int]) -> np.ndarray:
    """The box (left, top, width, height) of the reference with --crop-spp samples, from the cache if it is there."""
    left, top, width, height = box
    file = args.cache / f"{scene_name(args.scene)}-crop-{args.crop_spp}-{left}-{top}-{width}x{height}.exr"

    def make() -> GradientStack:
        import mitsuba as mi

        from data_gen.render import render_stack
        from data_gen.scenes.load import load_scene

        scene = load_scene(args.scene, tuple(args.size))
        film = mi.traverse(scene.sensors()[0])
        film["film.crop_size"], film["film.crop_offset"] = [width, height], [left, top]
        film.update()
        return render_stack(scene, args.crop_spp, REFERENCE_SEED, "primal", with_features=False)

    crop = kept(file, make)
    return settled(crop["primal"], crop["primal_var"])


def settled(image: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """The image, (H, W, 3), with the median of 3x3 pixels where its own standard error is over ``UNSETTLED``."""
    error = np.sqrt(variance.sum(axis=-1)) / (image.sum(axis=-1) + 0.01)
    return np.where((error > UNSETTLED)[..., None], median_filter(image, size=(3, 3, 1)), image)


def extremes(gain: np.ndarray, judged: np.ndarray, width: int, height: int) -> list[tuple[int, int, int, int]]:
    """The (left, top, width, height) where the mean of ``gain`` is largest, and where it is least, not overlapping.

    Only windows whose pixels are all ``judged`` count.
    """
    # Bounded, so that a place with many pixels that differ wins over a single firefly.
    means = panels.windows(np.clip(gain, -1, 1), width, height)
    means[panels.windows((~judged).astype(float), width, height) > 0] = np.nan
    y, x = np.unravel_index(np.nanargmax(means), means.shape)
    means[max(0, y - height) : y + height, max(0, x - width) : x + width] = np.nan
    other_y, other_x = np.unravel_index(np.nanargmin(means), means.shape)
    return [(int(x), int(y), width, height), (int(other_x), int(other_y), width, height)]


def headings(numbers: dict[str, dict], spp: int, crop_spp: int) -> list[list[str]]:
    lines = []
    for name, title in TITLES.items():
        row = numbers[name]
        kind = "spp with gradients" if name == "ngpt" else "spp"
        extra = "" if name == "path tracing" else f" + {row['reconstruction CPU seconds']:.1f}"
        scores = f"relMSE {row['relMSE trimmed']:.4f}"
        lines.append(
            [title.format(**row), f"{row['spp']} {kind}: {row['render CPU seconds']:.0f}{extra} s of CPU", scores]
        )
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
