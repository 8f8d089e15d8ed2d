"""Images of the studies of photons in media: of balls, beams and planes. Most is slow."""

from dataclasses import replace
from functools import partial

import pytest
from photon_images import IN_MEDIA
from photon_laws import assert_lamps_behind_grids_are_seen
from unbiased import load

from data_gen.render import render_stack
from data_gen.scenes.builtin import _camera, _diffuse, _rgb, _sphere

VPM = replace(IN_MEDIA, photons=128, batches=8)
PLANES = replace(IN_MEDIA, options={"planes": 512})

# Along boundaries that bend nothing, of media within each other, it is too dark by a share that falls like the radius.
IMAGES = [
    # Grids that fade: their density is not blurred
    ("vpm", "wisps", replace(VPM, radius=0.6, photons=40, references=32)),
    *(("vpm", name, VPM) for name in ("haze", "forward", "colours", "milk")),
    ("vpm", "nested", replace(VPM, radius=0.2, photons=256, block=16)),
    *(("beams", name, IN_MEDIA) for name in ("colours", "haze", "forward", "dense", "fog")),
    ("beams", "milk", replace(IN_MEDIA, block=8)),
    ("beams", "nested", replace(IN_MEDIA, block=16)),
    ("beams", "wisps", replace(IN_MEDIA, radius=0.3, block=8)),
    *(("planes", name, PLANES) for name in ("colours", "haze", "dense", "fog")),
    *(("planes", name, replace(PLANES, block=16)) for name in ("forward", "nested")),
    ("planes", "milk", replace(PLANES, block=8)),
]


@pytest.mark.slow
@pytest.mark.parametrize(("sampler", "name", "image"), IMAGES)
def test_small_radii_have_the_image_of_paths(renderer, sampler, name, image):
    image.assert_alike(renderer, sampler, name)


@pytest.mark.slow
@pytest.mark.parametrize(("sampler", "max_depth", "image"), [("vpm", 2, VPM), ("vpm", 3, VPM), ("beams", 2, IN_MEDIA)])
def test_paths_are_no_longer_than_the_scene_says(renderer, sampler, max_depth, image):
    """With two edges light is scattered once, in the medium or on a surface."""
    image.assert_alike(renderer, sampler, "haze", max_depth=max_depth)


@pytest.mark.slow
def test_lamps_and_skies_behind_grids_are_seen(renderer):
    """Paths of one edge, before any photon, carry the light that comes through, as ``volpath`` has it."""
    assert_lamps_behind_grids_are_seen(renderer, "vpm")


# ------------------------- Beams and planes -------------------------


def black_room(max_depth=6):
    """A lamp in a medium around a denser one, and a black ball, within black walls.

    What a lamp sends into media is swept by one edge, all else by planes.
    """
    mist = {"type": "ref", "id": "air"}
    core = {"type": "homogeneous", "albedo": _rgb(0.9, 0.7, 0.8), "sigma_t": _rgb(0.6, 0.4, 0.5), "scale": 3.0}
    air = {"type": "homogeneous", "albedo": _rgb(0.9, 0.8, 0.7), "sigma_t": _rgb(0.3, 0.5, 0.7)}
    return {
        "type": "scene",
        "air": {"id": "air", "phase": {"type": "hg", "g": 0.4}} | air,
        "integrator": {"type": "volpath", "max_depth": max_depth, "rr_depth": 4},
        "sensor": _camera([0, 0, 3], [0, 0, 0], 40) | {"medium": mist},
        "lamp": {"type": "point", "position": [0.5, 0.8, -0.5], "intensity": _rgb(5, 5, 5)},
        "core": _sphere([-0.3, 0.0, 0.1], 0.5, {"type": "null"}) | {"interior": core, "exterior": mist},
        "ball": _sphere([0.5, 0.3, 0.2], 0.3, _diffuse(0, 0, 0)),
        "walls": _sphere([0.0, 0.0, 0.0], 3.5, _diffuse(0, 0, 0)),
    }


@pytest.fixture
def planes_alone(monkeypatch):
    from ngpt_studies.photons.media.beams import BEAMS

    monkeypatch.setattr(BEAMS, "near", lambda *_: iter(()))


def test_paths_of_planes_are_no_longer_than_the_scene_says(renderer, planes_alone):
    """A plane and the way to the camera are three edges."""
    scenes = [load(renderer, partial(black_room, depth), (8, 8)) for depth in (2, 3)]
    light = [render_stack(scene, 1, 0, "planes", unbiased=True)["primal"].sum() for scene in scenes]
    assert light[0] == 0 < light[1]
