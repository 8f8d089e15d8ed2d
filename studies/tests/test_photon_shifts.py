"""How photons, beams and planes are copied: to and fro, Jacobians by finite differences, in scenes."""

from types import SimpleNamespace

import media_scenes
import numpy as np
import pytest
from bdpt_scenes import SCENES
from photon_copies import assert_copies_are_light_paths, largest, traced
from photon_laws import world_of
from renders import dr
from scipy.spatial import cKDTree
from unbiased import load

from data_gen.paths import media
from data_gen.paths.light_ends import LightEnds, World
from data_gen.paths.vertex import Materials
from data_gen.samplers.photons.map.fog import Fog
from ngpt_studies.photons.gradients import shift as shifts
from ngpt_studies.photons.gradients.copies import LightPaths, copy
from ngpt_studies.photons.map.vertices import is_near, vertex_of


@pytest.fixture(scope="module")
def rays(renderer):
    """Random geometry in double precision: pairs of rays (o, d), (u, e), near each other; a distance t along them.

    b is a place beside the first ray, a one from which light comes there; x, y are points with normals n, m.
    """
    from drjit.llvm import Array3f64 as Vector
    from drjit.llvm import Float64

    rng, count = np.random.default_rng(6), 2000

    def around(center, spread):
        return Vector(rng.normal(size=(3, count)) * spread + np.array(center)[:, None])

    d, e = dr.normalize(around([0, 0, 1], 0.2)), dr.normalize(around([0, 0, 1], 0.2))
    t, o, v = Float64(rng.uniform(1, 4, count)), around([0, 0, 0], 0.1), around([0, 0, 0], 0.1)
    b = o + d * t + (v - d * dr.dot(v, d))
    g = SimpleNamespace(dr=dr, Vector=Vector, o=o, d=d, t=t, u=around([0, 0, 0], 0.1), e=e, b=b)
    g.a = b - around([0, 1, 0], 0.3)
    g.x, g.n, g.m = around([0, 0, 0], 0.2), dr.normalize(around([0, 0, 2], 1)), dr.normalize(around([0, 0, 2], 1))
    g.y = g.x + around([0, 0, 0], 0.3)
    return g


def across(g, d):
    """Two directions that are normal to ``d`` and to each other."""
    s = g.dr.normalize(g.dr.cross(d, g.Vector(0.3, 0.9, 0.1)))
    return s, g.dr.cross(d, s)


def area_ratio(g, copied, h=1e-5):
    """By how much ``copied(i, j)``, of steps i and j, enlarges areas."""
    i, j = ((copied(h * i, h * j) - copied(-h * i, -h * j)) / (2 * h) for i, j in ((1, 0), (0, 1)))
    return np.array(g.dr.norm(g.dr.cross(i, j)))


def volume_ratio(g, copied, h=1e-5):
    axes = [g.Vector(1, 0, 0), g.Vector(0, 1, 0), g.Vector(0, 0, 1)]
    x, y, z = ((copied(axis * h) - copied(axis * -h)) / (2 * h) for axis in axes)
    return np.abs(np.array(g.dr.dot(g.dr.cross(x, y), z)))


def assert_told(measured, told, most=1e-5, quantile=0.99):
    told = np.array(told)
    assert np.quantile(np.abs(measured / told - 1), quantile) < most and np.std(np.log(told)) > 0.02


# ------------------------- Photons on surfaces -------------------------


@pytest.mark.parametrize("far", [False, True])
def test_jacobian_by_finite_differences(rays, far):
    """The Jacobian of directions from the predecessor; for light from infinity, of origins on a plane across it."""
    g, dr = rays, rays.dr
    way, a = -g.d, g.x + g.d * g.t
    s, t = across(g, way)

    def copied(i, j):
        """(direction or origin, J) of what is i and j along s and t aside."""
        origin, d = (a + s * i + t * j, way) if far else (a, dr.normalize(way + s * i + t * j))
        b = shifts.on_plane(origin, d, g.x, g.n)
        c = shifts.moved(b, g.x, g.n, g.y, g.m)
        if far:
            return c - d * dr.dot(c, d), shifts.jacobian(d, g.n, 1, d, g.m, 1)
        to = c - a
        d1 = dr.normalize(to)
        return d1, shifts.jacobian(d, g.n, dr.squared_norm(b - a), d1, g.m, dr.squared_norm(to))

    told = np.array(copied(0, 0)[1])
    # Lines along a plane meet it anywhere.
    good = (np.abs(np.array(dr.dot(g.d, g.n))) > 0.1) & (told > 1e-3) & (told < 1e3)
    assert good.sum() > 1000
    assert_told(area_ratio(g, lambda i, j: copied(i, j)[0])[good], told[good], quantile=1)


# The sky is infinitely far away, and has a lamp with an area and a ball of glass before it.
@pytest.mark.parametrize(
    "name", ["sky", *(pytest.param(n, marks=pytest.mark.slow) for n in ("areas", "points", "glossy"))]
)
def test_copies_of_photons_are_light_paths_and_their_copies_are_the_photons(renderer, name):
    """Points where photons are gathered are beside photons, on the surfaces where other photons are."""
    mi, world = renderer, world_of(load(renderer, SCENES[name], (8, 8)))
    starts, (photons,) = traced(world, 1 << 14)
    some = np.flatnonzero((np.array(photons.depth) > 0) & np.isfinite(np.array(photons.density)))
    p = np.array(photons.p).T[some]
    distances, near = cKDTree(p).query(p, k=9)
    r2, place = mi.Float(np.median(distances[:, 6]) ** 2), np.random.default_rng(0).permutation(len(some))[:4000]
    j, x, y = (mi.UInt32(some[near[place, k]]) for k in (0, 2, 8))
    x, y = vertex_of(photons, x), vertex_of(photons, y)

    def shift(paths, photon, back):
        active, ends = (~is_near(photon, y, r2), (x, y)) if back is None else (back, (y, x))
        return *copy(world, paths, photon, ends, r2, active), active

    assert_copies_are_light_paths(world, LightPaths(starts, photons), j, shift)


# ------------------------- Photons in media -------------------------


def beside(g, b, o, d, u, e):
    """The copy, beside the ray (u, e), of a photon beside (o, d)."""
    t = g.dr.dot(b - o, d)
    return shifts.moved(b, o + d * t, d, u + e * t, e)


def test_photons_are_mirrored_and_volumes_kept(rays):
    """What is near to one of two points, or beside one of two rays, alone goes to the other."""
    g, dr = rays, rays.dr
    c = shifts.image(g.b, g.o, g.u)
    assert largest(dr.norm(c - g.u) - dr.norm(g.b - g.o)) < 1e-11
    assert largest(dr.norm(c - g.o) - dr.norm(g.b - g.u)) < 1e-11
    assert np.abs(volume_ratio(g, lambda step: shifts.image(g.b + step, g.o, g.u)) - 1).max() < 1e-6
    c = beside(g, g.b, g.o, g.d, g.u, g.e)
    assert largest(dr.dot(c - g.u, g.e) - g.t) < 1e-12
    assert largest(dr.norm(c - g.u - g.e * g.t) - dr.norm(g.b - g.o - g.d * g.t)) < 1e-12
    volumes = volume_ratio(g, lambda step: beside(g, g.b + step, g.o, g.d, g.u, g.e))
    assert np.quantile(np.abs(volumes - 1), 0.99) < 1e-6
    # Between rays from one point
    c, from_b = beside(g, g.b, g.o, g.d, g.o, g.e), dr.norm(dr.cross(g.b - g.o, g.e))
    assert largest(dr.norm(dr.cross(c - g.o, g.d)) - from_b) < 1e-11


def test_jacobian_in_media_by_finite_differences(rays):
    """The Jacobian of directions and distances from the predecessor."""
    g, dr = rays, rays.dr
    to, to1 = g.b - g.a, beside(g, g.b, g.o, g.d, g.u, g.e) - g.a
    length, d = dr.norm(to), dr.normalize(to)
    (s, t), (s1, t1) = across(g, d), across(g, dr.normalize(to1))

    def copied(step):
        """Direction and distance, on axes of their own, of the copy of a photon so much aside and further away."""
        b = g.a + dr.normalize(d + s * step.x + t * step.y) * (length + step.z)
        c = beside(g, b, g.o, g.d, g.u, g.e) - g.a
        return g.Vector(dr.dot(dr.normalize(c), s1), dr.dot(dr.normalize(c), t1), dr.norm(c))

    assert_told(volume_ratio(g, copied), shifts.jacobian_in_medium(dr.squared_norm(to), dr.squared_norm(to1)))


def balls(mi, eye, p, medium, rng):
    """Camera paths scatter near by, a hundredth of their length apart."""
    from ngpt_studies.photons.media.gvpm import InBall

    n, length = p.shape[1], np.linalg.norm(p - eye, axis=0)
    for spread in (0.003, 0.009):
        x = p + rng.normal(size=p.shape) * spread * length
        d, one = (x - eye) / np.linalg.norm(x - eye, axis=0), dr.ones(mi.Spectrum, n)
        yield InBall(mi.Point3f(x), mi.Vector3f(d), medium, one, dr.full(mi.Bool, True, n))


def ray(mi, o, d, medium):
    """A long one, through clear air."""
    from ngpt_studies.photons.media.gbre import Beside

    n, d = d.shape[1], mi.Vector3f(d / np.linalg.norm(d, axis=0))
    zero, everywhere = dr.zeros(mi.Spectrum, n), dr.full(mi.Bool, True, n)
    return Beside(mi.Point3f(o), d, dr.full(mi.Float, 100, n), medium, zero, zero + 1, everywhere)


def camera_rays(mi, eye, p, medium, rng):
    """Camera rays come by, a hundredth of their length apart."""
    length = np.linalg.norm(p - eye, axis=0)
    for spread in (0.004, 0.012):
        yield ray(mi, eye, p - eye + rng.normal(size=p.shape) * spread * length, medium)


MEDIA = ["nested", *(pytest.param(name, marks=pytest.mark.slow) for name in ("haze", "colours", "forward"))]


@pytest.mark.parametrize("receivers", [balls, camera_rays])
@pytest.mark.parametrize("name", MEDIA)
def test_copies_in_media_are_light_paths_and_their_copies_are_the_photons(renderer, receivers, name):
    from ngpt_studies.photons.media.gbre import copy_beside

    mi, scene, rng = renderer, load(renderer, getattr(media_scenes, name), (8, 8)), np.random.default_rng(0)
    lights = LightEnds(scene)
    fog = Fog(scene, scene.sensors()[0], lights, "gbre")
    world = World(scene, lights, Materials(scene, 0.05, media.index_matched, media=True), fog)
    starts, (photons, *_) = traced(world, 1 << 14)
    inside = (np.array(photons.depth) > 0) & (np.abs(np.array(photons.n)).sum(axis=0) == 0)
    j = mi.UInt32(rng.choice(np.flatnonzero(inside), 4000))
    p, eye = np.array(dr.gather(mi.Point3f, photons.p, j)), np.array(fog.eye)
    A, B = receivers(mi, eye, p, dr.gather(mi.MediumPtr, photons.medium, j), rng)
    r2 = mi.Float((0.01 * np.linalg.norm(p - eye, axis=0)) ** 2)

    def shift(paths, photon, back):
        apart = A.near(photon.p, r2)[1] & ~B.near(photon.p, r2)[1] if back is None else back
        moved, _, r, good = copy_beside(world, paths, photon, *((A, B) if back is None else (B, A)), r2)
        return moved, r, good & apart, apart

    # Light from mirrors is not here; walls and boundaries may be in the way.
    assert_copies_are_light_paths(world, LightPaths(starts, photons), j, shift, 0.7 if name == "nested" else 0.9)


# ------------------------- Beams -------------------------


@pytest.mark.parametrize("far", [False, True])
def test_beams_turn_to_and_fro(rays, far):
    """Past the other ray at the same distance along it, on the other side; J by finite differences."""
    from ngpt_studies.photons.media.beams import nearest

    g, dr = rays, rays.dr
    a = g.b - g.Vector(0.3, 2.0, 0.2)

    def turned(a, d, o, e, u, f):
        """The copy, past (u, f), of a beam from ``a`` along ``d`` past (o, e); light from infinity is moved."""
        s, t, _, _ = nearest(o, e, a, d)
        aside = dr.dot(a + d * s - o - e * t, dr.normalize(dr.cross(e, d)))
        target = shifts.past(a, d, u + f * t, f, -aside, g.dr.mask_t(aside)(far))
        return (target - d * s, d, target) if far else (a, dr.normalize(target - a), target)

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
    x, y = across(g, d)

    def copied(i, j):
        if far:
            origin, way, _ = turned(a + x * i + y * j, d, g.o, g.d, g.u, g.e)
            return origin - way * dr.dot(origin, way)
        return turned(a, dr.normalize(d + x * i + y * j), g.o, g.d, g.u, g.e)[1]

    lengths = 1 if far else dr.square(near[0] / dr.norm(target - a))
    assert_told(area_ratio(g, copied), there[3] / near[3] * lengths, 1e-4, 0.95)


# ------------------------- Planes -------------------------


def test_planes_turn_to_and_fro(rays):
    """To where the other ray is as far along it, with the same angle between both edges; J by finite differences."""
    from ngpt_studies.photons.media.planes import crossing

    g, dr = rays, rays.dr
    a = g.b - g.Vector(0.5, 1.5, 0.2)
    d = dr.normalize(g.Vector(0.3, 0.1, 0.2) + 0.2 * g.u)
    e = dr.normalize(g.b - a - d * 0.4)
    at = crossing(a, d, e, g.o, g.d)
    assert np.array(at.t > 0).all() and np.array(at.u > 0).all()
    e1, s1, t1 = shifts.about(a, d, e, g.u + g.e * at.u)
    there = crossing(a, d, e1, g.u, g.e)
    assert max(largest(there.u - at.u), largest(there.s - s1), largest(there.t - t1)) < 1e-8
    assert largest(dr.dot(d, e1) - dr.dot(d, e)) < 1e-12 and largest(dr.norm(e1) - 1) < 1e-12
    back, s, t = shifts.about(a, d, e1, g.o + g.d * there.u)
    assert max(largest(dr.norm(back - e)), largest(s - at.s), largest(t - at.t)) < 1e-7
    x, y = across(g, e)

    def copied(i, j):
        """Another second edge meets the ray at another distance along it."""
        e2 = dr.normalize(e + x * i + y * j)
        return shifts.about(a, d, e2, g.u + g.e * crossing(a, d, e2, g.o, g.d).u)[0]

    assert_told(area_ratio(g, copied, 1e-6), shifts.jacobian_of_planes(at.t, at.volume, t1, there.volume), 1e-5, 0.95)
