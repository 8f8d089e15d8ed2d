"""What is particular to ``gvpm``: photons in balls and their copies, and its differences against its own images.

That it repeats its bits, says how noisy it is and stays within its memory is among the laws of all samplers; what it
does on surfaces is that of ``gpm``, new edges of light paths are those of ``gbre``.
"""

import media_scenes
import numpy as np
import pytest
from data_gen_scenes import fog
from test_gbre import LONG, assert_copies_are_light_paths, rays  # noqa: F401 - a fixture
from test_gpm import assert_no_bias, gain, largest, passes
from unbiased import far_shifts, load, render_ours


def test_photons_in_one_ball_alone_go_to_the_other(rays):  # noqa: F811
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


@pytest.mark.parametrize("name", ["nested", *(pytest.param(n, marks=pytest.mark.slow) for n in LONG)])
def test_copies_of_photons_are_light_paths_and_their_copies_are_the_photons(renderer, name):
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


QUICK = [("colours", 4)]
FOG = [("haze", 1), ("haze", 4), ("forward", 4), ("dense", 4), ("nested", 4), ("milk", 4)]
SLOW = [*FOG, ("wisps", 1), ("wisps", 4), ("smoke", 4), ("coloured_smoke", 4), ("before_the_sky", 1)]


@pytest.mark.parametrize(("name", "pixels"), QUICK + [pytest.param(*case, marks=pytest.mark.slow) for case in SLOW])
def test_differences_in_balls_are_those_of_the_image(renderer, name, pixels):
    """In one pass after another: with the same photons, so that the noise of both falls out in part."""
    scene = load(renderer, getattr(media_scenes, name), (12, 12))
    stacks = passes(scene, 32, pixels, "gvpm", radius=0.7, photons=8)
    assert np.mean([stack["primal"].mean() for stack in stacks]) > 0.01
    assert_no_bias(stacks, pixels)


@pytest.mark.slow
def test_a_wrong_jacobian_in_balls_is_found(renderer, monkeypatch):
    from data_gen.samplers.photons.gradients import shift

    monkeypatch.setattr(shift, "jacobian_in_medium", lambda length2, length2_1: 0 * length2_1 + 1)
    stacks = passes(load(renderer, media_scenes.dense, (12, 12)), 64, 4, "gvpm", radius=1.4, photons=32)
    with pytest.raises(AssertionError):
        assert_no_bias(stacks, 4)


@pytest.mark.slow
def test_null_collisions_that_are_stretched_without_their_jacobian_are_found(renderer, monkeypatch):
    import drjit as dr

    monkeypatch.setattr("data_gen.paths.collisions.list_jacobian", lambda scale, n: dr.full(type(scale), 1))
    stacks = passes(load(renderer, media_scenes.wisps, (12, 12)), 64, 4, "gvpm", radius=1.4, photons=32)
    with pytest.raises(AssertionError):
        assert_no_bias(stacks, 4)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["nested", "milk", "wisps", "before_the_sky"])
def test_the_primal_is_that_of_vpm(renderer, name):
    """The same camera paths and photons; Russian roulette alone looks at five paths instead of one."""

    def short():
        scene = getattr(media_scenes, name)()
        return scene | {"integrator": {"type": "volpath", "max_depth": 5, "rr_depth": 9}}

    scene = load(renderer, short, (24, 16))
    ours, theirs = (render_ours(scene, sampler, 1, 2, radius=1.0)[0] for sampler in ("gvpm", "vpm"))
    for layer in ("primal", "direct", "albedo", "normal", "depth"):
        assert np.allclose(ours[layer], theirs[layer], rtol=1e-3, atol=1e-5), layer


@pytest.mark.slow
def test_shifts_by_nothing_find_no_difference_in_balls(renderer):
    """The copy of a path through its own pixel is the path."""
    from data_gen.render import render_stack

    with far_shifts(0):
        layers = render_stack(load(renderer, media_scenes.milk, (16, 16)), 2, 0, "gvpm", photons=4).layers
    assert not layers["dx"].any() and not layers["dy"].any() and layers["primal"].any()


def test_photons_in_balls_have_copies_and_differences_little_noise(renderer):
    """No z-test asks for that: a sampler that rejects every shift is unbiased."""
    from data_gen.render import render_stack
    from ngpt.io.exr import pass_through

    scene = load(renderer, fog, (48, 48))
    failed = pass_through(render_stack(scene, 2, 0, "gvpm", radius=1.0, diagnostics=True))["diagnostics.shiftFailures"]
    mean, median = gain(passes(scene, 8, 1, "gvpm", radius=1.0))
    assert failed.mean() < 0.1 and mean > 5 and median > 30, (failed.mean(), mean, median)


@pytest.mark.slow
def test_photons_in_grids_have_copies_and_differences_little_noise(renderer):
    """Where a grid is empty there are none: more fail than in fog."""
    from data_gen.render import render_stack
    from ngpt.io.exr import pass_through

    scene = load(renderer, media_scenes.wisps, (24, 24))
    stack = render_stack(scene, 2, 0, "gvpm", radius=1.0, photons=8, diagnostics=True)
    failed = pass_through(stack)["diagnostics.shiftFailures"]
    mean, median = gain(passes(scene, 8, 1, "gvpm", radius=0.7, photons=8))
    assert failed.mean() < 0.2 and mean > 6 and median > 15, (failed.mean(), mean, median)
