"""What is particular to photons: the grid, maps, radii, and what their gathering in media is made of."""

from functools import partial

import media_scenes
import numpy as np
import pytest
from data_gen_scenes import _scale
from photon_laws import (
    assert_lamps_behind_grids_are_seen,
    assert_recorded_once,
    traced,
    world_of,
)
from renders import dr, mi
from unbiased import load, render_ours

from data_gen.paths.light_ends import LightEnds
from data_gen.samplers import find
from data_gen.samplers.photons.map import trace
from data_gen.samplers.photons.map.fog import Fog
from data_gen.samplers.photons.map.grid import Grid
from data_gen.samplers.photons.map.radius import ALPHA, shrunk
from ngpt.errors import Interrupted

# ------------------------- The grid -------------------------


@pytest.fixture
def points(renderer):
    """Points in a flat box, which of them exist, and what numbers those that are found are added up to."""
    rng = np.random.default_rng(0)
    points = (rng.random((3000, 3)) * [2, 1, 0.2] - [1, 0, 0]).astype(np.float32)
    exist, numbers = rng.random(3000) < 0.8, renderer.UInt32(np.arange(1, 3001))

    def number(grid, i, near):
        j = dr.gather(renderer.UInt32, grid.index, i, near)
        return dr.select(near, dr.gather(renderer.UInt32, numbers, j, near), 0)

    return rng, points, exist, number


@pytest.mark.parametrize("radius", [0.3, 0.05, 0.004])
def test_the_grid_finds_what_brute_force_finds(renderer, points, radius):
    """Each once, on and beyond the box too; with the least radius cells are larger than they need be."""
    mi, (rng, points, exist, number) = renderer, points
    around = points[:600] + rng.normal(size=(600, 3)) * radius
    queries = np.concatenate([around, rng.random((100, 3)) * 6 - 3, points[:9]]).astype(np.float32)
    grid = Grid(mi.Point3f(points.T), mi.Bool(exist), radius)
    assert grid.edge[0] >= 2 * radius and (radius > 0.01 or grid.edge[0] > 3 * radius)
    active, none = np.arange(len(queries)) % 7 != 0, mi.UInt32(np.zeros(len(queries)))
    near = partial(number, grid)
    found = np.array(grid.gather(mi.Point3f(queries.T), mi.Float(radius**2), mi.Bool(active), near, none))
    near = ((queries[:, None] - points) ** 2).sum(axis=-1) < radius**2
    assert np.array_equal(found, (near & exist & active[:, None]) @ np.arange(1, 3001)) and near.sum() > 100


@pytest.mark.parametrize("radius", [0.3, 0.05, 0.01])
def test_the_grid_finds_what_is_beside_a_ray(renderer, points, radius):
    """Each point once, whatever its cell, on and beyond the box too; rays without end are cut at the box."""
    from data_gen.samplers.photons.bre import BALL

    mi, (rng, points, exist, number) = renderer, points
    grid = Grid(mi.Point3f(points.T), mi.Bool(exist), BALL * radius)
    o = (rng.random((500, 3)) * [4, 2, 1] - [2, 0.5, 0.5]).astype(np.float32)
    d = rng.normal(size=(500, 3)).astype(np.float32)
    d[:9], d[9:18] = [0, 0, 1], [-1, 0, 0]
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    length = np.where(rng.random(500) < 0.3, np.inf, rng.random(500) * 2).astype(np.float32)
    active = np.arange(500) % 7 != 0

    def add(sums, i, near):
        return (sums[0] + number(grid, i, near),)

    ray, none = mi.Ray3f(mi.Point3f(o.T), mi.Vector3f(d.T)), mi.UInt32(np.zeros(500))
    (found,) = grid.along(ray, mi.Float(length), mi.Float(radius**2), mi.Bool(active), add, (none,))
    to = points[None] - o[:, None]
    t = (to * d[:, None]).sum(axis=-1)
    aside = np.linalg.norm(to - t[..., None] * d[:, None], axis=-1)

    def total(margin):
        near = (aside < radius * (1 + margin)) & (t > -margin) & (t < length[:, None] + margin)
        return (near & exist & active[:, None]) @ np.arange(1, 3001)

    # What is on the edge may be rounded to either side.
    low, high, found = total(-1e-4), total(1e-4), np.array(found)
    assert ((low <= found) & (found <= high)).all() and (low > 0).sum() > 20 and (low == high).mean() > 0.9


# ------------------------- Maps -------------------------


def test_maps_of_many_vertices_are_cut(renderer, monkeypatch):
    """Into some, which have the same photons each once."""
    world = world_of(load(renderer, "diffuse", (8, 8)))
    (whole,) = traced(world)
    monkeypatch.setattr(trace, "VERTICES_PER_PATH", 2)
    parts = traced(world)
    assert len(parts) > 2
    for name in ("p", "β", "d"):
        together = np.concatenate([gathered(part, name) for part in parts])
        assert np.allclose(np.sort(together, axis=0), np.sort(gathered(whole, name), axis=0), rtol=1e-3, atol=1e-4)


def gathered(photons, name):
    return np.array(getattr(photons, name)).T[np.array(photons.depth) > 0]


def test_kernels_are_recorded_once_and_make_the_same_bits(renderer, monkeypatch, recordings):
    assert_recorded_once(renderer, monkeypatch, recordings, "ppm", least=3)


@pytest.mark.parametrize("kind", [KeyboardInterrupt, Interrupted])
def test_an_interrupt_while_a_plugin_is_made_is_one(renderer, monkeypatch, kind):
    """Mitsuba makes a text of what a plugin raises."""
    from data_gen.samplers.photons.ppm import PPM

    def interrupted(self, props):
        raise kind

    scene = load(renderer, "diffuse", (4, 4))
    monkeypatch.setattr(PPM, "__init__", interrupted)
    with pytest.raises(KeyboardInterrupt):
        find("ppm").made(scene)


def test_radii_shrink_as_told():
    """On surfaces by area, in media by volume."""
    r2 = 1.0
    for i in range(50):
        assert shrunk(i) == pytest.approx(r2**0.5, rel=1e-9) and shrunk(i, 3) == pytest.approx(r2 ** (1 / 3), rel=1e-9)
        r2 *= (i + 1 + ALPHA) / (i + 2)
    assert shrunk(10**8) ** 2 == pytest.approx(shrunk(10**5) ** 2 * 1e3 ** (ALPHA - 1), rel=1e-3)


# ------------------------- Gathering in media -------------------------


def test_the_medium_around_a_lamp_is_found(renderer):
    """Behind walls too, and on either side of a boundary."""
    scene = load(mi, media_scenes.nested, (8, 8))
    ways = Fog(scene, scene.sensors()[0], LightEnds(scene), "bre")
    # Outside of all, in the cloud, in its core, and behind the wall at the back
    points = np.array([[0.9, 0.9, 0.9], [0.5, -0.5, 0.5], [-0.2, 0.2, 0.1], [0.2, 0.1, -3.0]])
    found = np.array(dr.reinterpret_array(mi.UInt32, ways.around(scene, mi.Point3f(points.T))))
    camera = int(dr.reinterpret_array(mi.UInt32, ways.within)[0])
    assert (found == camera).tolist() == [True, False, False, True] and found[1] != found[2] and found.all()


@pytest.mark.slow
def test_lamps_and_skies_behind_grids_are_seen(renderer):
    """Paths of one edge, before any photon, carry the light that comes through, as ``volpath`` has it."""
    assert_lamps_behind_grids_are_seen(renderer, "bre")


def test_boundaries_within_one_medium_change_nothing(renderer):
    """The ray is cut there into two pieces, which gather each photon once."""

    def crossed():
        air = {"type": "ref", "id": "air"}
        cube = {"type": "cube", "to_world": _scale(0.7), "bsdf": {"type": "null"}, "interior": air, "exterior": air}
        return media_scenes.haze() | {"cube": cube}

    whole, cut = (
        render_ours(load(renderer, scene, (16, 16)), "bre", 3, 1, radius=1.0, photons=8)
        for scene in (media_scenes.haze, crossed)
    )
    whole, cut = (np.mean([stack["primal"] for stack in stacks], axis=0) for stacks in (whole, cut))
    # What lies in front of the same photons; the lamp's rays pass another surface, and end in the last bits elsewhere.
    assert np.abs(whole - cut).mean() < 0.02 * whole.mean()
