"""Paths that are shared in tiles: who shares with whom, by which weights, and what it brings."""

from functools import cache

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from unbiased import load

from data_gen.paths.camera import CameraSamples
from data_gen.samplers import find

SIZE = (8, 6)


class Tile:
    """All connections of one sample per pixel, as NumPy arrays by lane, and the geometry they come from."""

    def __init__(self, mi, side):
        from ngpt_studies import gpt_tiles

        scene = load(mi, "diffuse", SIZE)
        tiles = find("gpt-tiles").made(scene, tile=side)
        camera = CameraSamples(scene.sensors()[0], 5, 4)
        gpt_tiles.keep_in_step(camera)
        _, paths = tiles.trace(camera)
        self.grid = gpt_tiles.Grid(camera, side)
        links = self.grid.others()
        self.connections = [paths.own, *(tiles.connect(camera, paths, link)[0] for link in links)]
        first = paths.hit.compute_surface_interaction(mi.Ray3f(camera.rays()[0]))
        s = paths.suffix.s.compute_surface_interaction(mi.Ray3f(paths.suffix.o, paths.suffix.d))
        self.x, self.n, self.s, self.n_s = (np.array(v, np.float64).T for v in (first.p, first.n, s.p, s.n))
        self.shared = np.array(paths.suffix.shared & s.is_valid() & first.is_valid())
        members = list(zip([None, *links], self.connections, strict=True))
        self.balanced = lambda: np.array(gpt_tiles.balanced(members)).T
        self.lanes = np.array([np.array(self.grid.lane), *(np.array(link.lane) for link in links)])
        self.active = np.array([np.ones_like(self.shared), *(np.array(link.active) for link in links)])
        self.q1, self.q2 = (np.array([np.array(getattr(c, q)) for c in self.connections]) for q in ("q1", "q2"))
        dr.eval()


@pytest.fixture(scope="module")
def tiles(renderer):
    return cache(lambda side: Tile(renderer, side))


@pytest.mark.parametrize("side", [2, 4])
def test_links_lead_back_and_a_tile_is_the_same_for_all_in_it(tiles, side):
    tile = tiles(side)
    here = np.arange(tile.lanes.shape[1])
    members = []
    for lanes, active in zip(tile.lanes, tile.active, strict=True):
        assert np.array_equal(lanes[lanes[active]], here[active])
    for lane in here:
        members.append(set(tile.lanes[tile.active[:, lane], lane]))
        assert lane in members[-1] and len(members[-1]) == tile.active[:, lane].sum()
    assert all(members[other] == members[lane] for lane in here for other in members[lane])
    for axis in (0, 1):
        across = tile.grid.across(axis)
        lanes, active = np.array(across.lane), np.array(across.active)
        assert np.array_equal(lanes[lanes[active]], here[active])
        assert not any(lanes[lane] in members[lane] for lane in here[active])
    # Of four samples, each pair of neighbours is in one tile as often as sides of tiles allow.
    if side == 2:
        together = [lane + 4 in members[lane] for lane in range(4)]
        assert sorted(together) == [False, False, True, True]


def test_denominators_are_sums_of_densities(tiles):
    """By brute force in double precision, of densities in area at s, which know nothing of any Jacobian."""
    tile, compared = tiles(2), 0

    def density(k, j):
        """The density of s_j by cosine sampling at x_k."""
        to = tile.s[j] - tile.x[k]
        distance = np.linalg.norm(to)
        cos, cos_s = (abs(np.dot(normal, to)) / distance for normal in (tile.n[k], tile.n_s[j]))
        return cos * cos_s / np.pi / distance**2

    for j in np.flatnonzero(tile.shared):
        members = [(tile.q1[m, k], k) for m, k in enumerate(tile.lanes[:, j]) if tile.active[m, j]]
        kernel = sum(q for q, _ in members) / tile.q1[0, j]
        assert kernel == pytest.approx(sum(density(k, j) for q, k in members if q > 0) / density(j, j), rel=0.02)
        compared += kernel > 1.5
    assert compared > 0.5 * tile.shared.sum()


def test_weights_of_a_path_add_up_to_one(renderer):
    """If C = q everywhere, then each suffix brings 1 to its tile, shared out over its pixels."""
    tile = Tile(renderer, 2)
    for connection in tile.connections:
        connection.C1, connection.C2 = mi.Color3f(connection.q1), mi.Color3f(connection.q2)
    expected = (tile.q1[0] > 0).sum() + (tile.q2[0] > 0).sum()
    assert tile.balanced()[:, 0].sum() == pytest.approx(expected, rel=1e-5)
