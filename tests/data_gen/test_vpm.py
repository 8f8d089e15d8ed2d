"""Photons in media: what ``vpm`` converges to and how fast, where light begins, and what it refuses.

That it repeats its bits, says how noisy it is and stays within its memory is among the laws of all samplers.
"""

import media_scenes
import numpy as np
import pytest
from data_gen_scenes import _scale, fog
from test_photons import assert_alike
from unbiased import gradient_tests, light_of_gradients, load, render_ours, render_references

from ngpt.errors import NgptError


def alike(renderer, scene, radius=0.4, photons=128, block=4, references=128):
    scene = load(renderer, scene, (16, 16))
    ours = render_ours(scene, "vpm", batches=8, spp=1, radius=radius, photons=photons)
    theirs = render_ours(scene, "primal", batches=8, spp=references)
    # Light that is seen directly is its expectation in ours, and has its own edges.
    images, references = (np.stack([light_of_gradients(s) for s in stacks]) for stacks in (ours, theirs))
    assert references.mean() > 0.01
    assert_alike(images, references, block)


SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in ("forward", "colours", "milk")]


@pytest.mark.parametrize("name", ["haze", *SLOW])
def test_small_radii_have_the_image_of_volpath(renderer, name):
    """One phase function or another, colours apart, liquids in clear and in frosted glass."""
    alike(renderer, getattr(media_scenes, name))


@pytest.mark.slow
def test_media_within_each_other(renderer):
    """Behind boundaries that bend nothing, along which it is too dark by a share that falls like the radius."""
    alike(renderer, media_scenes.nested, radius=0.2, photons=256, block=16)


@pytest.mark.slow
def test_boundaries_within_one_medium_change_nothing(renderer):
    """Photons on the other side are of the same medium, and are gathered."""

    def crossed():
        air = {"type": "ref", "id": "air"}
        cube = {"type": "cube", "to_world": _scale(0.7), "bsdf": {"type": "null"}, "interior": air, "exterior": air}
        return media_scenes.haze() | {"cube": cube}

    alike(renderer, crossed, radius=1.0, photons=64)


@pytest.mark.parametrize("max_depth", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_paths_in_media_are_no_longer_than_the_scene_says(renderer, max_depth):
    def short():
        scene = media_scenes.haze()
        return scene | {"integrator": {"type": "volpath", "max_depth": max_depth}}

    alike(renderer, short)


def test_density_is_not_blurred_in_grids(renderer):
    """Grids that fade have the image of ``volpath``."""
    alike(renderer, media_scenes.wisps, radius=0.6, photons=40, references=32)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["vpm", "gvpm", "bre", "beams"])
def test_the_same_seed_has_the_same_bits_in_grids(renderer, name):
    scene = load(renderer, media_scenes.wisps, (8, 8))
    once, again = (render_ours(scene, name, batches=1, spp=3)[0] for _ in range(2))
    assert all(np.array_equal(once[layer], again[layer]) for layer in once) and once["primal"].any()


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

    def seen():
        return media_scenes.before_the_sky() | {"integrator": {"type": "volpath", "max_depth": 1}}

    scene = load(renderer, seen, (16, 16))
    ours, references = render_ours(scene, name, batches=8, spp=12), render_references(renderer, scene, 8, 64)
    ((_, result),) = gradient_tests([{"primal": stack["primal"]} for stack in ours], references)
    assert result.passed, result


def test_it_converges_in_media(renderer):
    """The squared error of the mean falls with passes; what is left of the blur falls like n^(-4/9) at least."""
    from data_gen.render import render_stack

    scene = load(renderer, fog, (16, 16))
    reference = np.array(renderer.render(scene, spp=4096))

    def error(n):
        x = render_stack(scene, n, 0, "vpm", photons=16, radius=1.0)["primal"]
        return np.mean((x - reference) ** 2 / (reference**2 + 0.01))

    counts = 2, 8, 32
    slope, _ = np.polyfit(np.log(counts), np.log([error(n) for n in counts]), 1)
    assert slope < -4 / 9


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
    ways = Fog(scene, LightEnds(scene), "vpm")
    # Outside of all, in the cloud, in its core, and behind the wall at the back
    points = np.array([[0.9, 0.9, 0.9], [0.5, -0.5, 0.5], [-0.2, 0.2, 0.1], [0.2, 0.1, -3.0]])
    found = np.array(dr.reinterpret_array(mi.UInt32, ways.around(scene, mi.Point3f(points.T))))
    camera = int(dr.reinterpret_array(mi.UInt32, ways.within)[0])
    assert (found == camera).tolist() == [True, False, False, True] and found[1] != found[2] and found.all()


def test_media_and_lights_that_vpm_refuses(renderer):
    from data_gen.render import render_stack
    from data_gen.samplers import find
    from data_gen.scenes.facts import Facts

    with pytest.raises(
        NgptError, match=r"'gbeams' .* media whose density varies.* use --sampler gpt, .*vpm \(no gradients\), or gvpm"
    ):
        render_stack(load(renderer, media_scenes.smoke, (8, 8)), 1, 0, "gbeams")
    with pytest.raises(NgptError, match=r"'gbre' .* media whose density varies; use --sampler gpt, or gvpm, vpm, bre"):
        renderer.load_dict({"type": "gbre"}).prepare(load(renderer, media_scenes.smoke, (8, 8)))

    def endless():
        return media_scenes.haze() | {"sky": {"type": "constant"}}

    with pytest.raises(NgptError, match="infinitely far away comes through a medium without end"):
        render_stack(load(renderer, endless, (8, 8)), 1, 0, "vpm")
    with pytest.raises(NgptError, match="there are no media, and 'ppm' has the same image"):
        find("vpm", Facts("volpath", ()))


def test_a_report_on_grids_names_the_sampler_of_photons(renderer):
    from data_gen.inspect import inspect_scene

    smoke, haze = ("\n".join(inspect_scene(name)["plan"]) for name in ("smoke", "haze"))
    assert "media whose density varies: photons are gathered in them by `--sampler bre`\n" in smoke
    assert "density varies" not in haze
