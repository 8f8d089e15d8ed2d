"""Photons in media: what ``vpm`` converges to and how fast, where light begins, and what it refuses.

That it repeats its bits, says how noisy it is and stays within its memory is among the laws of all samplers.
"""

import media_scenes
import numpy as np
import pytest
from unbiased import gradient_tests, load, render_ours, render_references

from ngpt.errors import NgptError


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
    ways = Fog(scene, scene.sensors()[0], LightEnds(scene), "vpm")
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
    with pytest.raises(NgptError, match=r"'gbre' .* media whose density varies, .*; use --sampler gpt, .* or bre"):
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
