"""The default and its rivals at equal whole time: Mitsuba's own renderer with OIDN, and OIDN on our samples.

    python -m bench.rivals kitchen/scene.xml product glass-caustic --references FOLDER

A scene is rendered by each of RENDERS:

    default      as `ngpt render -o image` renders: sampler, features, subpixels and method are the defaults
    ours         `primal` with whole paths
    mitsuba      Mitsuba's own renderer: the scene's integrator, a box filter, `independent` points, and the features
                 `albedo` and `sh_normal`; also at twice the size with a quarter of the samples per pixel
    multijitter  the same with Mitsuba's best points

OIDN denoises the renders of rivals in each of the WAYS: at K times the size, with features that it prefilters, takes as
clean, or takes as noisy. An image at twice the size is then scaled down. "1 and 2" is the mean of the images at both
sizes, which ngpt computes from subpixels (``ngpt.denoisers.oidn.of_both``). A cell has, for each way:

    seconds  processor seconds of the render and of OIDN, after a warm-up
    error    ``bench.judging.Judge.steady``, because references of some rooms are noisy
    FLIP     relative to the mean of the reference's halves

The table divides the error and FLIP of the default by the values of each of RIVALS after the same time. Values are
geometric means over seeds. At each time, a rival has its best way. ``bench.curves`` explains the marks, and
``bench.judging`` opens scenes and makes references. Cells in the file are not measured again.
"""

import argparse
import gc
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

import ngpt
from bench.common import renderer, table
from bench.curves import marked, over_least
from bench.judging import WARM_SPP, Cells, Judge, command, opened, parsed, timed
from ngpt.measure.averages import geometric_mean
from ngpt.stack import GradientStack
from ngpt.subpixels import FEWEST, means

RENDERS = ("default", "ours", "mitsuba", "multijitter")
# Name -> K, and how OIDN uses the features.
WAYS = {
    "1 prefiltered": (1, "prefiltered"),
    "2 noisy": (2, "noisy"),
    "2 clean": (2, "clean"),
    "2 prefiltered": (2, "prefiltered"),
    "1 and 2": (2, "auto"),
}
OWN = "1 and 2"
KNOWN = tuple(way for way in WAYS if way != OWN)  # ways that need no ngpt
# Name -> the renders and the ways that the rival may choose from.
RIVALS = {
    "Mitsuba + OIDN": (("mitsuba",), ("1 prefiltered",)),
    "Mitsuba + OIDN, K = 1 or 2": (("mitsuba",), KNOWN),
    "its best points, K = 1 or 2": (("mitsuba", "multijitter"), KNOWN),
    "OIDN on our samples, K = 1 or 2": (("ours",), KNOWN),
    "Mitsuba's best points, mean of both K": (("mitsuba", "multijitter"), (OWN,)),
    "our samples, mean of both K": (("ours",), (OWN,)),
}
POINTS = {"mitsuba": "independent", "multijitter": "multijitter"}
CELL = ("scene", "size", "render", "spp", "seed")
VALUES = ("error", "FLIP")
AOVS = "albedo:albedo,normal:sh_normal"


class Images(NamedTuple):
    """The inputs of a denoiser, each (H, W, 3) float32."""

    primal: np.ndarray
    albedo: np.ndarray
    normal: np.ndarray


def main() -> None:
    parser = command(__doc__, "rivals", "320x180", (4, 16, 64))
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--renders", nargs="+", default=list(RENDERS), choices=RENDERS)
    parser.add_argument("--ways", nargs="+", default=list(WAYS), choices=list(WAYS))
    args = parsed(parser)
    cells = Cells(args.output, "rivals", CELL)
    cells.measure(args.scenes, lambda scene, known: measured(scene, args, known))
    table(["scene", "spp", "whole s", *RIVALS], rows(cells))


def measured(scene: str, args: argparse.Namespace, known: set[tuple]) -> Iterator[dict[str, Any]]:
    """Yields the cells of a scene that are not ``known``."""
    load_scene, _ = renderer()
    size = args.pixels
    with opened(scene) as (name, file):
        judge = Judge(load_scene(file, size), name, args.references, args.size, args.reference_spp)
        for render in args.renders:
            gc.collect()  # a kernel contains the shapes of all scenes in memory
            make = by_default(file, size) if render == "default" else by_ways(images_of(file, size, render), args.ways)
            warm = False
            for spp in args.spp:
                for seed in args.seeds:
                    place = (name, args.size, render, spp, seed)
                    if place in known:
                        continue
                    if not warm:
                        # From FEWEST samples on, the default has subpixels, and so other kernels.
                        warm = bool([make(few, 0) for few in (WARM_SPP, FEWEST)])
                    made = make(spp, seed).items()
                    ways = {way: {"seconds": seconds} | judge.values(image) for way, (image, seconds) in made}
                    yield dict(zip(CELL, place, strict=True)) | {"ways": ways}


Made = dict[str, tuple[np.ndarray, float]]  # way -> the image, and the seconds to render and denoise it


def by_default(file: str, size: tuple[int, int]) -> Callable[[int, int], Made]:
    load_scene, render_stack = renderer()
    from data_gen.choosing.plans import plan_sampler, without_features
    from data_gen.request import RenderRequest

    scene = load_scene(file, size)

    def image(spp: int, seed: int) -> np.ndarray:
        plan = without_features(scene, plan_sampler(scene, RenderRequest(scene, spp)))
        how = {"unbiased": False, "subpixels": "auto", **plan.options}
        return ngpt.reconstruct(render_stack(scene, spp, seed, plan.sampler, **how), plan.method or "auto").image

    return lambda spp, seed: {"default": timed(lambda: image(spp, seed))}


def by_ways(images: Callable[[int, int, int], Images], ways: Sequence[str]) -> Callable[[int, int], Made]:
    def denoised(given: Images, k: int, auxiliary: str) -> np.ndarray:
        layers = given._asdict()
        if k > 1:
            stack = GradientStack({name: means(layer, k) for name, layer in layers.items()}, fine=layers)
        else:
            stack = GradientStack(layers)
        return ngpt.reconstruct(stack, "oidn", auxiliary=auxiliary).image

    def make(spp: int, seed: int) -> Made:
        rendered = {k: timed(lambda k=k: images(spp, seed, k)) for k in sorted({WAYS[way][0] for way in ways})}
        made = {}
        for way in ways:
            k, auxiliary = WAYS[way]
            given, seconds = rendered[k]
            image, more = timed(lambda given=given, k=k, a=auxiliary: denoised(given, k, a))
            made[way] = image, seconds + more
        return made

    return make


def images_of(file: str, size: tuple[int, int], render: str) -> Callable[[int, int, int], Images]:
    """A function of (samples per pixel, seed, K) that renders a scene at K times the size."""
    if render in POINTS:
        return mitsubas(file, size, POINTS[render])
    load_scene, render_stack = renderer()
    scene = load_scene(file, size)

    def images(spp: int, seed: int, k: int) -> Images:
        stack = render_stack(scene, spp, seed, "primal", unbiased=True, subpixels=k)
        return Images(*((stack.fine if k > 1 else stack)[layer] for layer in Images._fields))

    return images


def mitsubas(file: str, size: tuple[int, int], points: str) -> Callable[[int, int, int], Images]:
    """``images_of`` for Mitsuba's own renderer."""
    import mitsuba as mi

    scenes = {k: mitsuba_scene(file, (k * size[0], k * size[1]), points) for k in (1, 2)}

    def images(spp: int, seed: int, k: int) -> Images:
        scene = scenes[k]
        integrator = mi.load_dict({"type": "aov", "aovs": AOVS, "image": scene.integrator()})
        layers = np.array(mi.render(scene, integrator=integrator, spp=max(spp // k**2, 1), seed=seed), np.float32)
        # The film's own channels come first: RGB, and perhaps alpha.
        return Images(*(np.ascontiguousarray(each) for each in (layers[..., :3], layers[..., -6:-3], layers[..., -3:])))

    return images


def _set_part(state: Any, owner: Any, kind: Any, plugin: str) -> None:
    """Gives every node of the type ``owner`` the part ``plugin``, in place of its parts of this ``kind``."""
    import mitsuba as mi

    from data_gen.scenes.nodes import added, parts_of

    for number in range(len(state.nodes)):
        if state.nodes[number].type == owner:
            props = state.nodes[number].props
            for name, part in parts_of(props):
                if state.nodes[part].type == kind:
                    del props[name]
            # Adding a node may move the list of nodes, so references to its entries are not kept.
            reference = added(state, kind, mi.Properties(plugin))
            state.nodes[number].props["ngpt_part"] = reference


def mitsuba_scene(file: str, size: tuple[int, int], points: str) -> Any:
    """A scene for Mitsuba's own renderer, with these ``points`` and a box filter."""
    import mitsuba as mi

    from data_gen.scenes.bounds import mend_bounds
    from data_gen.scenes.builtin import SCENES
    from data_gen.scenes.load import found_beside, parsed, set_film_size
    from data_gen.scenes.merge import merge

    if file in SCENES:
        description = SCENES[file]()
        description["sensor"]["sampler"] = {"type": points}
        description["sensor"]["film"]["rfilter"] = {"type": "box"}
        scene = mi.load_dict(description, optimize=False)
    else:
        with found_beside(file):
            config, state = parsed(file)
            _set_part(state, mi.ObjectType.Sensor, mi.ObjectType.Sampler, points)
            _set_part(state, mi.ObjectType.Film, mi.ObjectType.ReconstructionFilter, "box")
            # Mitsuba is slow in scenes with many meshes, so meshes are merged.
            merge(config, state)
            scene = mi.parser.instantiate(config, state)
    mend_bounds(scene)
    set_film_size(scene, size)
    return scene


def rows(cells: list[dict[str, Any]]) -> Iterator[list[str]]:
    """The lines of the table: one for each scene and number of samples of the default."""
    for scene, size, spp in sorted({(c["scene"], c["size"], c["spp"]) for c in cells if c["render"] == "default"}):
        here = [c for c in cells if (c["scene"], c["size"]) == (scene, size)]
        mine = [c["ways"]["default"] for c in here if c["render"] == "default" and c["spp"] == spp]
        seconds = geometric_mean([each["seconds"] for each in mine])
        ratios = [over(mine, here, *rival) for rival in RIVALS.values()]
        yield [f"{scene} {size}", str(spp), f"{seconds:.2f}", *(", ".join(map(marked, each)) for each in ratios)]


def over(mine: list[dict], cells: list[dict], renders: tuple[str, ...], ways: tuple[str, ...]) -> list:
    """The default's error and FLIP, divided by the rival's at the same whole time; with marks."""
    seconds, found = geometric_mean([each["seconds"] for each in mine]), []
    for value in VALUES:
        curves = [points(cells, render, way, value) for render in renders for way in ways]
        found.append(over_least(geometric_mean([each[value] for each in mine]), seconds, curves))
    return found


def points(cells: list[dict], render: str, way: str, value: str) -> list[tuple[float, float]]:
    """(whole seconds, error) of a way for each number of samples: geometric means over seeds."""
    of = [c for c in cells if c["render"] == render and way in c["ways"]]
    by_spp = [[c["ways"][way] for c in of if c["spp"] == spp] for spp in sorted({c["spp"] for c in of})]
    return [(geometric_mean([e["seconds"] for e in each]), geometric_mean([e[value] for e in each])) for each in by_spp]


if __name__ == "__main__":
    main()
