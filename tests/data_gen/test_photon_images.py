"""Images of photons: on surfaces, in media and with connections."""

from dataclasses import replace

import bdpt_scenes
import pytest
from photon_images import BRE, Image, cases, convergence
from unbiased import load, render_ours

from data_gen.render import render_stack
from data_gen.scenes.builtin import _camera, _light, _wall

PPM = Image(radius=0.3, photons=64, block=6, batches=12, size=(24, 24), references=64, images=24)
SMALL = replace(PPM, size=(16, 16), block=4)
VCM = Image(0.5, None, 6, 64, (24, 24), 0.02, by="bdpt", references=32, images=8)
# Where nothing but merging finds light
ALONE = replace(VCM, radius=2.0, batches=24, by="ppm", references=1, images=24)

# Photons of all lamps on surfaces: see test_photon_light.py.
QUICK = [
    ("vcm", "glass", VCM),
    ("bre", "colours", BRE),
    ("bre", "wisps", replace(BRE, radius=0.3, photons=64, block=8, references=32)),
]
# Along boundaries that bend nothing, of media within each other, it is too dark by a share that falls like the radius.
SLOW = [
    ("ppm", "sky", PPM),
    ("ppm", "areas", PPM),
    # Liquids in clear and in frosted glass: few photons get there
    ("bre", "milk", replace(BRE, block=8, batches=10)),
    ("ppm", "glass", PPM),
    ("ppm", "points", replace(PPM, by="bdpt")),
    *(("vcm", name, VCM) for name in ("areas", "points", "sky")),
    ("bre", "forward", BRE),
    ("bre", "nested", replace(BRE, radius=0.15, photons=192, block=16)),
]


@pytest.mark.parametrize(("sampler", "name", "image"), cases(QUICK, SLOW))
def test_small_radii_have_the_image_of_paths(renderer, sampler, name, image):
    """All lights, mirrors, glass and media, within what such a radius blurs."""
    image.assert_alike(renderer, sampler, name)


def test_light_that_merging_alone_finds(renderer):
    """As much as ``ppm`` does, where ``bdpt`` is black."""
    ALONE.assert_alike(renderer, "vcm", "seen_through_glass")
    scene = load(renderer, bdpt_scenes.seen_through_glass, (24, 24))
    assert render_ours(scene, "bdpt", 1, 8)[0]["primal"].mean() < 1e-4


@pytest.mark.parametrize(
    ("sampler", "name", "max_depth", "image"),
    [
        # Further emission in glass, and more bounces of photons seen through it
        pytest.param("ppm", "glass", 2, SMALL, marks=pytest.mark.slow),
        ("ppm", "glass", 4, SMALL),
        ("bre", "haze", 2, replace(BRE, radius=0.3, photons=48)),
    ],
)
def test_paths_are_no_longer_than_the_scene_says(renderer, sampler, name, max_depth, image):
    """With two edges light is scattered once, in the medium or on a surface; of one, see ``laws``."""
    image.assert_alike(renderer, sampler, name, max_depth=max_depth)


@pytest.mark.parametrize(
    ("sampler", "name", "size", "photons", "least"),
    cases(
        [("ppm", "diffuse", 32, 4, -0.6)],
        [("bre", "fog", 16, 8, -0.6), ("vcm", "seen_through_glass", 24, None, -0.55)],
    ),
)
def test_it_converges(renderer, sampler, name, size, photons, least):
    """The squared error of the mean falls with passes: noise like n^-α, what is left of the blur like n^(-2/3)."""
    assert convergence(renderer, sampler, name, size, photons) < least


def behind_panes(max_depth):
    """Nothing but a lamp, behind two panes."""
    panes = {f"pane{z}": _wall([0, 0, z], [0, 0, 1], (4, 4), {"type": "thindielectric"}) for z in (1, 2)}
    lamp = {"lamp": _light([0, 0, 0], [0, 0, 1], (4, 4), (1, 1, 1))} | panes
    sensor = {"type": "scene", "sensor": _camera([0, 0, 4], [0, 0, 0], 40)}
    return sensor | {"integrator": {"type": "path", "max_depth": max_depth}} | lamp


def test_a_lamp_behind_two_panes_is_three_edges_away(renderer):
    stacks = [render_stack(load(renderer, behind_panes(depth), (4, 4)), 4, 0, "ppm", unbiased=True) for depth in (2, 3)]
    assert [stack["primal"].any() for stack in stacks] == [False, True]
