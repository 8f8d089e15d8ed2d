"""The beam radiance estimate: what it gathers beside rays, of the grid and across boundaries.

That it repeats its bits, says how noisy it is and stays within its memory is among the laws of all samplers; lamps
within media and what is refused are those of ``vpm``.
"""

import media_scenes
import numpy as np
import pytest
from data_gen_scenes import _scale
from unbiased import load, render_ours


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
