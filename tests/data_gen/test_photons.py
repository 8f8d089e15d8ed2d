"""What is particular to photons: the grid, maps, radii, and what their gathering in media is made of."""

from functools import partial

import media_scenes
import numpy as np
import pytest
from bdpt_scenes import SCENES
from data_gen_scenes import _scale
from photon_laws import passes, traced, world_of
from references import REFERENCES, references
from renders import dr, mi
from unbiased import assert_unbiased, load, render_ours

from data_gen.film import GradientFilm
from data_gen.passes import recording
from data_gen.paths.camera import CameraSamples
from data_gen.paths.frozen import Frozen
from data_gen.paths.light_ends import LightEnds
from data_gen.render import render_stack
from data_gen.samplers import find
from data_gen.samplers.photons.map import trace
from data_gen.samplers.photons.map.fog import Fog
from data_gen.samplers.photons.map.grid import Grid
from data_gen.samplers.photons.map.radius import ALPHA, shrunk
from data_gen.samplers.photons.map.vertices import vertex_of
from data_gen.scenes.builtin import _camera, _diffuse, _rgb, _sphere
from ngpt.errors import Interrupted
from ngpt.testing import z_test

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


def entries(photons, *names):
    """Fields of the vertices of a map, and the rows of their parents among them; other places of the map are empty."""
    exists = np.array(photons.t) > 0
    values = [np.array(getattr(photons, name)).T[exists] for name in names]
    row, parent = np.cumsum(exists) - 1, np.array(photons.parent)[exists]
    first = np.array(photons.density)[exists] == 0
    # Parents of those that begin a further map are in the one before.
    known = np.where(first, 0, np.minimum(parent, len(row) - 1))
    return *values, np.where(first, parent, row[known]), first


def test_vertices_know_their_parents(renderer):
    """From the parent a vertex lies along its direction; what the ray met there is found again."""
    world = world_of(load(renderer, SCENES["glass"], (8, 8)))
    start, (photons,) = traced(world)
    p, n, d, t, depth, parent, first = entries(photons, "p", "n", "d", "t", "depth")
    assert 0 < first.sum() <= 4096 and (parent[~first] < np.flatnonzero(~first)).all()
    origin = np.where(first[:, None], np.array(start.ray.o).T[parent * first], p[parent * ~first])
    assert np.abs(origin + d * t[:, None] - p).max() < 1e-3
    known = ~first & (depth > 0) & (depth[parent] > 0)
    assert known.any() and (depth[known] == depth[parent[known]] + 1).all()
    assert (depth == 0).mean() > 0.05  # on glass
    si = vertex_of(photons, renderer.UInt32(np.flatnonzero(np.array(photons.t) > 0)))
    assert np.abs(np.array(si.p).T - p).max() < 1e-4 and np.array(si.is_valid()).all()
    assert ((np.array(si.n).T * n).sum(axis=1) > 0.999).mean() > 0.999


def test_maps_of_many_vertices_are_cut(renderer, monkeypatch):
    """Into some, which have the same photons each once, whose parents are with them."""
    world = world_of(load(renderer, "diffuse", (8, 8)))
    _, (whole,) = traced(world)
    monkeypatch.setattr(trace, "VERTICES_PER_PATH", 2)
    _, parts = traced(world)
    assert len(parts) > 2

    def gathered(part, name):
        value, depth, *_ = entries(part, name, "depth")
        return value[depth > 0]

    for name in ("p", "β", "d"):
        together = np.concatenate([gathered(part, name) for part in parts])
        assert np.allclose(np.sort(together, axis=0), np.sort(gathered(whole, name), axis=0), rtol=1e-3, atol=1e-4)
    for part in parts:
        p, d, t, depth, parent, first = entries(part, "p", "d", "t", "depth")
        some = ~first & (depth > 0)
        assert np.abs(p[parent[some]] + (d * t[:, None] - p)[some]).max(initial=0) < 1e-3


def test_kernels_are_recorded_once_and_make_the_same_bits(renderer, monkeypatch, recordings):
    """As if they were recorded in each pass."""
    scene = load(renderer, "diffuse", (16, 12))

    def rendered(others=()):
        take, film = find("gpm").made(scene), GradientFilm(16, 12, batches=True)
        for i in range(3):
            with recording():
                take(CameraSamples(scene.sensors()[0], 3, 1, i), film)
                film.end_pass(1)
            others = [load(renderer, other, (4, 4)) for other in others] if i == 0 else []
        return film.develop()

    layers = rendered()
    # A function is recorded again where two arrays happen to be of one size, or of size 1.
    assert len(recordings.of) > 8 and recordings.total() <= len(recordings.of) + 2
    # Other scenes come and go.
    with_others = rendered([SCENES["areas"]])
    monkeypatch.setattr(Frozen, "__call__", lambda self, f, *args: f(*args))
    anew = rendered()
    assert layers.keys() == anew.keys()
    for name in layers:
        assert np.array_equal(layers[name], anew[name]) and np.array_equal(layers[name], with_others[name]), name


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
    ways = Fog(scene, scene.sensors()[0], LightEnds(scene), "vpm")
    # Outside of all, in the cloud, in its core, and behind the wall at the back
    points = np.array([[0.9, 0.9, 0.9], [0.5, -0.5, 0.5], [-0.2, 0.2, 0.1], [0.2, 0.1, -3.0]])
    found = np.array(dr.reinterpret_array(mi.UInt32, ways.around(scene, mi.Point3f(points.T))))
    camera = int(dr.reinterpret_array(mi.UInt32, ways.within)[0])
    assert (found == camera).tolist() == [True, False, False, True] and found[1] != found[2] and found.all()


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
@pytest.mark.parametrize("name", ["vpm", "bre"])
def test_lamps_and_skies_behind_grids_are_seen(renderer, name):
    """Paths of one edge, before any photon, carry the light that comes through, as ``volpath`` has it."""
    ours = render_ours(load(renderer, media_scenes.seen_through, (16, 16)), name, batches=8, spp=12)
    expected = references(renderer, media_scenes.seen_through, (16, 16))
    assert_unbiased([{"primal": stack["primal"]} for stack in ours], expected)


def test_boundaries_within_one_medium_change_nothing(renderer):
    """The ray is cut there into two pieces, which gather each photon once."""

    def crossed():
        air = {"type": "ref", "id": "air"}
        cube = {"type": "cube", "to_world": _scale(0.7), "bsdf": {"type": "null"}, "interior": air, "exterior": air}
        return media_scenes.haze() | {"cube": cube}

    whole, cut = (
        passes(load(renderer, scene, (16, 16)), 3, 1, "bre", radius=1.0, photons=8)
        for scene in (media_scenes.haze, crossed)
    )
    whole, cut = (np.mean([stack["primal"] for stack in stacks], axis=0) for stacks in (whole, cut))
    # What lies in front of the same photons; the lamp's rays pass another surface, and end in the last bits elsewhere.
    assert np.abs(whole - cut).mean() < 0.02 * whole.mean()


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
