"""What is particular to ``gvcm``: weights of copies with merging, and pairs by merging."""

from dataclasses import replace

import numpy as np
import pytest
from bdpt_ends import without_hole
from path_copies import Copies, check_copies_to_the_camera, check_going_straight_and_back, compare_copies
from renders import dr, mi
from scipy.spatial import cKDTree
from test_holes import assert_connections_go_on_through_many_holes
from unbiased import load

from data_gen.samplers.bdpt.vertex import Vertex
from data_gen.samplers.vcm.merging import Map, Photons


@pytest.fixture(scope="module")
def copies(renderer):
    """With so many light paths, or such a radius, that merging has its share."""
    return Copies(load(renderer, without_hole, (24, 24)), (2, 1), η=1000.0, length=5)


@pytest.mark.parametrize(("t", "s"), [(1, 1), (1, 2), (2, 1), (2, 2), (3, 2), (4, 1), (4, 2), (5, 1)])
def test_weights_of_copies_count_merging(copies, t, s):
    """At their own vertices, at the one where they join, and behind mirrors and glass beyond that."""
    C, found, base, copy, strategy, good = copies.joined(t, s)
    errors, good = compare_copies(C, found, base, copy, strategy, good)
    # Where merging counts little, ``gbdpt`` has the same weights.
    densities = np.stack([np.broadcast_to(p, good.shape)[good] for p in copy[0]])
    much = densities[t + s + 2 :].sum(axis=0) > 0.05 * densities.sum(axis=0)
    assert much.sum() > {(2, 2): 10, (5, 1): 30}.get((t, s), -1)
    assert not much.any() or np.quantile(errors[:, much], 0.9, axis=1).max() < 0.02


@pytest.mark.parametrize("s", [1, 2])
def test_copies_of_light_paths_to_the_camera_and_back(copies, s):
    check_copies_to_the_camera(copies, s)


def test_going_straight_to_a_vertex_and_back(copies):
    check_going_straight_and_back(copies)


class Beside:
    """Copies at their vertex ``t``, the same the other way, and a photon beside each vertex on the same surface."""

    def __init__(self, copies, t, radius, number=4096):
        from ngpt_studies.photons.gvcm import ShiftedMerging

        connectable = copies.materials.connectable
        base, own, offset = copies.from_camera[t - 1], copies.copied[t - 1], copies.offsets[t - 1]
        good = base.there & own.there & connectable(base.bsdf) & connectable(own.bsdf)
        some = np.flatnonzero(np.array(good & (offset.apart if t == 1 else offset.joined)))
        some = mi.UInt32(some[:: max(1, len(some) // number)])
        parts = ((v.si, v.β, v.end, v.depth) for v in (base.vertex, own.vertex))
        z, y = (Vertex(*(dr.gather(type(part), part, some) for part in each)) for each in parts)
        # What a scene without holes does not have is None.
        parts = {name: v for name, v in vars(offset).items() if v is not None}
        offset = replace(offset, **{name: dr.gather(type(v), v, some) for name, v in parts.items()})
        # From the other end the base path is the copy: of its own density.
        ray = mi.Ray3f(z.si.p + z.si.to_world(z.si.wi), -z.si.to_world(z.si.wi))
        hit = copies.scene.ray_intersect_preliminary(ray)
        back = replace(offset, ray=ray, hit=hit, β=z.β / offset.r, r=1 / offset.r, end=z.end)
        self.pairs = (z, offset), (Vertex(y.si, y.β / offset.r, y.end, y.depth), back)
        dr.eval(self.pairs)
        self.n = n = dr.width(z.depth)
        kept, turned = Map.empty(n, 1), np.random.default_rng(0).normal(size=(3, n)).astype(np.float32)
        d = -dr.normalize(z.si.n * 1.2 + dr.normalize(mi.Vector3f(turned)))
        aside = dr.cross(z.si.n, dr.normalize(mi.Vector3f(turned))) * 0.02
        fields = {"o": z.si.p + aside - d, "d": d, "t": 1, "n": z.si.n, "β": 1.0, "vcm": 1, "vc": 0.3, "depth": 2}
        for name, value in fields.items():
            old = getattr(kept.vertices, name)
            setattr(kept.vertices, name, type(old)(value) + dr.zeros(type(old), n))
        kept.photon = dr.full(mi.UInt32, 1, n)
        self.photons = Photons(kept, radius, n, mi.UInt32(0))
        self.places = np.array(z.si.p).T, np.array(z.si.p + aside).T
        self.merging = ShiftedMerging(self.photons, copies.plan)

    def found(self, end, η=1.0):
        """L and Δ of the base paths of that ``end``, 0 or 1, where paths merge with this η: (3, n) of each."""
        x, shifted = self.pairs[end]
        self.photons.η = dr.opaque(mi.Float, η)
        shifted, everywhere = replace(shifted, Δ=dr.zeros(mi.Spectrum, self.n)), dr.full(mi.Bool, True, self.n)
        L, (Δ,) = self.merging.differences(x, x.si.bsdf(), everywhere, [shifted])
        return np.array(L, np.float64), np.array(Δ, np.float64)


def test_pairs_at_shared_vertices_have_the_weight_of_all_strategies(copies):
    """Δ = 2 (b' - b) / (W(x) + r W(y)) at the vertex where copies join, of points with one photon near by."""
    beside = Beside(copies, 2, 0.025, number=600)
    points, photons = beside.places
    alone = np.array([len(near) == 1 for near in cKDTree(photons).query_ball_point(points, 0.026)])
    # Where η is beyond all bounds merging has all the weight, W = 1.
    (L, Δ), (L1, _), (b, _), (b1, _) = (beside.found(*args) for args in ((0,), (1,), (0, 1e30), (1, 1e30)))
    r = np.array(beside.pairs[0][1].r, np.float64)
    good = alone & (L.min(axis=0) > 0) & (L1.min(axis=0) > 0)
    assert good.sum() > 100
    L, Δ, L1, b, b1, r = (value[..., good] for value in (L, Δ, L1, b, b1, r))
    error = np.abs(Δ - 2 * (r * b1 - b) / (b / L + r * b1 / L1)) / L
    assert np.median(error) < 1e-4 and np.quantile(error, 0.95) < 1e-2, np.quantile(error, [0.5, 0.95])


@pytest.mark.parametrize("t", [1, 2])
def test_pairs_that_merging_completes_are_the_same_from_both_ends(copies, t):
    """Δ(y) = -Δ(x), where r r' = 1: at a vertex of the copy's own, and at the one where it joins."""
    # So wide that disks of neighbouring pixels overlap
    beside = Beside(copies, t, 0.4 if t == 1 else 0.05)
    (L, there), (L1, back_again) = beside.found(0), beside.found(1)
    # Some photons may not be near to both, and light may have no way to the copy.
    lit = (L.max(axis=0) > 0) & (L1.max(axis=0) > 0)
    whole = lit & (np.abs(there + 2 * L).max(axis=0) > 1e-3 * L.max(axis=0))
    assert whole.sum() > max(500, 0.5 * lit.sum()), (whole.sum(), lit.sum())
    L, L1, there, back_again = (value[:, whole] for value in (L, L1, there, back_again))
    if t == 1:
        # Those near to one of both bring -2 b / W from there, and nothing from the other end.
        error = np.abs(there - back_again - 2 * (L1 - L)) / (L + L1)
    else:
        error = np.abs(there + back_again) / (np.abs(there) + L)
    assert np.median(error) < 1e-5 and np.quantile(error, 0.85) < 1e-2


@pytest.mark.slow
@pytest.mark.parametrize("sampler", ["gbdpt", "gvcm"])
def test_connections_go_on_through_many_holes(renderer, sampler):
    assert_connections_go_on_through_many_holes(renderer, sampler)
