"""Photons in media: their images and their differences. Of studies all but a short law or two is slow."""

from dataclasses import dataclass, field

import media_scenes
import numpy as np
import pytest
from data_gen_scenes import fog
from photon_laws import assert_alike, assert_no_bias, gain, passes
from unbiased import REFERENCES, far_shifts, light_of_gradients, load, render_ours


@dataclass
class Image:
    """How an image is compared with that of ``volpath``: batches of one pass, against as many references."""

    radius: float = 0.4
    photons: int = 24
    block: int = 4
    batches: int = 6
    references: int = 128
    seed: int = REFERENCES
    options: dict = field(default_factory=dict)

    def assert_alike(self, renderer, sampler, scene):
        scene = load(renderer, scene, (16, 16))
        options = {"radius": self.radius, "photons": self.photons, **self.options}
        ours = render_ours(scene, sampler, batches=self.batches, spp=1, **options)
        theirs = render_ours(scene, "primal", batches=self.batches, spp=self.references, seed=self.seed)
        # Light that is seen directly is its expectation in ours, and has its own edges.
        images, references = (np.stack([light_of_gradients(s) for s in stacks]) for stacks in (ours, theirs))
        assert references.mean() > 0.01
        assert_alike(images, references, self.block)


def vpm(**changed):
    return Image(**{"photons": 128, "batches": 8, "seed": 0} | changed)


def bre(**changed):
    return Image(**{"photons": 96, "seed": 0} | changed)


def planes(**changed):
    return Image(**{"options": {"planes": 512}} | changed)


def short(scene, max_depth, rr_depth=5):
    """The same with paths of no more edges."""
    integrator = {"type": "volpath", "max_depth": max_depth, "rr_depth": rr_depth}
    return lambda: (fog if scene == "fog" else getattr(media_scenes, scene))() | {"integrator": integrator}


QUICK = [
    ("bre", "colours", bre()),
    ("bre", "milk", bre(block=8, batches=10)),  # liquids in clear and in frosted glass: few photons get there
    ("bre", "wisps", bre(radius=0.3, photons=64, block=8, references=32)),
]
# Along boundaries that bend nothing, of media within each other, it is too dark by a share that falls like the radius.
SLOW = [
    ("vpm", "wisps", vpm(radius=0.6, photons=40, references=32)),  # grids that fade: their density is not blurred
    ("beams", "colours", Image()),
    *(("vpm", name, vpm()) for name in ("haze", "forward", "colours", "milk")),
    ("vpm", "nested", vpm(radius=0.2, photons=256, block=16)),
    ("bre", "forward", bre()),
    ("bre", "nested", bre(radius=0.15, photons=192, block=16)),
    *(("beams", name, Image()) for name in ("haze", "forward", "dense", "fog")),
    ("beams", "milk", Image(block=8)),
    ("beams", "nested", Image(block=16)),
    ("beams", "wisps", Image(radius=0.3, block=8)),
    *(("planes", name, planes()) for name in ("colours", "haze", "dense", "fog")),
    *(("planes", name, planes(block=16)) for name in ("forward", "nested")),
    ("planes", "milk", planes(block=8)),
]


def cases(quick, slow):
    return [*quick, *(pytest.param(*case, marks=pytest.mark.slow) for case in slow)]


@pytest.mark.parametrize(("sampler", "name", "image"), cases(QUICK, SLOW))
def test_small_radii_have_the_image_of_volpath(renderer, sampler, name, image):
    image.assert_alike(renderer, sampler, fog if name == "fog" else getattr(media_scenes, name))


@pytest.mark.parametrize(
    ("sampler", "max_depth", "image"),
    cases([("bre", 2, bre(radius=0.3, photons=48))], [("vpm", 2, vpm()), ("vpm", 3, vpm()), ("beams", 2, Image())]),
)
def test_paths_in_media_are_no_longer_than_the_scene_says(renderer, sampler, max_depth, image):
    """With two edges light is scattered once, in the medium or on a surface."""
    image.assert_alike(renderer, sampler, short("haze", max_depth))


@pytest.mark.parametrize(
    ("sampler", "photons", "least"), cases([("bre", 8, -0.6)], [("vpm", 16, -4 / 9), ("beams", 2, -0.6)])
)
def test_it_converges_in_media(renderer, sampler, photons, least):
    """The squared error of the mean falls with passes; what is left of the blur like n^(-2/3), of balls n^(-4/9)."""
    from data_gen.render import render_stack

    scene = load(renderer, fog, (16, 16))
    reference = np.array(renderer.render(scene, spp=4096, seed=REFERENCES if sampler == "beams" else 0))

    def error(n):
        x = render_stack(scene, n, 0, sampler, photons=photons, radius=1.0)["primal"]
        return np.mean((x - reference) ** 2 / (reference**2 + 0.01))

    counts = 2, 8, 32
    slope, _ = np.polyfit(np.log(counts), np.log([error(n) for n in counts]), 1)
    assert slope < least


@pytest.mark.parametrize(
    ("better", "worse", "radius", "photons", "times"),
    cases([("bre", "vpm", 1.0, 4, 5)], [("beams", "bre", 0.5, 2, 2)]),
)
def test_they_have_less_noise_than_points(renderer, better, worse, radius, photons, times):
    """Of the same light paths, in thin fog; ``bre`` was measured to have 25 times less than ``vpm``."""
    scene = load(renderer, media_scenes.haze, (16, 16))
    noise = []
    for name in (better, worse):
        stacks = render_ours(scene, name, batches=5, spp=1, radius=radius, photons=photons)
        noise.append(np.stack([s["primal"] for s in stacks]).var(axis=0, ddof=1).mean())
    assert noise[0] < noise[1] / times


# ----------------------------- Gradients -----------------------------


TWINS = [("gvpm", "vpm"), ("gbre", "bre"), ("gbeams", "beams"), ("gplanes", "planes")]
# How passes are rendered whose differences are judged
GRADIENTS = {
    "gvpm": {"radius": 0.7, "photons": 8},
    "gbre": {"radius": 0.7, "photons": 2},
    "gbeams": {"radius": 0.5, "photons": 1},
    "gplanes": {"radius": 0.5},
}
IN_FOG = [("haze", 1), ("haze", 4), ("forward", 4), ("dense", 4), ("nested", 4), ("milk", 4)]
IN_GRIDS = [("wisps", 1), ("wisps", 4), ("smoke", 4), ("coloured_smoke", 4), ("before_the_sky", 1)]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sampler", "name", "pixels"),
    [(s, *case) for s in GRADIENTS for case in [("colours", 4), *IN_FOG]] + [("gvpm", *case) for case in IN_GRIDS],
)
def test_differences_in_media_are_those_of_the_image(renderer, sampler, name, pixels):
    """In one pass after another: with the same photons, so that the noise of both falls out in part."""
    scene = load(renderer, getattr(media_scenes, name), (12, 12))
    stacks = passes(scene, 32, pixels, sampler, **GRADIENTS[sampler])
    assert np.mean([stack["primal"].mean() for stack in stacks]) > 0.01
    assert_no_bias(stacks, pixels)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("pair", "name"),
    [(pair, "nested") for pair in TWINS]
    + [(TWINS[1], "milk"), *((TWINS[0], name) for name in ("milk", "wisps", "before_the_sky"))],
)
def test_the_primal_is_that_of_the_sampler_without_gradients(renderer, pair, name):
    """The same camera paths and photons; Russian roulette alone looks at five paths instead of one."""
    scene = load(renderer, short(name, 5, rr_depth=9), (24, 16))
    ours, theirs = (render_ours(scene, sampler, 1, 2, radius=1.0)[0] for sampler in pair)
    for layer in ("primal", "direct", "albedo", "normal", "depth"):
        assert np.allclose(ours[layer], theirs[layer], rtol=1e-3, atol=1e-5), layer


@pytest.mark.slow
@pytest.mark.parametrize("sampler", GRADIENTS)
def test_shifts_by_nothing_find_no_difference_in_media(renderer, sampler):
    """The copy of a path through its own pixel is the path; but for the rounding of planes that turn by nothing."""
    from data_gen.render import render_stack

    photons = {"photons": 4} if sampler == "gvpm" else {}
    with far_shifts(0):
        layers = render_stack(load(renderer, media_scenes.milk, (16, 16)), 2, 0, sampler, **photons).layers
    most = 1e-4 * layers["primal"].max() if sampler == "gplanes" else 0
    assert layers["primal"].any() and max(np.abs(layers["dx"]).max(), np.abs(layers["dy"]).max()) <= most


@pytest.mark.parametrize(
    ("sampler", "size", "radius", "fails", "mean", "median"),
    cases([("gbre", 32, 1.0, 0.1, 5, 30)], [("gvpm", 48, 1.0, 0.1, 5, 30), ("gbeams", 32, 0.5, 0.15, 3, 5)]),
)
def test_there_are_copies_and_differences_have_little_noise(renderer, sampler, size, radius, fails, mean, median):
    """No z-test asks for that: a sampler that rejects every shift is unbiased."""
    scene = load(renderer, fog, (size, size))
    failed = failures(scene, sampler, radius=radius)
    gained = gain(passes(scene, 8, 1, sampler, radius=radius))
    assert failed < fails and gained[0] > mean and gained[1] > median, (failed, gained)


@pytest.mark.slow
def test_photons_in_grids_have_copies_and_differences_little_noise(renderer):
    """Where a grid is empty there are none: more fail than in fog."""
    scene = load(renderer, media_scenes.wisps, (24, 24))
    failed = failures(scene, "gvpm", radius=1.0, photons=8)
    mean, median = gain(passes(scene, 8, 1, "gvpm", radius=0.7, photons=8))
    assert failed < 0.2 and mean > 6 and median > 15, (failed, mean, median)


def failures(scene, sampler, **options):
    """The share of photons without a copy."""
    from data_gen.render import render_stack
    from ngpt.io.exr import pass_through

    stack = render_stack(scene, 2, 0, sampler, diagnostics=True, **options)
    return pass_through(stack)["diagnostics.shiftFailures"].mean()
