"""How photons, beams and planes in media are copied: to and fro, Jacobians by finite differences, in scenes.

On surfaces they are copied as ``gpm`` does it.
"""

from types import SimpleNamespace

import media_scenes
import numpy as np
import pytest
from photon_laws import assert_copies_are_light_paths, assert_no_bias, beside, gain, largest, passes
from unbiased import load

MEDIA = ["nested", *(pytest.param(name, marks=pytest.mark.slow) for name in ("haze", "colours", "forward"))]


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


# ------------------------- Photons beside rays -------------------------


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


@pytest.mark.parametrize("name", MEDIA)
def test_copies_of_photons_beside_rays_are_light_paths_and_their_copies_are_the_photons(renderer, name):
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


# ------------------------- Photons in balls -------------------------


def test_photons_in_one_ball_alone_go_to_the_other(rays):
    """As near to y as they were to x, and as far from x as they were from y; and back. Mirrors keep volumes."""
    from data_gen.samplers.photons.gradients.shift import image

    g, dr = rays, rays.dr
    x, y = g.o, g.u
    c = image(g.b, x, y)
    assert largest(dr.norm(c - y) - dr.norm(g.b - x)) < 1e-11
    assert largest(dr.norm(c - x) - dr.norm(g.b - y)) < 1e-11
    assert largest(image(c, y, x) - g.b) < 1e-11
    axes = [g.Vector(1, 0, 0), g.Vector(0, 1, 0), g.Vector(0, 0, 1)]
    across, along, aside = (image(g.b + axis, x, y) - c for axis in axes)
    assert largest(dr.dot(dr.cross(across, along), aside) + 1) < 1e-10


@pytest.mark.parametrize("name", MEDIA)
def test_copies_of_photons_in_balls_are_light_paths_and_their_copies_are_the_photons(renderer, name):
    """Camera paths scatter near by, a hundredth of their length apart."""
    import drjit as dr

    from data_gen.samplers.photons.media.gvpm import InBall

    mi = renderer

    def balls(eye, p, medium, rng):
        n, length = p.shape[1], np.linalg.norm(p - eye, axis=0)

        def ball(spread):
            x = p + rng.normal(size=p.shape) * spread * length
            d, one = (x - eye) / np.linalg.norm(x - eye, axis=0), dr.ones(mi.Spectrum, n)
            return InBall(mi.Point3f(x), mi.Vector3f(d), medium, one, dr.full(mi.Bool, True, n))

        return ball(0.003), ball(0.009), mi.Float((0.01 * length) ** 2)

    assert_copies_are_light_paths(mi, name, balls)


# ------------------------- Beams -------------------------


@pytest.mark.parametrize("far", [False, True])
def test_beams_turn_to_and_fro(rays, far):
    """Past the other ray at the same distance along it, on the other side; J by finite differences."""
    from data_gen.samplers.photons.gradients.shift import past
    from data_gen.samplers.photons.media.beams import nearest

    g, dr = rays, rays.dr
    a = g.b - g.Vector(0.3, 2.0, 0.2)

    def turned(a, d, o, e, u, f):
        """The copy, past (u, f), of a beam from ``a`` along ``d`` past (o, e); light from infinity is moved."""
        s, t, _, _ = nearest(o, e, a, d)
        aside = dr.dot(a + d * s - o - e * t, dr.normalize(dr.cross(e, d)))
        target = past(a, d, u + f * t, f, -aside, g.dr.mask_t(aside)(far))
        origin = target - d * s if far else a
        return origin, d if far else dr.normalize(target - a), target

    d = dr.normalize(g.b - a)
    near = nearest(g.o, g.d, a, d)
    origin, d1, target = turned(a, d, g.o, g.d, g.u, g.e)
    there = nearest(g.u, g.e, origin, d1)
    assert largest(there[1] - near[1]) < 1e-6 and largest(there[2] - near[2]) < 1e-6
    back_origin, back, _ = turned(origin, d1, g.u, g.e, g.o, g.d)
    assert largest(back - d) < 1e-6
    if far:
        moved = back_origin - a
        assert largest(moved - d * dr.dot(moved, d)) < 1e-6
    x = dr.normalize(dr.cross(d, g.Vector(0.3, 0.9, 0.1)))
    y, h = dr.cross(d, x), 1e-5

    def copied(i, j):
        if far:
            origin, way, _ = turned(a + x * i + y * j, d, g.o, g.d, g.u, g.e)
            return origin - way * dr.dot(origin, way)
        return turned(a, dr.normalize(d + x * i + y * j), g.o, g.d, g.u, g.e)[1]

    columns = [(copied(h * i, h * j) - copied(-h * i, -h * j)) / (2 * h) for i, j in ((1, 0), (0, 1))]
    measured = np.array(dr.norm(dr.cross(*columns)))
    lengths = 1 if far else dr.square(near[0] / dr.norm(target - a))
    told = np.array(there[3] / near[3] * lengths)
    assert np.quantile(np.abs(measured / told - 1), 0.95) < 1e-4 and np.std(np.log(told)) > 0.02


# ------------------------- Planes -------------------------


def turning(g):
    """(a, d, e, where the first ray meets the plane) of planes that go well with pairs of rays, in double precision."""
    from data_gen.samplers.photons.media.planes import crossing

    dr = g.dr
    a = g.b - g.Vector(0.5, 1.5, 0.2)
    d = dr.normalize(g.Vector(0.3, 0.1, 0.2) + 0.2 * g.u)
    e = dr.normalize(g.b - a - d * 0.4)
    return a, d, e, crossing(a, d, e, g.o, g.d)


def test_planes_turn_to_and_fro(rays):
    """To where the other ray is as far along it, with the same angle between both edges; J J' = 1."""
    from data_gen.samplers.photons.gradients.shift import about, jacobian_of_planes
    from data_gen.samplers.photons.media.planes import crossing

    g, dr = rays, rays.dr
    a, d, e, at = turning(g)
    assert np.array(at.t > 0).all() and np.array(at.u > 0).all()
    e1, s1, t1 = about(a, d, e, g.u + g.e * at.u)
    there = crossing(a, d, e1, g.u, g.e)
    assert max(largest(there.u - at.u), largest(there.s - s1), largest(there.t - t1)) < 1e-8
    assert largest(dr.dot(d, e1) - dr.dot(d, e)) < 1e-12 and largest(dr.norm(e1) - 1) < 1e-12
    back, s, t = about(a, d, e1, g.o + g.d * there.u)
    assert max(largest(dr.norm(back - e)), largest(s - at.s), largest(t - at.t)) < 1e-7
    J, J1 = (
        jacobian_of_planes(*x)
        for x in (
            (at.t, at.volume, t1, there.volume),
            (there.t, there.volume, t, crossing(a, d, back, g.o, g.d).volume),
        )
    )
    assert np.quantile(np.abs(np.array(J * J1) - 1), 0.99) < 1e-6 and np.std(np.log(np.array(J))) > 0.1


def test_jacobians_of_planes_by_finite_differences(rays):
    """Of the solid angles of the second edge: another one meets the ray at another distance along it."""
    from data_gen.samplers.photons.gradients.shift import about, jacobian_of_planes
    from data_gen.samplers.photons.media.planes import crossing

    g, dr = rays, rays.dr
    a, d, e, at = turning(g)
    x = dr.normalize(dr.cross(e, g.Vector(0.3, 0.9, 0.1)))
    y, h = dr.cross(e, x), 1e-6

    def copied(i, j):
        e2 = dr.normalize(e + x * i + y * j)
        return about(a, d, e2, g.u + g.e * crossing(a, d, e2, g.o, g.d).u)[0]

    columns = [(copied(h * i, h * j) - copied(-h * i, -h * j)) / (2 * h) for i, j in ((1, 0), (0, 1))]
    measured = np.array(dr.norm(dr.cross(*columns)))
    _, _, t1 = about(a, d, e, g.u + g.e * at.u)
    told = np.array(jacobian_of_planes(at.t, at.volume, t1, dr.dot(d, dr.cross(copied(0, 0), g.e))))
    assert np.quantile(np.abs(measured / told - 1), 0.95) < 1e-5 and np.std(np.log(told)) > 0.1


@pytest.mark.parametrize("name", ["forward", *(pytest.param(n, marks=pytest.mark.slow) for n in ("haze", "nested"))])
def test_copies_of_planes_are_planes_and_their_copies_are_the_planes(renderer, name):
    """Of light paths in a scene: r(T(x)) r(x) = 1, T(T(x)) = x, and Φ'' = Φ."""
    import drjit as dr

    from data_gen.paths.camera import CameraSamples
    from data_gen.samplers import find
    from data_gen.samplers.photons.media.gbre import Beside
    from data_gen.samplers.photons.media.gplanes import copied
    from data_gen.samplers.photons.media.planes import crossing, planes_of

    mi, rng, n = renderer, np.random.default_rng(0), 1 << 12
    made = find("gplanes").made(load(mi, getattr(media_scenes, name), (8, 8)), planes=n)
    camera = CameraSamples(made.world.scene.sensors()[0], 0, n // 64)
    traced = next(made.integrator.maps(made, camera))
    planes = planes_of(made, traced).planes
    k = len(planes)
    eye = mi.Point3f(made.world.fog.eye)
    middle = rng.normal(size=(3, k)) * 0.4 - np.array(eye)

    def ray(spread):
        d = middle + rng.normal(size=(3, k)) * spread
        d = mi.Vector3f(d / np.linalg.norm(d, axis=0))
        zero, everywhere = dr.zeros(mi.Spectrum, k), dr.full(mi.Bool, True, k)
        return Beside(eye, d, dr.full(mi.Float, 100, k), planes.medium, zero, zero + 1, everywhere)

    A, B = ray(0), ray(0.02)
    at = crossing(planes.a, planes.d, planes.e, A.o, A.d)
    met = (at.s > 0) & (at.s < planes.length) & (at.t > 0) & (at.u > 0) & (dr.abs(at.volume) > 1e-3)
    moved, there, _, r, good = copied(planes, at, B)
    back, again, _, r_back, good_back = copied(moved, there, A)
    good &= met & (dr.abs(there.volume) > 1e-3)
    assert np.array(good).sum() > 0.85 * np.array(met).sum() > 300
    good, good_back = np.array(good), np.array(good_back)
    assert (good & good_back).sum() > 0.99 * good.sum()
    good &= good_back
    error = np.abs(np.array(r * r_back, np.float64) - 1)[good]
    assert np.median(error) < 1e-4 and np.quantile(error, 0.95) < 1e-2 and np.std(np.log(np.array(r)[good])) > 1e-2
    away = np.linalg.norm(np.array(back.e) - np.array(planes.e), axis=0)[good]
    assert np.median(away) < 1e-5 and np.quantile(away, 0.95) < 1e-3
    s, was = np.array(again.s)[good], np.array(at.s)[good]
    assert np.quantile(np.abs(s - was), 0.9) < 1e-3
    assert np.allclose(np.array(back.Φ)[:, good], np.array(planes.Φ)[:, good], rtol=1e-2)


def by_planes_alone(integrator, passes, traced):
    """For ``GPLANES.near``."""
    from data_gen.samplers.photons.gradients.differences import Gathered
    from data_gen.samplers.photons.media.gplanes import NearPlanes
    from data_gen.samplers.photons.media.planes import planes_of

    yield Gathered(None, NearPlanes(planes_of(passes, traced)))


@pytest.mark.slow
def test_differences_by_planes_alone_are_those_of_their_image(renderer, monkeypatch):
    from data_gen.samplers.photons.media.gplanes import GPLANES

    monkeypatch.setattr(GPLANES, "near", by_planes_alone)
    stacks = passes(load(renderer, media_scenes.colours, (12, 12)), 32, 4, "gplanes", planes=144)
    assert np.mean([stack["primal"].mean() for stack in stacks]) > 0.01
    assert_no_bias(stacks, 4)


@pytest.mark.slow
def test_planes_have_copies_and_differences_little_noise(renderer, monkeypatch):
    """No z-test asks for that: a sampler that rejects every shift is unbiased. Measured, 48x48: 0.02, 66 and 106."""
    from data_gen.render import render_stack
    from data_gen.samplers.photons.media.gplanes import GPLANES
    from ngpt.io.exr import pass_through

    monkeypatch.setattr(GPLANES, "near", by_planes_alone)
    scene = load(renderer, media_scenes.haze, (32, 32))
    failed = pass_through(render_stack(scene, 2, 0, "gplanes", diagnostics=True))["diagnostics.shiftFailures"]
    mean, median = gain(passes(scene, 8, 1, "gplanes"))
    assert failed.mean() < 0.1 and mean > 10 and median > 20, (failed.mean(), mean, median)
