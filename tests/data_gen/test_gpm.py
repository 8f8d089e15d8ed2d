"""What is particular to ``gpm``: how photons are copied, and its differences against those of its own images."""

from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest
from bdpt_scenes import SCENES
from photon_laws import assert_no_bias, gain, joined, largest, maps_of, passes
from unbiased import far_shifts, load, render_ours


@pytest.fixture(scope="module")
def geometry(renderer):
    """Predecessors, directions, and tangent planes at x and y, at random and in double precision."""
    import drjit as dr
    from drjit.llvm import Array3f64 as Vector

    rng, n = np.random.default_rng(5), 2000

    def unit(*mean):
        v = rng.normal(size=(3, n)) + np.array(mean)[:, None]
        return Vector(v / np.linalg.norm(v, axis=0))

    x = Vector(rng.normal(size=(3, n)) * 0.2)
    d = unit(0, 0, -1)
    return SimpleNamespace(
        dr=dr,
        Vector=Vector,
        x=x,
        y=Vector(x + rng.normal(size=(3, n)) * 0.3),
        n=unit(0, 0, 2),
        m=unit(0, 0, 2),
        d=d,
        b=Vector(x + rng.normal(size=(3, n)) * 0.1),
        length=rng.uniform(1, 4, n),
    )


def test_places_go_to_and_fro(geometry):
    """The image of a place is as far from y as the place is from x, lies in the plane at y, and goes back."""
    from data_gen.samplers.photons.gradients.shift import moved, on_plane

    g, dr = geometry, geometry.dr
    b = on_plane(g.b, g.d, g.x, g.n)
    c = moved(b, g.x, g.n, g.y, g.m)
    scale = 1 + np.array(dr.norm(b - g.x))
    assert largest(dr.dot(c - g.y, g.m) / scale) < 1e-9
    assert largest((dr.norm(c - g.y) - dr.norm(b - g.x)) / scale) < 1e-9
    assert largest(dr.norm(moved(c, g.y, g.m, g.x, g.n) - b) / scale) < 1e-9
    # Whichever way the normals point
    assert largest(dr.norm(moved(b, g.x, -g.n, g.y, g.m) - c) / scale) < 1e-9


def test_places_near_to_one_point_go_where_only_the_other_is_near(geometry):
    """In one plane the image is as far from x as the place is from y."""
    from data_gen.samplers.photons.gradients.shift import moved

    g, dr = geometry, geometry.dr
    flat = g.Vector(0, 0, 1)
    x, y, b = (g.Vector(v.x, v.y, 0) for v in (g.x, g.y, g.b))
    c = moved(b, x, flat, y, flat)
    assert largest(dr.norm(c - x) - dr.norm(b - y)) < 1e-12


@pytest.mark.parametrize("far", [False, True])
def test_jacobian_by_finite_differences(geometry, far):
    """Of directions from the predecessor; of light from infinity, of origins on a plane across the light."""
    from data_gen.samplers.photons.gradients.shift import jacobian, moved, on_plane

    g, dr = geometry, geometry.dr
    a = g.b - g.d * g.Vector(*[g.length] * 3)
    s = dr.normalize(dr.cross(g.d, g.Vector(0.3, 0.9, 0.1)))
    t = dr.cross(g.d, s)

    def copied(i, j):
        """(direction or origin, J) of what is i and j along s and t aside."""
        origin, d = (a + s * i + t * j, g.d) if far else (a, dr.normalize(g.d + s * i + t * j))
        b = on_plane(origin, d, g.x, g.n)
        c = moved(b, g.x, g.n, g.y, g.m)
        if far:
            return c - d * dr.dot(c, d), jacobian(d, g.n, 1, d, g.m, 1)
        to = c - a
        d1 = dr.normalize(to)
        return d1, jacobian(d, g.n, dr.squared_norm(b - a), d1, g.m, dr.squared_norm(to))

    h = 1e-5
    columns = [(copied(h * i, h * j)[0] - copied(-h * i, -h * j)[0]) / (2 * h) for i, j in ((1, 0), (0, 1))]
    measured = np.array(dr.norm(dr.cross(*columns)))
    told = np.array(copied(0, 0)[1])
    # Lines along a plane meet it anywhere.
    good = (np.abs(np.array(dr.dot(g.d, g.n))) > 0.1) & (told > 1e-3) & (told < 1e3)
    assert good.sum() > 1000 and np.abs(measured / told - 1)[good].max() < 1e-5


@pytest.mark.parametrize("name", ["areas", "sky", "points", "glossy"])
def test_copies_of_photons_are_light_paths_and_their_copies_are_the_photons(renderer, name):
    """By the densities and throughputs of the copy itself, evaluated anew: r(T(x)) r(x) = 1, and T(T(x)) = x."""
    import drjit as dr
    from scipy.spatial import cKDTree

    from data_gen.paths.light_ends import LightEnds, LightRay
    from data_gen.paths.vertex import Materials
    from data_gen.paths.world import World
    from data_gen.samplers.bdpt.vertex import IMPORTANCE, evaluate
    from data_gen.samplers.photons.gradients.copies import LightPaths, copy, start_of
    from data_gen.samplers.photons.map.photon import Photon, is_near, photon_of
    from data_gen.samplers.photons.map.vertices import vertex_of

    mi = renderer
    scene = load(mi, SCENES[name], (8, 8))
    starts, (photons,) = maps_of(mi, scene, 1 << 14)
    lights = LightEnds(scene)
    world = World(scene, lights, Materials(scene, 0.05))
    # Points where photons are gathered: beside photons, on the surfaces where other photons are.
    some = np.flatnonzero((np.array(photons.depth) > 0) & np.isfinite(np.array(photons.density)))
    rng = np.random.default_rng(0)
    p = np.array(photons.p).T
    distances, near = cKDTree(p[some]).query(p[some], k=9)
    radius = np.median(distances[:, 6])
    place = rng.permutation(len(some))[:4000]
    j, beside, other = (some[near[place, k]] for k in (0, 2, 8))
    j, x, y = mi.UInt32(j), vertex_of(photons, mi.UInt32(beside)), vertex_of(photons, mi.UInt32(other))
    photon, r2 = photon_of(photons, j), mi.Float(radius**2)
    moved, r, good = copy(world, LightPaths(starts, photons), photon, (x, y), r2, ~is_near(photon, y, r2))

    # The copy as a photon of its own, with what its predecessor has to say of it
    parent, first = dr.gather(mi.UInt32, photons.parent, j), dr.gather(mi.Float, photons.density, j) == 0
    a = vertex_of(photons, parent, ~first)
    _, density, _ = evaluate(IMPORTANCE, a, a.bsdf(), a.to_local(moved.d))
    start = start_of(starts, parent, first)
    there = dr.zeros(mi.Interaction3f, dr.width(j))
    there.p = moved.p + (start.end.p - start.ray.o)
    turned, ratio, _ = lights.redirected(scene, start, there)
    n, width = len(photons), dr.width(starts.ray.d)
    lane = dr.arange(mi.UInt32, dr.width(j))
    beyond = lights.far(start.index)
    to = dr.select(first, dr.select(beyond, moved.d, moved.p - start.ray.o), moved.p - a.spawn_ray(moved.d).o)
    fields = {field: dr.gather(type(value), value, j) for field, value in vars(photons).items()}
    fields |= {"p": moved.p, "n": moved.n, "d": moved.d, "β": moved.Φ, "t": dr.norm(to)}
    fields |= {"density": dr.select(first, 0, density), "parent": dr.select(first, lane + width, parent)}
    more = joined(photons, fields, mi, dr)
    index = dr.arange(mi.UInt32, width + dr.width(j))
    old = index < width

    def both(one, other):
        known = dr.gather(type(one), one, index, old), dr.gather(type(one), other, index - width, ~old)
        return dr.select(old, *known)

    aside = moved.p - moved.d
    ray = mi.Ray3f(
        both(starts.ray.o, dr.select(beyond, aside, start.ray.o)), both(starts.ray.d, turned.ray.d), starts.ray.time, []
    )
    end = dr.zeros(mi.DirectionSample3f, dr.width(index))
    end.p, end.n = both(starts.end.p, start.end.p), both(starts.end.n, start.end.n)
    # Le cos / p with its own p
    β = both(starts.β, dr.select(ratio > 0, turned.β / ratio, 0))
    kinds = (both(getattr(starts, name), getattr(start, name)) for name in ("emitter", "index"))
    more_starts = LightRay(ray, β, *kinds, end, both(starts.delta, start.delta))
    copied = Photon(moved.p, moved.n, moved.d, moved.Φ, lane + n)
    back, r_back, good_back = copy(world, LightPaths(more_starts, more), copied, (y, x), r2, good)
    good, good_back = np.array(good), np.array(good_back)
    assert good.sum() > 100 and (good & good_back).sum() > 0.97 * good.sum()
    good &= good_back
    error = np.abs(np.array(r, np.float64) * np.array(r_back, np.float64) - 1)[good]
    assert np.median(error) < 5e-4 and np.quantile(error, 0.95) < 2e-2
    # Φ'' has the density of the copy.
    power = np.array(dr.max(back.Φ) * r, np.float64) / np.array(dr.max(photon.Φ), np.float64)
    assert np.median(np.abs(power - 1)[good]) < 5e-4 and np.quantile(np.abs(power - 1)[good], 0.95) < 2e-2
    away = np.linalg.norm(np.array(back.p) - np.array(photon.p), axis=0)[good]
    assert np.median(away) < 2e-5 and np.quantile(away, 0.95) < 1e-3


def without_glass():
    """The sky, whose sun no camera path meets by chance: that is rarer than any test has samples for."""
    scene = SCENES["sky"]()
    del scene["glass"]
    return scene


QUICK, SLOW = [("glass", 4)], [("areas", 4), ("areas", 1), ("glass", 1), *product(["sky", "points"], [1, 4])]


@pytest.mark.parametrize(("name", "pixels"), QUICK + [pytest.param(*case, marks=pytest.mark.slow) for case in SLOW])
def test_differences_are_those_of_the_image(renderer, name, pixels):
    """In one pass after another: with the same photons, so that the noise of both falls out in part."""
    scene = load(renderer, without_glass if name == "sky" else SCENES[name], (12, 12))
    stacks = passes(scene, 32, pixels, radius=0.7, photons=2)
    assert np.mean([stack["primal"].mean() for stack in stacks]) > 0.01
    assert_no_bias(stacks, pixels)


@pytest.mark.parametrize("name", ["glass", "hidden_sky"])
def test_the_primal_is_that_of_ppm(renderer, name):
    """The same camera paths and photons; Russian roulette alone looks at five paths instead of one."""

    def short():
        from data_gen.scenes.builtin import SCENES as BUILTIN

        scene = BUILTIN[name]() if name in BUILTIN else SCENES[name]()
        return scene | {"integrator": {"type": "path", "max_depth": 5, "rr_depth": 9}}

    scene = load(renderer, short, (24, 16))
    ours, theirs = (render_ours(scene, sampler, 1, 2, radius=1.0)[0] for sampler in ("gpm", "ppm"))
    for layer in ("primal", "direct", "albedo", "normal", "depth"):
        assert np.allclose(ours[layer], theirs[layer], rtol=1e-4, atol=1e-6), layer


@pytest.mark.slow
def test_shifts_by_nothing_find_no_difference(renderer):
    """The copy of a path through its own pixel is the path."""
    layers = render_ours(load(renderer, SCENES["glass"], (16, 16)), "gpm", 1, 2, pixels=1)[0]
    assert layers["dx"].any()
    from data_gen.render import render_stack

    with far_shifts(0):
        layers = render_stack(load(renderer, SCENES["glass"], (16, 16)), 2, 0, "gpm").layers
    assert not layers["dx"].any() and not layers["dy"].any() and layers["primal"].any()


def test_photons_have_copies_and_differences_little_noise(renderer):
    """No z-test asks for that: a sampler that rejects every shift is unbiased. Measured: 0.945, 12.7 and 91."""
    from data_gen.render import render_stack
    from ngpt.io.exr import pass_through

    scene = load(renderer, "diffuse", (64, 64))
    failed = pass_through(render_stack(scene, 2, 0, "gpm", radius=1.0, diagnostics=True))["diagnostics.shiftFailures"]
    assert failed.mean() < 0.1
    mean, median = gain(passes(scene, 8, radius=1.0))
    assert mean > 5 and median > 30


@pytest.mark.slow
def test_caustics_have_less_noise_in_differences(renderer):
    """Photons from glass are near to both of two pixels, as long as the radius is wide. No other photon has a copy."""
    scene = load(renderer, SCENES["caustics"], (32, 32))
    mean, median = gain(passes(scene, 8, radius=3.0))
    assert mean > 1.5 and median > 2
