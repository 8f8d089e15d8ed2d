"""Differences of photons with gradients: those of the image, with copies, and with little noise. Most is slow."""

from types import SimpleNamespace

import bdpt_scenes
import numpy as np
import pytest
from camera_cases import camera
from photon_copies import assert_no_bias, gain
from photon_images import cases, named
from unbiased import load, render_ours

from data_gen.paths.camera import CameraSamples
from data_gen.paths.walk import Limits
from data_gen.render import render_stack
from ngpt.io.exr import pass_through
from ngpt_studies.photons.gradients.camera import CameraPaths


def without_glass():
    """The sky, whose sun no camera path meets by chance: that is rarer than any test has samples for."""
    scene = bdpt_scenes.SCENES["sky"]()
    del scene["glass"]
    return scene


# How passes are rendered whose differences are judged
GRADIENTS = {
    "gpm": {"radius": 0.7, "photons": 2},
    "gvpm": {"radius": 0.7, "photons": 8},
    "gbre": {"radius": 0.7, "photons": 2},
    "gbeams": {"radius": 0.5, "photons": 1},
    "gplanes": {"radius": 0.5},
    "gvcm": {"radius": 0.7},
}
IN_FOG = [("colours", 4), ("haze", 1), ("haze", 4), ("forward", 4), ("dense", 4), ("nested", 4), ("milk", 4)]
IN_GRIDS = [("wisps", 1), ("wisps", 4), ("smoke", 4), ("coloured_smoke", 4), ("before_the_sky", 1)]
ON_SURFACES = [("areas", 4), ("areas", 1), ("glass", 1), ("points", 1), ("points", 4), ("sky", 1), ("sky", 4)]


@pytest.mark.parametrize(
    ("sampler", "name", "pixels", "options"),
    cases(
        # Where all strategies find light
        [("gpm", "glass", 4, {}), ("gvcm", "glass", 4, {"radius": 0.5})],
        # Where nothing but merging does. Over four pixels no photon is near to both.
        [("gvcm", "seen_through_glass", 1, {"radius": 2.0}), ("gvcm", "caustics", 4, {}), ("gvcm", "areas", 4, {})]
        + [("gvcm", "glass", 4, {"radius": 0.1})]
        + [("gpm", *case, {}) for case in ON_SURFACES]
        + [(s, *case, {}) for s in ("gvpm", "gbre", "gbeams", "gplanes") for case in IN_FOG]
        + [("gvpm", *case, {}) for case in IN_GRIDS],
    ),
)
def test_differences_are_those_of_the_image(renderer, sampler, name, pixels, options):
    """In one pass after another: with the same photons, so that the noise of both falls out in part."""
    scene = load(renderer, without_glass if name == "sky" else named(name), (12, 12))
    options = GRADIENTS[sampler] | options | {"points": "independent"}
    stacks = render_ours(scene, sampler, 32, 1, pixels, **options)
    assert np.mean([stack["primal"].mean() for stack in stacks]) > 0.01
    assert_no_bias(stacks, pixels)


TWINS = [("gvpm", "vpm"), ("gbre", "bre"), ("gbeams", "beams"), ("gplanes", "planes")]


@pytest.mark.parametrize(
    ("pair", "name"),
    cases(
        [(("gpm", "ppm"), "glass"), (("gpm", "ppm"), "hidden_sky")],
        [(("gvcm", "vcm"), "glass"), *((pair, "nested") for pair in TWINS), (TWINS[1], "milk")]
        + [(TWINS[0], name) for name in ("milk", "wisps", "before_the_sky")],
    ),
)
def test_the_primal_is_that_of_the_sampler_without_gradients(renderer, pair, name):
    """Camera paths and photons are the same. Russian roulette differs: it looks at five paths instead of one."""
    scene = load(renderer, named(name, max_depth=5, rr_depth=9), (24, 16))
    ours, theirs = (render_ours(scene, sampler, 1, 2, radius=1.0)[0] for sampler in pair)
    for layer in ("primal", "direct", "albedo", "normal", "depth"):
        alike = np.isclose(ours[layer], theirs[layer], rtol=1e-3 if pair[0] != "gpm" else 1e-4, atol=1e-5)
        assert alike.mean() > 0.99 if pair[0] == "gvcm" else alike.all(), layer


@pytest.mark.parametrize(
    ("sampler", "name", "size", "options", "fails", "mean", "median"),
    cases(
        [
            # Measured: 0.945, 12.7 and 91; for gvcm, of photons that are near to both of two pixels, 1.9
            ("gpm", "diffuse", 64, {"radius": 1.0}, 0.1, 5, 30),
            ("gvcm", "seen_through_glass", 32, {"radius": 3.0}, None, 1.5, 1.5),
        ],
        [
            # Photons from glass are near to both, as long as the radius is wide. No other photon has a copy.
            ("gpm", "caustics", 32, {"radius": 3.0}, None, 1.5, 2),
            *((name, "fog", 32, {"radius": 1.0}, 0.1, 5, 30) for name in ("gvpm", "gbre")),
            ("gbeams", "fog", 32, {"radius": 0.5}, 0.15, 3, 5),
            # Where a grid is empty there are none: more fail than in fog.
            ("gvpm", "wisps", 24, {"radius": 0.7, "photons": 8}, 0.2, 6, 15),
        ],
    ),
)
def test_there_are_copies_and_differences_have_little_noise(
    renderer, sampler, name, size, options, fails, mean, median
):
    """No z-test asks for that: a sampler that rejects every shift is unbiased."""
    scene = load(renderer, named(name), (size, size))
    if fails:
        stack = render_stack(scene, 2, 0, sampler, diagnostics=True, unbiased=True, **options)
        assert pass_through(stack)["diagnostics.shiftFailures"].mean() < fails
    gained = gain(render_ours(scene, sampler, 8, 1, points="independent", **options))
    assert gained[0] > mean and gained[1] > median, gained


def test_paths_and_their_copies_to_photons_end_at_the_far_plane(renderer):
    """The cells of the matrix that show it are slow."""
    ray, _, _ = CameraSamples(renderer.load_dict(camera(fov=40, near_clip=1.6, far_clip=4.0)), 0, 64).rays()
    walk = CameraPaths(SimpleNamespace(limits=Limits(4, 100)), None)
    assert np.array_equal(np.array(walk.first(ray, 1.0, True).ray.maxt), np.array(ray.maxt))
    assert np.array(ray.maxt).max() < 4
