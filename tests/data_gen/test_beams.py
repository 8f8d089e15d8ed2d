"""Photon beams: what ``beams`` converges to, how beams are cut into parts, and where they are nearest to rays.

That it repeats its bits, says how noisy it is and stays within its memory is among the laws of all samplers; lamps
within media and what is refused are those of ``vpm``, camera paths those of ``bre``.
"""

import media_scenes
import numpy as np
import pytest
from data_gen_scenes import fog
from test_photons import assert_alike
from unbiased import REFERENCES, light_of_gradients, load, render_ours


def alike(renderer, scene, radius=0.4, photons=24, block=4, batches=6, sampler="beams", **options):
    scene = load(renderer, scene, (16, 16))
    ours = render_ours(scene, sampler, batches=batches, spp=1, radius=radius, photons=photons, **options)
    theirs = render_ours(scene, "primal", batches=batches, spp=128, seed=REFERENCES)
    # Light that is seen directly is its expectation in ours, and has its own edges.
    images, references = (np.stack([light_of_gradients(s) for s in stacks]) for stacks in (ours, theirs))
    assert references.mean() > 0.01
    assert_alike(images, references, block)


SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in ("haze", "forward", "milk", "dense", "nested")]


@pytest.mark.parametrize("name", ["colours", *SLOW])
def test_small_radii_have_the_image_of_volpath(renderer, name):
    """Without a surface behind as well, where beams end with their edges; through media within each other; in glass."""
    alike(renderer, getattr(media_scenes, name), block=16 if name == "nested" else 8 if name == "milk" else 4)


@pytest.mark.slow
def test_beams_go_through_grids(renderer):
    """Up to where their light path scatters, by its null collisions; colours of the grid apart, in mist."""
    alike(renderer, media_scenes.wisps, radius=0.3, photons=24, block=8)


@pytest.mark.slow
def test_beams_go_on_behind_boundaries(renderer):
    """In from outside, where the lamp is, and out again."""
    alike(renderer, fog)


@pytest.mark.slow
def test_paths_of_beams_are_no_longer_than_the_scene_says(renderer):
    """With two edges light is scattered once, in the medium or on a surface."""

    def short():
        return media_scenes.haze() | {"integrator": {"type": "volpath", "max_depth": 2}}

    alike(renderer, short)


def test_lines_are_nearest(renderer):
    """Against the least distance of many pairs of points."""
    import drjit as dr

    from data_gen.samplers.photons.media.beams import nearest

    mi, rng = renderer, np.random.default_rng(0)
    o, p = rng.normal(size=(2, 3, 200)) * 0.3
    d, e = rng.normal(size=(2, 3, 200))
    d, e = d / np.linalg.norm(d, axis=0), e / np.linalg.norm(e, axis=0)
    s, t, aside, sin = (np.array(x) for x in nearest(mi.Point3f(o), mi.Vector3f(d), mi.Point3f(p), mi.Vector3f(e)))
    known = sin > 0.1
    assert np.allclose(sin, np.sqrt(1 - (d * e).sum(axis=0) ** 2), atol=1e-4) and known.sum() > 150

    def apart(s, t):
        return np.linalg.norm(o + d * t - p - e * s, axis=0)

    assert np.allclose(apart(s, t)[known], aside[known], atol=1e-4)
    for i, j in ((1, 0), (0, 1), (1, 1), (-1, 1)):
        assert (apart(s + 0.01 * i, t + 0.01 * j) > aside - 1e-5)[known].all()
    assert dr.width(mi.Float(s)) == 200


@pytest.mark.slow
def test_beams_are_cut_the_same_in_windows(renderer, monkeypatch):
    """All parts at once, or few at a time: the same light."""
    from data_gen.render import render_stack
    from data_gen.samplers.photons.media import beams

    scene = load(renderer, media_scenes.haze, (8, 8))
    whole = render_stack(scene, 2, 0, "beams", photons=4)["primal"]
    monkeypatch.setattr(beams, "PARTS", 1)
    assert np.allclose(render_stack(scene, 2, 0, "beams", photons=4)["primal"], whole, rtol=1e-4)


def test_beams_have_less_noise_than_points(renderer):
    """Of the same light paths, in thin fog."""
    scene = load(renderer, media_scenes.haze, (16, 16))
    noise = []
    for name in ("beams", "bre"):
        images = np.stack([s["primal"] for s in render_ours(scene, name, batches=5, spp=1, radius=0.5, photons=2)])
        noise.append(images.var(axis=0, ddof=1).mean())
    assert noise[0] < noise[1] / 2


@pytest.mark.slow
def test_it_converges_by_beams(renderer):
    """The squared error of the mean over n passes falls like n^(-2/3) or faster."""
    from data_gen.render import render_stack

    scene = load(renderer, fog, (16, 16))
    reference = np.array(renderer.render(scene, spp=4096, seed=REFERENCES))

    def error(n):
        x = render_stack(scene, n, 0, "beams", photons=2, radius=1.0)["primal"]
        return np.mean((x - reference) ** 2 / (reference**2 + 0.01))

    counts = 2, 8, 32
    slope, _ = np.polyfit(np.log(counts), np.log([error(n) for n in counts]), 1)
    assert slope < -0.6
