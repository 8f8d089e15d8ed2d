"""What is particular to ``gbre``: how photons beside rays are copied, and its differences against its own images.

That it repeats its bits, says how noisy it is and stays within its memory is among the laws of all samplers; what it
does on surfaces is that of ``gpm``.
"""

from types import SimpleNamespace

import media_scenes
import numpy as np
import pytest
from test_gpm import joined, largest
from unbiased import load

LONG = ("haze", "colours", "forward")


@pytest.fixture(scope="module")
def rays(renderer):
    """Pairs of rays near each other, a distance along them, and a place beside the first; in double precision."""
    import drjit as dr
    from drjit.llvm import Array3f64 as Vector
    from drjit.llvm import Float64

    rng, n = np.random.default_rng(6), 2000

    def around(center, spread):
        return Vector(rng.normal(size=(3, n)) * spread + np.array(center)[:, None])

    d, e = dr.normalize(around([0, 0, 1], 0.2)), dr.normalize(around([0, 0, 1], 0.2))
    t = Float64(rng.uniform(1, 4, n))
    o = around([0, 0, 0], 0.1)
    v = around([0, 0, 0], 0.1)
    b = o + d * t + (v - d * dr.dot(v, d))
    return SimpleNamespace(
        dr=dr, Vector=Vector, o=o, d=d, t=t, u=around([0, 0, 0], 0.1), e=e, b=b, a=b - around([0, 1, 0], 0.3)
    )


def beside(g, b, o, d, u, e):
    """The copy, beside the ray (u, e), of a photon beside (o, d)."""
    from data_gen.samplers.photons.gradients.shift import moved

    t = g.dr.dot(b - o, d)
    return moved(b, o + d * t, d, u + e * t, e)


def test_photons_keep_their_distances(rays):
    """Along the ray and from it; and the shift back gives the photon, whatever the rays."""
    g, dr = rays, rays.dr
    c = beside(g, g.b, g.o, g.d, g.u, g.e)
    assert largest(dr.dot(c - g.u, g.e) - g.t) < 1e-12
    assert largest(dr.norm(c - g.u - g.e * g.t) - dr.norm(g.b - g.o - g.d * g.t)) < 1e-12
    assert largest(beside(g, c, g.u, g.e, g.o, g.d) - g.b) < 1e-9


def test_between_rays_from_one_point_what_is_beside_one_alone_goes_to_the_other(rays):
    g, dr = rays, rays.dr
    c = beside(g, g.b, g.o, g.d, g.o, g.e)
    from_b = dr.norm(dr.cross(g.b - g.o, g.e))
    assert largest(dr.norm(dr.cross(c - g.o, g.d)) - from_b) < 1e-11


def test_jacobians_in_media_by_finite_differences(rays):
    """Of volumes, which are kept; and of directions and distances from the predecessor."""
    from data_gen.samplers.photons.gradients.shift import jacobian_in_medium

    g, dr = rays, rays.dr
    axes = [g.Vector(1, 0, 0), g.Vector(0, 1, 0), g.Vector(0, 0, 1)]
    h = 1e-5

    def volume(of):
        x, y, z = ((of(axis * h) - of(axis * -h)) / (2 * h) for axis in axes)
        return np.abs(np.array(dr.dot(dr.cross(x, y), z)))

    volumes = volume(lambda step: beside(g, g.b + step, g.o, g.d, g.u, g.e))
    assert np.quantile(np.abs(volumes - 1), 0.99) < 1e-6

    to = g.b - g.a
    length = dr.norm(to)
    d = to / length
    s = dr.normalize(dr.cross(d, g.Vector(0.3, 0.9, 0.1)))
    t = dr.cross(d, s)
    d1 = dr.normalize(beside(g, g.b, g.o, g.d, g.u, g.e) - g.a)
    s1 = dr.normalize(dr.cross(d1, g.Vector(0.3, 0.9, 0.1)))
    t1 = dr.cross(d1, s1)

    def copied(step):
        """Direction and distance, on axes of their own, of the copy of a photon so much aside and further away."""
        b = g.a + dr.normalize(d + s * step.x + t * step.y) * (length + step.z)
        c = beside(g, b, g.o, g.d, g.u, g.e) - g.a
        way = dr.normalize(c)
        return g.Vector(dr.dot(way, s1), dr.dot(way, t1), dr.norm(c))

    told = np.array(jacobian_in_medium(dr.squared_norm(to), dr.squared_norm(beside(g, g.b, g.o, g.d, g.u, g.e) - g.a)))
    assert np.quantile(np.abs(volume(copied) / told - 1), 0.99) < 1e-5
    assert np.std(np.log(told)) > 0.1


@pytest.mark.parametrize("name", ["nested", *(pytest.param(n, marks=pytest.mark.slow) for n in LONG)])
def test_copies_of_photons_are_light_paths_and_their_copies_are_the_photons(renderer, name):
    """Camera rays come by, a hundredth of their length apart."""
    import drjit as dr

    from data_gen.samplers.photons.media.gbre import Beside

    mi = renderer

    def rays(eye, p, medium, rng):
        to, n = p - eye, p.shape[1]
        length = np.linalg.norm(to, axis=0)

        def ray(spread):
            d = to + rng.normal(size=p.shape) * spread * length
            d = mi.Vector3f(d / np.linalg.norm(d, axis=0))
            zero, everywhere = dr.zeros(mi.Spectrum, n), dr.full(mi.Bool, True, n)
            return Beside(mi.Point3f(eye), d, dr.full(mi.Float, 100, n), medium, zero, zero + 1, everywhere)

        return ray(0.004), ray(0.012), mi.Float((0.01 * length) ** 2)

    assert_copies_are_light_paths(mi, name, rays)


def assert_copies_are_light_paths(mi, name, receivers):
    """By the densities and throughputs of the copy itself, evaluated anew: r(T(x)) r(x) = 1, and T(T(x)) = x.

    ``receivers`` (eye, photons' places, their media, random numbers) has what photons are gathered at and copied to,
    and the squared radius.
    """
    import drjit as dr

    from data_gen.paths import media
    from data_gen.paths.light_ends import LightEnds, LightRay
    from data_gen.paths.streams import sample_streams
    from data_gen.paths.vertex import Materials
    from data_gen.paths.world import World
    from data_gen.samplers.bdpt.vertex import IMPORTANCE, evaluate
    from data_gen.samplers.photons.gradients.copies import LightPaths, start_of
    from data_gen.samplers.photons.map.fog import Fog
    from data_gen.samplers.photons.map.photon import Photon, photon_of
    from data_gen.samplers.photons.map.trace import trace
    from data_gen.samplers.photons.map.vertices import vertex_in_media_of
    from data_gen.samplers.photons.media.gbre import copy_beside

    scene = load(mi, getattr(media_scenes, name), (8, 8))
    lights, n = LightEnds(scene), 1 << 14
    ways = Fog(scene, scene.sensors()[0], lights, "gbre")
    random = sample_streams(0, dr.arange(mi.UInt32, n), mi.UInt32(0))
    world = World(scene, lights, Materials(scene, 0.05, media.index_matched, media=True), ways)
    starts, maps = trace(world, random, 6, 4)
    photons = next(maps)
    inside = (np.array(photons.depth) > 0) & (np.abs(np.array(photons.n)).sum(axis=0) == 0)
    rng = np.random.default_rng(0)
    j = mi.UInt32(rng.choice(np.flatnonzero(inside), 4000))
    photon = photon_of(photons, j)
    A, B, r2 = receivers(np.array(ways.eye), np.array(photon.p), dr.gather(mi.MediumPtr, photons.medium, j), rng)
    apart = A.near(photon.p, r2)[1] & ~B.near(photon.p, r2)[1]
    moved, _, r, good = copy_beside(world, LightPaths(starts, photons), photon, A, B, r2)
    good &= apart

    # The copy as a photon of its own, with what its predecessor has to say of it
    parent, first = dr.gather(mi.UInt32, photons.parent, j), dr.gather(mi.Float, photons.density, j) == 0
    a, place = vertex_in_media_of(photons, parent, ~first)
    _, density, _ = evaluate(IMPORTANCE, a, a.bsdf(), a.to_local(moved.d), ~first & ~place.scatters)
    phase = place.medium.phase_function()
    _, of_phase = phase.eval_pdf(mi.PhaseFunctionContext(), media.in_medium(a, place), moved.d, place.scatters)
    density = dr.select(place.scatters, of_phase, density)
    start = start_of(starts, parent, first)
    there = dr.zeros(mi.Interaction3f, 4000)
    there.p = moved.p + (start.end.p - start.ray.o)
    turned, ratio, _ = lights.redirected(scene, start, there)
    lane = dr.arange(mi.UInt32, 4000)
    fields = {field: dr.gather(type(value), value, j) for field, value in vars(photons).items()}
    fields |= {"p": moved.p, "d": moved.d, "β": moved.Φ}
    fields |= {"density": dr.select(first, 0, density), "parent": dr.select(first, lane + n, parent)}
    fields = {field: type(getattr(photons, field))(value) for field, value in fields.items()}
    more = joined(photons, fields, mi, dr)
    index = dr.arange(mi.UInt32, n + 4000)
    old = index < n

    def both(one, other):
        return dr.select(old, dr.gather(type(one), one, index, old), dr.gather(type(one), other, index - n, ~old))

    way = mi.Ray3f(both(starts.ray.o, start.ray.o), both(starts.ray.d, turned.ray.d), starts.ray.time, [])
    end = dr.zeros(mi.DirectionSample3f, n + 4000)
    end.p, end.n = both(starts.end.p, start.end.p), both(starts.end.n, start.end.n)
    # Le cos / p with its own p
    β = both(starts.β, dr.select(ratio > 0, turned.β / ratio, 0))
    kinds = (both(getattr(starts, field), getattr(start, field)) for field in ("emitter", "index"))
    more_starts = LightRay(way, β, *kinds, end, both(starts.delta, start.delta))
    place, of_media = lane + len(photons), {"medium": photon.medium, "channel": photon.channel}
    copied = Photon(moved.p, moved.n, moved.d, moved.Φ, place, **of_media)
    back, _, r_back, good_back = copy_beside(world, LightPaths(more_starts, more), copied, B, A, r2)
    # Of as many as may have one: light from mirrors is not here, walls and boundaries may be in the way.
    assert np.array(good).sum() > (0.7 if name == "nested" else 0.9) * np.array(apart).sum() > 300
    good, good_back = np.array(good), np.array(good_back)
    assert (good & good_back).sum() > 0.97 * good.sum()
    good &= good_back
    error = np.abs(np.array(r, np.float64) * np.array(r_back, np.float64) - 1)[good]
    assert np.median(error) < 5e-4 and np.quantile(error, 0.95) < 2e-2
    assert np.std(np.log(np.array(r)[good])) > 1e-3
    # Φ'' has the density of the copy.
    power = np.array(back.Φ * r, np.float64)[:, good] / np.array(photon.Φ, np.float64)[:, good]
    assert np.median(np.abs(power - 1)) < 5e-4 and np.quantile(np.abs(power - 1), 0.95) < 2e-2
    away = np.linalg.norm(np.array(back.p) - np.array(photon.p), axis=0)[good]
    assert np.median(away) < 2e-5 and np.quantile(away, 0.95) < 1e-3
