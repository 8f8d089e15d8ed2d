"""Maps of photons that know their light paths: the photons of ``ppm`` and ``bre``, their predecessors, and kernels."""

import media_scenes
import numpy as np
import pytest
from bdpt_scenes import SCENES
from photon_copies import traced
from photon_laws import assert_recorded_once, world_of
from photon_laws import traced as photons_of
from unbiased import load

from data_gen.paths import media
from data_gen.paths.light_ends import LightEnds, World
from data_gen.paths.vertex import Materials
from data_gen.samplers.photons.map.fog import Fog
from ngpt_studies.photons.map import trace
from ngpt_studies.photons.map.vertices import vertex_of


def entries(photons, *names):
    """Fields of the vertices of a map, and the rows of their parents among them; other places of the map are empty."""
    exists = np.array(photons.t) > 0
    values = [np.array(getattr(photons, name)).T[exists] for name in names]
    row, parent = np.cumsum(exists) - 1, np.array(photons.parent)[exists]
    first = np.array(photons.density)[exists] == 0
    # Parents of those that begin a further map are in the one before.
    known = np.where(first, 0, np.minimum(parent, len(row) - 1))
    return *values, np.where(first, parent, row[known]), first


def test_vertices_know_their_parents(renderer):
    """From the parent a vertex lies along its direction; what the ray met there is found again."""
    world = world_of(load(renderer, SCENES["glass"], (8, 8)))
    start, (photons,) = traced(world)
    p, n, d, t, depth, parent, first = entries(photons, "p", "n", "d", "t", "depth")
    assert 0 < first.sum() <= 4096 and (parent[~first] < np.flatnonzero(~first)).all()
    origin = np.where(first[:, None], np.array(start.ray.o).T[parent * first], p[parent * ~first])
    assert np.abs(origin + d * t[:, None] - p).max() < 1e-3
    known = ~first & (depth > 0) & (depth[parent] > 0)
    assert known.any() and (depth[known] == depth[parent[known]] + 1).all()
    assert (depth == 0).mean() > 0.05  # on glass
    si = vertex_of(photons, renderer.UInt32(np.flatnonzero(np.array(photons.t) > 0)))
    assert np.abs(np.array(si.p).T - p).max() < 1e-4 and np.array(si.is_valid()).all()
    assert ((np.array(si.n).T * n).sum(axis=1) > 0.999).mean() > 0.999


def test_maps_of_many_vertices_are_cut(renderer, monkeypatch):
    """Into some, which have the same photons each once, whose parents are with them."""
    world = world_of(load(renderer, "diffuse", (8, 8)))
    _, (whole,) = traced(world)
    monkeypatch.setattr(trace, "VERTICES_PER_PATH", 2)
    _, parts = traced(world)
    assert len(parts) > 2

    def gathered(part, name):
        value, depth, *_ = entries(part, name, "depth")
        return value[depth > 0]

    for name in ("p", "β", "d"):
        together = np.concatenate([gathered(part, name) for part in parts])
        assert np.allclose(np.sort(together, axis=0), np.sort(gathered(whole, name), axis=0), rtol=1e-3, atol=1e-4)
    for part in parts:
        p, d, t, depth, parent, first = entries(part, "p", "d", "t", "depth")
        some = ~first & (depth > 0)
        assert np.abs(p[parent[some]] + (d * t[:, None] - p)[some]).max(initial=0) < 1e-3


def in_fog(scene):
    """What photons are traced in, of a scene with media."""
    fog = Fog(scene, scene.sensors()[0], LightEnds(scene), "bre")
    materials = Materials(scene, 0.05, passed=media.index_matched, media=True)
    return World(scene, LightEnds(scene), materials, fog)


@pytest.mark.parametrize(
    ("scene", "edges"), [("diffuse", False), (media_scenes.nested, True), (media_scenes.smoke, True)]
)
def test_photons_are_those_of_maps_without_light_paths(renderer, scene, edges):
    """Bit by bit, in the same places of as many maps: paths of up to 20 edges need three."""
    scene = load(renderer, scene, (8, 8))
    world = in_fog(scene) if edges else world_of(scene)
    _, ours = traced(world, 1024, 20, edges=edges)
    theirs = photons_of(world, 1024, 20)
    assert len(ours) == len(theirs) > 1
    for one, other in zip(ours, theirs, strict=True):
        exists = np.array(other.depth) > 0
        assert np.array_equal(np.array(one.depth) > 0, exists) and exists.any()
        for name in ("p", "n", "d", "β", "depth"):
            one_of, other_of = (np.array(getattr(photons, name)).T[exists] for photons in (one, other))
            assert np.array_equal(one_of, other_of), name


@pytest.mark.slow
def test_kernels_are_recorded_once_and_make_the_same_bits(renderer, monkeypatch, recordings):
    assert_recorded_once(renderer, monkeypatch, recordings, "gpm", least=8)
