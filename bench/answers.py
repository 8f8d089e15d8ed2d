"""The numbers and pictures of docs/use/answers.md:

    python -m bench.answers -o bench/results/answers.json --pictures docs/images

Each is measured on a built-in scene, or on a table of balls before nothing, which is made here. ``--only`` names some;
the others stay as they are in the file.
"""

import argparse
import resource
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

import ngpt
from bench.common import measure, metadata, renderer, save
from ngpt.api import lightgroups
from ngpt.image.display import auto_exposure, coloured, heat_table, to_srgb8
from ngpt.measure.metrics import relmse_trimmed
from ngpt.merging import merge
from ngpt.stack import GradientStack
from ngpt.system.records import read_json

WIDTH = 420  # pixels of a picture on a page


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", type=Path, default=Path("bench/results/answers.json"))
    parser.add_argument("--pictures", type=Path, default=Path("docs/images"))
    parser.add_argument("--only", nargs="*", default=list(ANSWERS), choices=list(ANSWERS))
    args = parser.parse_args()
    before = read_json(args.output) if args.output.is_file() else {}
    result: dict[str, Any] = before | {"benchmark": "answers"}
    result["metadata"] = metadata("mitsuba", "mitsuba-oidn", "onnxruntime")
    for name in args.only:
        result[name] = ANSWERS[name](args.pictures)
        print(name, result[name], flush=True)
    save(args.output, result)


def features(_: Path) -> dict[str, Any]:
    """Costs of features over renders without, by scene."""
    load_scene, _ = renderer()
    return {name: cost(load_scene(name, (320, 180))) for name in ("diffuse", "glossy", "environment")}


def cost(scene: Any) -> dict[str, Any]:
    """Cost of our sampler `primal` with features and of Mitsuba's integrator `aov` around its `path`, with seconds."""
    _, render_stack = renderer()
    import mitsuba as mi

    from data_gen.scenes.load import reference_integrator

    path, seeds = reference_integrator(scene), iter(range(10_000))

    def plain(integrator: Any) -> Callable[[], object]:
        return lambda: np.array(mi.render(scene, integrator=integrator, spp=16, seed=next(seeds)))

    calls: dict[str, Callable[[], object]] = {
        "primal": lambda: render_stack(scene, 16, next(seeds), "primal", with_features=False),
        "primal, features": lambda: render_stack(scene, 16, next(seeds), "primal"),
        "path": plain(path),
    }
    aovs = ("d:depth", "d:depth,n:sh_normal,a:albedo")
    calls |= {few: plain(mi.load_dict({"type": "aov", "aovs": few, "inner": path})) for few in aovs}
    seconds = {call: value["median"] for call, value in measure(calls, 5).items()}
    ratios = {few: seconds[few] / seconds["path"] for few in aovs}
    return {"ours": seconds["primal, features"] / seconds["primal"], **ratios, "seconds": seconds}


def adaptive(pictures: Path) -> dict[str, Any]:
    """Errors of `wcv` of adaptive and even samples, 128 in the mean; and where the samples went."""
    load_scene, render_stack = renderer()
    from data_gen.adaptive import Adaptive

    scene = load_scene("glossy", (WIDTH // 2, 118))
    reference = ngpt.denoise(render_stack(scene, 2048, 99, "gpt"), "wcv")
    even = render_stack(scene, 128, 1, "gpt")
    uneven = render_stack(scene, 128, 1, "gpt", adaptive=Adaptive())
    samples = uneven["samples"][..., 0]
    places = np.log(samples / samples.min()) / max(np.log(samples.max() / samples.min()), 1e-9)
    shown = to_srgb8(ngpt.denoise(uneven, "wcv"), auto_exposure(reference))
    draw(pictures / "answer-adaptive.png", shown, coloured(places, heat_table()))
    errors = [relmse_trimmed(ngpt.denoise(stack, "wcv"), reference) for stack in (even, uneven)]
    return {"even": errors[0], "adaptive": errors[1], "ratio": errors[1] / errors[0]} | {
        "samples": [float(samples.min()), float(np.median(samples)), float(samples.max())]
    }


def many(_: Path) -> dict[str, Any]:
    """16,384 samples in four parts: errors of 256, 4,096 and all of them, each from two independent renders."""
    load_scene, render_stack = renderer()
    scene = load_scene("diffuse", (64, 36))
    before = memory()
    sides = [[render_stack(scene, 4096, 10 * side + part, "primal") for part in range(4)] for side in range(2)]
    after = memory()
    few = [render_stack(scene, 256, 100 + side, "primal")["primal"] for side in range(2)]
    whole = [merge(parts) for parts in sides]
    pairs = {256: few, 4096: [parts[0]["primal"] for parts in sides], 16384: [stack["primal"] for stack in whole]}
    # The difference of two renders has the noise of both.
    errors = {str(spp): relmse_trimmed(one, other) / 2 for spp, (one, other) in pairs.items()}
    return {"spp": whole[0].attributes["ngpt:spp"], "relMSE": errors, "MiB before, after": [before, after]}


def memory() -> int:
    """The most of this process so far, in MiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss >> 10


def table_of_balls(lights: tuple[str, ...] = ("key", "fill"), size: tuple[int, int] = (140, 118)) -> Any:
    """Balls before nothing, those at the sides out of focus, so that coverage has noise."""
    renderer()
    import mitsuba as mi

    at, ball = mi.ScalarTransform4f(), "sphere"
    film = {"type": "hdrfilm", "width": size[0], "height": size[1], "pixel_format": "rgba", "rfilter": {"type": "box"}}
    camera = {"type": "thinlens", "fov": 40.0, "aperture_radius": 0.35, "focus_distance": 4.0, "film": film}
    camera["to_world"] = at.look_at([0, 0.4, 4], [0, 0, 0], [0, 1, 0])
    scene: dict[str, Any] = {"type": "scene", "integrator": {"type": "path", "hide_emitters": True}, "camera": camera}
    for name, place, colour in (
        ("one", [-1.1, 0, -2.0], [0.7, 0.3, 0.2]),
        ("two", [0, 0, 0], [0.6, 0.6, 0.6]),
        ("three", [0.8, 0, 2.0], [0.2, 0.4, 0.7]),
    ):
        scene[name] = {"type": ball, "center": place, "radius": 0.6 if name == "two" else 0.4}
        scene[name]["bsdf"] = {"type": "diffuse", "reflectance": {"type": "rgb", "value": colour}}
    places = {"key": ([2, 3, 3], [30.0, 26.0, 20.0]), "fill": ([-4, 1, 2], [3.0, 5.0, 9.0])}
    for name in lights:
        place, light = places[name]
        emitter = {"type": "area", "radiance": {"type": "rgb", "value": light}}
        scene[name] = {"type": ball, "center": place, "radius": 0.5, "emitter": emitter}
    return mi.load_dict(scene)


def alpha(pictures: Path) -> dict[str, Any]:
    """Error of alpha at 8 samples, denoised or not."""
    scene = table_of_balls()
    import mitsuba as mi

    noisy, reference = (np.array(mi.render(scene, spp=spp, seed=seed)) for spp, seed in ((8, 1), (2048, 2)))
    denoiser = ngpt.Denoiser((140, 118), denoise_alpha=True)
    clean = np.asarray(denoiser(noisy))
    shown = [np.repeat(np.clip(image[..., 3:], 0, 1), 3, axis=2) for image in (noisy, clean, reference)]
    draw(pictures / "answer-alpha.png", *(np.rint(255 * image).astype(np.uint8) for image in shown))
    errors = [float(np.sqrt(np.mean(np.square(i - shown[2])))) for i in shown[:2]]
    return {"RMSE noisy": errors[0], "RMSE denoised": errors[1], "ratio": errors[1] / errors[0]}


def infinite(pictures: Path) -> dict[str, Any]:
    """Sets one pixel of 21,240 to Inf, and measures how much this changes the output of OIDN and of `ngpt denoise`."""
    load_scene, render_stack = renderer()
    import mitsuba_oidn

    stack = render_stack(load_scene("glossy", (180, 118)), 16, 1, "primal")
    damaged = np.array(stack["primal"])
    damaged[40, 70] = np.inf
    given = {name: np.ascontiguousarray(stack[name]) for name in ("albedo", "normal")}
    alone = [np.array(mitsuba_oidn.denoise(image, **given, hdr=True)) for image in (np.array(stack["primal"]), damaged)]
    whole, result = ngpt.denoise(stack, "oidn"), ngpt.reconstruct(stack.replace(primal=damaged), "oidn")
    stops = auto_exposure(whole)
    draw(pictures / "answer-inf.png", *(to_srgb8(i[:, :140], stops) for i in (damaged, alone[1], result.image)))
    changed = {"OIDN alone": alone, "ngpt": (whole, result.image)}
    off = {name: float(np.mean(np.abs(b - a).max(-1) > 0.1 * a.max(-1))) for name, (a, b) in changed.items()}
    return {"share of pixels changed by more than a tenth": off, "repaired": result.repaired}


def groups(pictures: Path) -> dict[str, Any]:
    """Two lights, each denoised by itself, or so that they add up; the largest gap over the image's largest value."""
    renderer()
    import mitsuba as mi

    size = (140, 118)
    light = {
        name: np.array(mi.render(table_of_balls((name,), size), spp=16, seed=seed))[..., :3]
        for seed, name in enumerate(("key", "fill"), 1)
    }
    stack = GradientStack.from_arrays(primal=sum(light.values()))
    whole = ngpt.reconstruct(stack, "oidn")
    alone = {name: ngpt.denoise(GradientStack.from_arrays(primal=image), "oidn") for name, image in light.items()}
    parts = lightgroups.denoised(stack, light, whole.image, "oidn")
    stops = auto_exposure(whole.image)
    draw(pictures / "answer-groups.png", *(to_srgb8(image, stops) for image in (*parts.values(), whole.image)))
    peak = float(np.abs(whole.image).max())
    gaps = [float(np.abs(sum(images.values()) - whole.image).max()) / peak for images in (alone, parts)]
    return {"gap by themselves": gaps[0], "gap": gaps[1]}


def draw(path: Path, *images: np.ndarray) -> None:
    """Pictures (H, W, 3) uint8 side by side."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.hstack(images)).save(path, optimize=True)


ANSWERS: dict[str, Callable[[Path], dict[str, Any]]] = {
    "features": features,
    "adaptive": adaptive,
    "many": many,
    "alpha": alpha,
    "infinite": infinite,
    "groups": groups,
}

if __name__ == "__main__":
    main()
