"""Images of the studies of photons in media: of balls, beams and planes. Most is slow."""

from dataclasses import replace
from functools import partial

import media_scenes
import numpy as np
import pytest
from photon_images import IN_MEDIA, cases, convergence
from photon_laws import assert_lamps_behind_grids_are_seen, passes
from references import REFERENCES, references
from unbiased import load, render_ours

from data_gen.render import render_stack
from data_gen.scenes.builtin import _camera, _diffuse, _rgb, _sphere
from ngpt.testing import z_test

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
@pytest.mark.parametrize(("sampler", "photons", "least"), [("vpm", 16, -4 / 9), ("beams", 2, -0.6)])
def test_it_converges(renderer, sampler, photons, least):
    """What is left of the blur falls like n^(-2/3), of balls like n^(-4/9)."""
    assert convergence(renderer, sampler, "fog", 16, photons) < least


@pytest.mark.parametrize(
    ("better", "worse", "radius", "photons", "times"),
    cases([("bre", "vpm", 1.0, 4, 5)], [("beams", "bre", 0.5, 2, 2)]),
)
def test_they_have_less_noise_than_points(renderer, better, worse, radius, photons, times):
    """The noise of the same light paths, in thin fog; ``bre`` was measured to have 25 times less than ``vpm``."""
    scene = load(renderer, media_scenes.haze, (16, 16))
    noise = []
    for name in (better, worse):
        stacks = passes(scene, 5, 1, name, radius=radius, photons=photons)
        noise.append(np.stack([stack["primal"] for stack in stacks]).var(axis=0, ddof=1).mean())
    assert noise[0] < noise[1] / times


@pytest.mark.slow
def test_what_is_lost_along_the_edges_of_grids_falls_like_the_radius(renderer):
    """So twice the image of half the radius, less the image of the radius, is the image of ``volpath``."""
    scene = load(renderer, media_scenes.smoke, (16, 16))
    theirs = [image.mean() for image in references(renderer, media_scenes.smoke, (16, 16))]
    wide, narrow = (
        [s["primal"].mean() for s in render_ours(scene, "vpm", 32, 1, seed=seed, photons=128, radius=radius)]
        for seed, radius in ((0, 0.4), (100, 0.2))
    )
    off = 2 * np.mean(narrow) - np.mean(wide) - np.mean(theirs)
    error = np.sqrt((4 * np.var(narrow) + np.var(wide)) / 31 + np.var(theirs) / (len(theirs) - 1))
    assert abs(off) < 4 * error and error < 0.03 * np.mean(theirs), (off, error)
    assert np.mean(theirs) - np.mean(wide) > 2 * error


@pytest.mark.slow
def test_lamps_and_skies_behind_grids_are_seen(renderer):
    """Paths of one edge, before any photon, carry the light that comes through, as ``volpath`` has it."""
    assert_lamps_behind_grids_are_seen(renderer, "vpm")


# ------------------------- Beams and planes -------------------------


@pytest.mark.slow
def test_beams_are_cut_the_same_in_windows(renderer, monkeypatch):
    """All parts at once, or few at a time: the same light."""
    from ngpt_studies.photons.media import beams

    scene = load(renderer, media_scenes.haze, (8, 8))
    whole = render_stack(scene, 2, 0, "beams", photons=4, unbiased=True)["primal"]
    monkeypatch.setattr(beams, "PARTS", 1)
    assert np.allclose(render_stack(scene, 2, 0, "beams", photons=4, unbiased=True)["primal"], whole, rtol=1e-4)


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


@pytest.mark.slow
def test_light_by_planes_has_no_bias(renderer, planes_alone):
    """Through boundaries, past what is in the way, with extinctions of each colour; some of the light paths swept."""
    scene = load(renderer, black_room, (16, 16))
    ours = render_ours(scene, "planes", batches=8, spp=4, photons=2, planes=128)
    # Of all paths but those of two edges
    long, short = (
        render_ours(
            load(renderer, partial(black_room, depth), (16, 16)), "primal", 16, 128, seed=REFERENCES + 100 * depth
        )
        for depth in (6, 2)
    )
    expected = np.stack([a["primal"] - b["primal"] for a, b in zip(long, short, strict=True)])
    assert expected.mean() > 0.03
    result = z_test(np.stack([stack["primal"] for stack in ours]), expected, block=4)
    assert result.passed, result


def test_paths_of_planes_are_no_longer_than_the_scene_says(renderer, planes_alone):
    """A plane and the way to the camera are three edges."""
    scenes = [load(renderer, partial(black_room, depth), (8, 8)) for depth in (2, 3)]
    light = [render_stack(scene, 1, 0, "planes", unbiased=True)["primal"].sum() for scene in scenes]
    assert light[0] == 0 < light[1]
