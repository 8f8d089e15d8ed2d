"""How photons are gathered in media: balls (``vpm``), rays (``bre``), beams and planes; where light begins there."""

from functools import partial

import media_scenes
import numpy as np
import pytest
from data_gen_scenes import _scale
from references import references
from unbiased import REFERENCES, assert_unbiased, load, render_ours

from data_gen.scenes.builtin import _camera, _diffuse, _rgb, _sphere
from ngpt.testing import z_test

# ------------------------- vpm -------------------------


@pytest.mark.slow
def test_what_is_lost_along_the_edges_of_grids_falls_like_the_radius(renderer):
    """So twice the image of half the radius, less the image of the radius, is that of ``volpath``."""
    scene = load(renderer, media_scenes.smoke, (16, 16))
    theirs = [s["primal"].mean() for s in render_ours(scene, "primal", batches=16, spp=128)]
    wide, narrow = (
        [s["primal"].mean() for s in render_ours(scene, "vpm", 16, 1, seed=seed, photons=128, radius=radius)]
        for seed, radius in ((0, 0.4), (100, 0.2))
    )
    off = 2 * np.mean(narrow) - np.mean(wide) - np.mean(theirs)
    error = np.sqrt((4 * np.var(narrow) + np.var(wide) + np.var(theirs)) / 15)
    assert abs(off) < 4 * error and error < 0.03 * np.mean(theirs), (off, error)
    assert np.mean(theirs) - np.mean(wide) > 2 * error


@pytest.mark.slow
@pytest.mark.parametrize("name", ["vpm", "bre"])
def test_lamps_and_skies_behind_grids_are_seen(renderer, name):
    """Of paths of one edge, before any photon: the light that comes through, as ``volpath`` has it."""

    ours = render_ours(load(renderer, media_scenes.seen_through, (16, 16)), name, batches=8, spp=12)
    expected = references(renderer, media_scenes.seen_through, (16, 16))
    assert_unbiased([{"primal": stack["primal"]} for stack in ours], expected)


def test_radii_in_media_shrink_by_volume():
    from data_gen.samplers.photons.map.radius import shrunk

    for i in (0, 1, 7, 100):
        assert shrunk(i, 3) ** 3 == pytest.approx(shrunk(i) ** 2, rel=1e-9)


def test_the_medium_around_a_lamp_is_found(renderer):
    """Behind walls too, and on either side of a boundary."""
    import drjit as dr

    from data_gen.paths.light_ends import LightEnds
    from data_gen.samplers.photons.map.fog import Fog

    mi = renderer
    scene = load(mi, media_scenes.nested, (8, 8))
    ways = Fog(scene, scene.sensors()[0], LightEnds(scene), "vpm")
    # Outside of all, in the cloud, in its core, and behind the wall at the back
    points = np.array([[0.9, 0.9, 0.9], [0.5, -0.5, 0.5], [-0.2, 0.2, 0.1], [0.2, 0.1, -3.0]])
    found = np.array(dr.reinterpret_array(mi.UInt32, ways.around(scene, mi.Point3f(points.T))))
    camera = int(dr.reinterpret_array(mi.UInt32, ways.within)[0])
    assert (found == camera).tolist() == [True, False, False, True] and found[1] != found[2] and found.all()


def test_a_report_on_grids_names_the_sampler_of_photons(renderer):
    from data_gen.inspect import inspect_scene

    smoke, haze = ("\n".join(inspect_scene(name)["plan"]) for name in ("smoke", "haze"))
    assert "media whose density varies: photons are gathered in them by `--sampler bre`\n" in smoke
    assert "density varies" not in haze


# ------------------------- bre -------------------------


def test_boundaries_within_one_medium_change_nothing(renderer):
    """The ray is cut there into two pieces, which gather each photon once."""

    def crossed():
        air = {"type": "ref", "id": "air"}
        cube = {"type": "cube", "to_world": _scale(0.7), "bsdf": {"type": "null"}, "interior": air, "exterior": air}
        return media_scenes.haze() | {"cube": cube}

    images = []
    for scene in (media_scenes.haze, crossed):
        images.append(render_ours(load(renderer, scene, (16, 16)), "bre", 1, 3, radius=1.0, photons=8)[0]["primal"])
    # What lies in front of the same photons; the lamp's rays pass another surface, and end in the last bits elsewhere.
    assert np.abs(images[0] - images[1]).mean() < 0.02 * images[0].mean()


@pytest.mark.parametrize("radius", [0.3, 0.05, 0.01])
def test_the_grid_finds_what_is_beside_a_ray(renderer, radius):
    """Each point once, whatever its cell, on and beyond the box too; rays without end are cut at the box."""
    import drjit as dr

    from data_gen.samplers.photons.map.grid import Grid
    from data_gen.samplers.photons.media.bre import BALL

    mi, rng = renderer, np.random.default_rng(0)
    points = (rng.random((3000, 3)) * [2, 1, 0.2] - [1, 0, 0]).astype(np.float32)
    exist = rng.random(3000) < 0.8
    grid = Grid(mi.Point3f(points.T), mi.Bool(exist), BALL * radius)
    o = (rng.random((500, 3)) * [4, 2, 1] - [2, 0.5, 0.5]).astype(np.float32)
    d = rng.normal(size=(500, 3)).astype(np.float32)
    d[:9], d[9:18] = [0, 0, 1], [-1, 0, 0]
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    length = np.where(rng.random(500) < 0.3, np.inf, rng.random(500) * 2).astype(np.float32)
    active = np.arange(500) % 7 != 0
    numbers = mi.UInt32(np.arange(1, 3001))

    def add(sums, i, near):
        j = dr.gather(mi.UInt32, grid.index, i, near)
        return (sums[0] + dr.select(near, dr.gather(mi.UInt32, numbers, j, near), 0),)

    ray = mi.Ray3f(mi.Point3f(o.T), mi.Vector3f(d.T))
    found = grid.along(ray, mi.Float(length), mi.Float(radius**2), mi.Bool(active), add, (dr.zeros(mi.UInt32, 500),))
    to = points[None] - o[:, None]
    t = (to * d[:, None]).sum(axis=-1)
    aside = np.linalg.norm(to - t[..., None] * d[:, None], axis=-1)

    def total(margin):
        near = (aside < radius * (1 + margin)) & (t > -margin) & (t < length[:, None] + margin)
        return (near & exist & active[:, None]) @ np.arange(1, 3001)

    # What is on the edge may be rounded to either side.
    low, high, found = total(-1e-4), total(1e-4), np.array(found[0])
    assert ((low <= found) & (found <= high)).all() and (low > 0).sum() > 20 and (low == high).mean() > 0.9


# ------------------------- beams -------------------------


def test_lines_are_nearest(renderer):
    """Against the least distance of many pairs of points."""
    import drjit as dr

    from data_gen.samplers.photons.media.beams import nearest

    mi, rng = renderer, np.random.default_rng(0)
    o, p = rng.normal(size=(2, 3, 200)) * 0.3
    d, e = rng.normal(size=(2, 3, 200))
    d, e = d / np.linalg.norm(d, axis=0), e / np.linalg.norm(e, axis=0)
    s, t, aside, sin = (np.array(x) for x in nearest(mi.Point3f(o), mi.Vector3f(d), mi.Point3f(p), mi.Vector3f(e)))
    known = sin > 0.1
    assert np.allclose(sin, np.sqrt(1 - (d * e).sum(axis=0) ** 2), atol=1e-4) and known.sum() > 150

    def apart(s, t):
        return np.linalg.norm(o + d * t - p - e * s, axis=0)

    assert np.allclose(apart(s, t)[known], aside[known], atol=1e-4)
    for i, j in ((1, 0), (0, 1), (1, 1), (-1, 1)):
        assert (apart(s + 0.01 * i, t + 0.01 * j) > aside - 1e-5)[known].all()
    assert dr.width(mi.Float(s)) == 200


@pytest.mark.slow
def test_beams_are_cut_the_same_in_windows(renderer, monkeypatch):
    """All parts at once, or few at a time: the same light."""
    from data_gen.render import render_stack
    from data_gen.samplers.photons.media import beams

    scene = load(renderer, media_scenes.haze, (8, 8))
    whole = render_stack(scene, 2, 0, "beams", photons=4)["primal"]
    monkeypatch.setattr(beams, "PARTS", 1)
    assert np.allclose(render_stack(scene, 2, 0, "beams", photons=4)["primal"], whole, rtol=1e-4)


# ------------------------- planes -------------------------


def test_lines_meet_planes(renderer):
    """By the coordinates that the place has on the plane and on the line; the volume by numpy."""
    from data_gen.samplers.photons.media.planes import crossing

    mi, rng = renderer, np.random.default_rng(0)
    a, o, d, e, w = rng.normal(size=(5, 3, 200))
    d, e, w = (v / np.linalg.norm(v, axis=0) for v in (d, e, w))
    at = crossing(mi.Point3f(a), mi.Vector3f(d), mi.Vector3f(e), mi.Point3f(o), mi.Vector3f(w))
    s, t, u, volume = (np.array(x, np.float64) for x in (at.s, at.t, at.u, at.volume))
    told = np.linalg.det(np.stack([d, e, w]).transpose(2, 0, 1))
    assert np.allclose(volume, told, atol=1e-5)
    known = np.abs(told) > 0.05
    assert known.sum() > 150 and np.allclose((a + d * s + e * t)[:, known], (o + w * u)[:, known], atol=1e-3)


def black_room(max_depth=6):
    """A lamp in a medium around a denser one, and a black ball, within black walls.

    What a lamp sends into media is swept by one edge, all else by planes.
    """
    mist = {"type": "ref", "id": "air"}
    core = {"type": "homogeneous", "albedo": _rgb(0.9, 0.7, 0.8), "sigma_t": _rgb(0.6, 0.4, 0.5), "scale": 3.0}
    return {
        "type": "scene",
        "air": {
            "type": "homogeneous",
            "id": "air",
            "albedo": _rgb(0.9, 0.8, 0.7),
            "sigma_t": _rgb(0.3, 0.5, 0.7),
            "phase": {"type": "hg", "g": 0.4},
        },
        "integrator": {"type": "volpath", "max_depth": max_depth, "rr_depth": 4},
        "sensor": _camera([0, 0, 3], [0, 0, 0], 40) | {"medium": mist},
        "lamp": {"type": "point", "position": [0.5, 0.8, -0.5], "intensity": _rgb(5, 5, 5)},
        "core": _sphere([-0.3, 0.0, 0.1], 0.5, {"type": "null"}) | {"interior": core, "exterior": mist},
        "ball": _sphere([0.5, 0.3, 0.2], 0.3, _diffuse(0, 0, 0)),
        "walls": _sphere([0.0, 0.0, 0.0], 3.5, _diffuse(0, 0, 0)),
    }


def light_of_planes(renderer, monkeypatch, spp=4, batches=8, **options):
    """(light by planes alone, that of all paths but those of two edges), images of the same shape."""
    from data_gen.samplers.photons.media.beams import BEAMS

    monkeypatch.setattr(BEAMS, "near", lambda *_: iter(()))
    ours = render_ours(load(renderer, black_room, (16, 16)), "planes", batches=batches, spp=spp, photons=2, **options)
    long, short = (
        render_ours(
            load(renderer, partial(black_room, depth), (16, 16)), "primal", 16, 128, seed=REFERENCES + 100 * depth
        )
        for depth in (6, 2)
    )
    references = [a["primal"] - b["primal"] for a, b in zip(long, short, strict=True)]
    return np.stack([stack["primal"] for stack in ours]), np.stack(references)


@pytest.mark.slow
def test_light_by_planes_has_no_bias(renderer, monkeypatch):
    """Through boundaries, past what is in the way, with extinctions of each colour; some of the light paths swept."""
    ours, references = light_of_planes(renderer, monkeypatch, planes=128)
    assert references.mean() > 0.05
    result = z_test(ours, references, block=4)
    assert result.passed, result


def test_paths_of_planes_are_no_longer_than_the_scene_says(renderer, monkeypatch):
    """A plane and the way to the camera are three edges."""
    from data_gen.render import render_stack
    from data_gen.samplers.photons.media.beams import BEAMS

    monkeypatch.setattr(BEAMS, "near", lambda *_: iter(()))
    scenes = [load(renderer, partial(black_room, depth), (8, 8)) for depth in (2, 3)]
    light = [render_stack(scene, 1, 0, "planes")["primal"].sum() for scene in scenes]
    assert light[0] == 0 < light[1]
