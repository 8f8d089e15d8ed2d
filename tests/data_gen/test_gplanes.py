"""What is particular to ``gplanes``: how planes turn, and its differences against those of its own images.

That it repeats its bits, says how noisy it is and stays within its memory is among the laws of all samplers; what it
does on surfaces is that of ``gpm``, its beams are those of ``gbeams``.
"""

import media_scenes
import numpy as np
import pytest
from test_gbre import rays  # noqa: F401 - a fixture
from test_gpm import assert_no_bias, gain, largest, passes
from unbiased import load


def turning(g):
    """(a, d, e, where the first ray meets the plane) of planes that go well with pairs of rays, in double precision."""
    from data_gen.samplers.photons.media.planes import crossing

    dr = g.dr
    a = g.b - g.Vector(0.5, 1.5, 0.2)
    d = dr.normalize(g.Vector(0.3, 0.1, 0.2) + 0.2 * g.u)
    e = dr.normalize(g.b - a - d * 0.4)
    return a, d, e, crossing(a, d, e, g.o, g.d)


def test_planes_turn_to_and_fro(rays):  # noqa: F811
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


def test_jacobians_of_planes_by_finite_differences(rays):  # noqa: F811
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
@pytest.mark.parametrize("wrong", [False, True])
def test_a_wrong_jacobian_of_planes_is_found(renderer, monkeypatch, wrong):
    """One without the lengths; without the volumes the noise of rays that graze planes hides the bias."""
    from data_gen.samplers.photons.gradients import shift
    from data_gen.samplers.photons.media.gplanes import GPLANES

    if wrong:
        monkeypatch.setattr(shift, "jacobian_of_planes", lambda t, volume, t1, volume1: shift.dr.abs(volume1 / volume))
    monkeypatch.setattr(GPLANES, "near", by_planes_alone)
    stacks = passes(load(renderer, media_scenes.haze, (12, 12)), 64, 4, "gplanes", planes=144)
    if not wrong:
        assert_no_bias(stacks, 4)
        return
    with pytest.raises(AssertionError):
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
