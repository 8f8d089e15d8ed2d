"""What is particular to ``gbeams``: how beams turn, and its differences against those of its own images.

That it repeats its bits, says how noisy it is and stays within its memory is among the laws of all samplers; what it
does on surfaces is that of ``gpm``, its camera paths are those of ``gbre``.
"""

import media_scenes
import numpy as np
import pytest
from data_gen_scenes import fog
from test_gbre import rays  # noqa: F401 - a fixture
from test_gpm import assert_no_bias, gain, largest, passes
from unbiased import far_shifts, load, render_ours


@pytest.mark.parametrize("far", [False, True])
def test_beams_turn_to_and_fro(rays, far):  # noqa: F811
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


QUICK = [("colours", 4)]
SLOW = [("haze", 1), ("haze", 4), ("forward", 4), ("dense", 4), ("nested", 4), ("milk", 4)]


@pytest.mark.parametrize(("name", "pixels"), QUICK + [pytest.param(*case, marks=pytest.mark.slow) for case in SLOW])
def test_differences_by_beams_are_those_of_the_image(renderer, name, pixels):
    """In one pass after another: with the same light paths, so that the noise of both falls out in part."""
    scene = load(renderer, getattr(media_scenes, name), (12, 12))
    stacks = passes(scene, 32, pixels, "gbeams", radius=0.5, photons=1)
    assert np.mean([stack["primal"].mean() for stack in stacks]) > 0.01
    assert_no_bias(stacks, pixels)


@pytest.mark.slow
def test_a_wrong_jacobian_of_beams_is_found(renderer, monkeypatch):
    """One without the lengths."""
    from data_gen.samplers.photons.gradients import shift

    monkeypatch.setattr(shift, "jacobian_in_medium", lambda length2, length2_1: 0 * length2_1 + 1)
    stacks = passes(load(renderer, media_scenes.haze, (12, 12)), 32, 4, "gbeams", radius=0.5, photons=2)
    with pytest.raises(AssertionError):
        assert_no_bias(stacks, 4)


@pytest.mark.slow
def test_the_primal_is_that_of_beams(renderer):
    """The same camera paths and beams; Russian roulette alone looks at five paths instead of one."""

    def short():
        return media_scenes.nested() | {"integrator": {"type": "volpath", "max_depth": 5, "rr_depth": 9}}

    scene = load(renderer, short, (24, 16))
    ours, theirs = (render_ours(scene, sampler, 1, 2, radius=1.0)[0] for sampler in ("gbeams", "beams"))
    for layer in ("primal", "direct", "albedo", "normal", "depth"):
        assert np.allclose(ours[layer], theirs[layer], rtol=1e-3, atol=1e-5), layer


@pytest.mark.slow
def test_beams_shifted_by_nothing_find_no_difference(renderer):
    from data_gen.render import render_stack

    with far_shifts(0):
        layers = render_stack(load(renderer, media_scenes.milk, (16, 16)), 2, 0, "gbeams").layers
    assert not layers["dx"].any() and not layers["dy"].any() and layers["primal"].any()


def test_beams_have_copies_and_differences_little_noise(renderer):
    """No z-test asks for that: a sampler that rejects every shift is unbiased."""
    from data_gen.render import render_stack
    from ngpt.io.exr import pass_through

    scene = load(renderer, fog, (32, 32))
    stack = render_stack(scene, 2, 0, "gbeams", radius=0.5, diagnostics=True)
    failed = pass_through(stack)["diagnostics.shiftFailures"]
    mean, median = gain(passes(scene, 8, 1, "gbeams", radius=0.5))
    assert failed.mean() < 0.15 and mean > 3 and median > 5, (failed.mean(), mean, median)
