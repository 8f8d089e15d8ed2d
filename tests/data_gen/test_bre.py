"""The beam radiance estimate: what ``bre`` converges to and how fast, how much less noise it has than ``vpm``.

That it repeats its bits, says how noisy it is and stays within its memory is among the laws of all samplers; lamps
within media and what is refused are those of ``vpm``.
"""

import media_scenes
import numpy as np
import pytest
from data_gen_scenes import _scale, fog
from test_photons import assert_alike
from unbiased import light_of_gradients, load, render_ours


def alike(renderer, scene, radius=0.4, photons=96, block=4, batches=6, references=128):
    scene = load(renderer, scene, (16, 16))
    ours = render_ours(scene, "bre", batches=batches, spp=1, radius=radius, photons=photons)
    theirs = render_ours(scene, "primal", batches=batches, spp=references)
    # Light that is seen directly is its expectation in ours, and has its own edges.
    images, references = (np.stack([light_of_gradients(s) for s in stacks]) for stacks in (ours, theirs))
    assert references.mean() > 0.01
    assert_alike(images, references, block)


@pytest.mark.parametrize(
    ("name", "block"), [pytest.param("forward", 4, marks=pytest.mark.slow), ("colours", 4), ("milk", 8)]
)
def test_small_radii_have_the_image_of_volpath(renderer, name, block):
    """One phase function or another, colours apart, liquids in clear and in frosted glass: few photons get there."""
    alike(renderer, getattr(media_scenes, name), block=block, batches=10 if name == "milk" else 6)


@pytest.mark.slow
def test_media_within_each_other(renderer):
    """Behind boundaries that bend nothing, along which it is too dark by a share that falls like the radius."""
    alike(renderer, media_scenes.nested, radius=0.15, photons=192, block=16)


def test_boundaries_within_one_medium_change_nothing(renderer):
    """The ray is cut there into two pieces, which gather each photon once."""

    def crossed():
        air = {"type": "ref", "id": "air"}
        cube = {"type": "cube", "to_world": _scale(0.7), "bsdf": {"type": "null"}, "interior": air, "exterior": air}
        return media_scenes.haze() | {"cube": cube}

    images = []
    for scene in (media_scenes.haze, crossed):
        images.append(render_ours(load(renderer, scene, (16, 16)), "bre", 1, 3, radius=1.0, photons=8)[0]["primal"])
    # What lies in front of the same photons; the lamp's rays pass another surface, and end in the last bits elsewhere.
    assert np.abs(images[0] - images[1]).mean() < 0.02 * images[0].mean()


def test_rays_go_through_grids(renderer):
    """Up to a collision, by null ones; colours of the grid apart, density not blurred, in mist."""
    alike(renderer, media_scenes.wisps, radius=0.3, photons=64, block=8, references=32)


def test_paths_in_media_are_no_longer_than_the_scene_says(renderer):
    """With two edges light is scattered once, in the medium or on a surface."""

    def short():
        return media_scenes.haze() | {"integrator": {"type": "volpath", "max_depth": 2}}

    alike(renderer, short, radius=0.3, photons=48)


def test_it_converges_in_media(renderer):
    """The squared error of the mean over n passes falls like n^(-2/3) or faster, as on surfaces."""
    from data_gen.render import render_stack

    scene = load(renderer, fog, (16, 16))
    reference = np.array(renderer.render(scene, spp=4096))

    def error(n):
        x = render_stack(scene, n, 0, "bre", photons=8, radius=1.0)["primal"]
        return np.mean((x - reference) ** 2 / (reference**2 + 0.01))

    counts = 2, 8, 32
    slope, _ = np.polyfit(np.log(counts), np.log([error(n) for n in counts]), 1)
    assert slope < -0.6


def test_rays_have_less_noise_than_points(renderer):
    """Of the same photons; 25 times less was measured in ``haze``."""
    scene = load(renderer, media_scenes.haze, (16, 16))
    noise = []
    for name in ("bre", "vpm"):
        images = np.stack([s["primal"] for s in render_ours(scene, name, batches=5, spp=1, radius=1.0, photons=4)])
        noise.append(images.var(axis=0, ddof=1).mean())
    assert noise[0] < noise[1] / 5


@pytest.mark.parametrize("radius", [0.3, 0.05, 0.01])
def test_the_grid_finds_what_is_beside_a_ray(renderer, radius):
    """Each point once, whatever its cell, on and beyond the box too; rays without end are cut at the box."""
    import drjit as dr

    from data_gen.samplers.photons.map.grid import Grid
    from data_gen.samplers.photons.media.bre import BALL

    mi, rng = renderer, np.random.default_rng(0)
    points = (rng.random((3000, 3)) * [2, 1, 0.2] - [1, 0, 0]).astype(np.float32)
    exist = rng.random(3000) < 0.8
    grid = Grid(mi.Point3f(points.T), mi.Bool(exist), BALL * radius)
    o = (rng.random((500, 3)) * [4, 2, 1] - [2, 0.5, 0.5]).astype(np.float32)
    d = rng.normal(size=(500, 3)).astype(np.float32)
    d[:9], d[9:18] = [0, 0, 1], [-1, 0, 0]
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    length = np.where(rng.random(500) < 0.3, np.inf, rng.random(500) * 2).astype(np.float32)
    active = np.arange(500) % 7 != 0
    numbers = mi.UInt32(np.arange(1, 3001))

    def add(sums, i, near):
        j = dr.gather(mi.UInt32, grid.index, i, near)
        return (sums[0] + dr.select(near, dr.gather(mi.UInt32, numbers, j, near), 0),)

    ray = mi.Ray3f(mi.Point3f(o.T), mi.Vector3f(d.T))
    found = grid.along(ray, mi.Float(length), mi.Float(radius**2), mi.Bool(active), add, (dr.zeros(mi.UInt32, 500),))
    to = points[None] - o[:, None]
    t = (to * d[:, None]).sum(axis=-1)
    aside = np.linalg.norm(to - t[..., None] * d[:, None], axis=-1)

    def total(margin):
        near = (aside < radius * (1 + margin)) & (t > -margin) & (t < length[:, None] + margin)
        return (near & exist & active[:, None]) @ np.arange(1, 3001)

    # What is on the edge may be rounded to either side.
    low, high, found = total(-1e-4), total(1e-4), np.array(found[0])
    assert ((low <= found) & (found <= high)).all() and (low > 0).sum() > 20 and (low == high).mean() > 0.9
