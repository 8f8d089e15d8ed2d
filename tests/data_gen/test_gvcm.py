"""What is particular to ``gvcm``: weights of copies with merging, pairs that merging completes, its differences."""

from copy import copy
from dataclasses import replace
from operator import itemgetter

import numpy as np
import pytest
from bdpt_ends import Ends, fresh, plan_of, without_hole
from bdpt_scenes import SCENES, seen_through_glass
from photon_laws import assert_no_bias, gain, passes
from unbiased import far_shifts, light_of_gradients, load, render_ours

# Of so many light paths, or of such a radius, that merging has its share
ETA = 1000.0


class Copies:
    """Camera paths and their copies through another pixel, each as the ``Ends`` of a scene with photons.

    ``base`` and ``copy`` differ by what camera paths they have; ``r``, ``β`` and ``alive`` are those of copies, by
    vertex.
    """

    SHIFT, LENGTH = (2, 1), 5

    def __init__(self, mi):
        import drjit as dr

        from data_gen.paths.camera import CameraSamples
        from data_gen.paths.eye import Eye
        from data_gen.paths.vertex import SMOOTH, Materials
        from data_gen.samplers.bdpt import mis
        from data_gen.samplers.bdpt.vertex import Vertex, cosine
        from data_gen.samplers.gbdpt.base_path import base_step
        from data_gen.samplers.gbdpt.offset_path import own_vertex, start, take_step

        self.mi, self.dr = mi, dr
        self.scene = scene = load(mi, without_hole, (24, 24))
        self.materials = Materials(scene, 0.05)
        self.base = Ends(mi, scene, ETA, self.materials.connectable, spp=64)
        plan = self.plan = plan_of(scene, 12, η=mi.Float(ETA))
        camera = CameraSamples(scene.sensors()[0], 1, 64)
        ray, _, _ = camera.rays()
        random = self.base.random
        x = scene.ray_intersect(mi.Ray3f(ray))
        _, e = camera.sensor.sample_direction(x, camera.lens)
        shifted, importance, inside = camera.rays(self.SHIFT)
        hit = scene.ray_intersect_preliminary(shifted)
        offsets = [start(Eye.of(camera), x, (shifted, importance, inside), hit)]
        z = Vertex(x, mi.Spectrum(1), mis.begin_camera(e[0], cosine(x, ray.d)), mi.UInt32(1))
        active, base, other, self.offsets, self.steps = x.is_valid(), [], [], [], []
        for _ in range(self.LENGTH):
            step, _ = base_step(plan, random, z, fresh(mi), active, brightest_offset=mi.Float(0))
            offset = offsets[0]
            own = own_vertex(offset, z.si)
            alive = active & (dr.max(offset.β) > 0)
            si = dr.select(offset.apart | offset.joined, own, z.si)
            delta = step.kind != SMOOTH
            base.append((z, active, z.si.bsdf(), delta))
            other.append((Vertex(si, offset.β, offset.end, z.depth), alive, si.bsdf(), delta))
            self.steps.append(step)
            self.offsets.append(offset)
            offsets = take_step(plan, step, offsets)
            z = Vertex(step.x1, step.β1, step.end1, z.depth + 1)
            active = step.goes_on & step.x1.is_valid()
            dr.eval(base, other, step, offset, offsets, z, active)
        self.base.from_camera, self.copy = base, copy(self.base)
        self.copy.from_camera = other


@pytest.fixture(scope="module")
def copies(renderer):
    return Copies(renderer)


def weights(copies, t, s):
    """Of copies of ``t`` camera vertices that are connected to ``s`` of a light path: W and r, each beside what it is
    by brute force; and the share of the densities that are those of merging."""
    from data_gen.samplers.bdpt import mis
    from data_gen.samplers.bdpt.strategies import connection
    from data_gen.samplers.bdpt.vertex import Vertex, scatters_smoothly

    dr, connectable = copies.dr, copies.materials.connectable
    (y, _, y_bsdf, _), (own, alive, bsdf, _) = copies.base.from_light[s - 1], copies.copy.from_camera[t - 1]
    good = alive & scatters_smoothly(y_bsdf) & connectable(y_bsdf) & connectable(bsdf)
    for _, there, *_ in copies.base.from_light[:s]:
        good &= there
    C, edge = connection(copies.scene, Vertex(own.si, own.β, own.end, own.depth), bsdf, y, good)
    others = mis.others_connected(own.end, y.end, edge)
    # Mirrors in front of the first rough vertex have Jacobians of their own.
    (z, _, _, bent), (x, *_) = copies.base.from_camera[0], copies.copy.from_camera[0]
    straight = ~bent if t > 1 else ~dr.zeros(copies.mi.Bool, dr.width(C))
    good = np.array(good & straight & (dr.max(C) > 0))
    with np.errstate(divide="ignore", invalid="ignore"):
        p, p1 = copies.base.densities(t, s), copies.copy.densities(t, s)
        J = np.array(x.end.vcm, np.float64) / np.array(z.end.vcm, np.float64)
        found = [1 + np.array(others, np.float64), sum(p1) / p1[s + 1], np.array(copies.offsets[t - 1].r, np.float64)]
        found += [p1[s + 1] * J / p[s + 1], sum(p1[t + s + 2 :]) / sum(p1)]
    good &= np.isfinite(found[1]) & np.isfinite(found[3])
    return [np.broadcast_to(value, good.shape)[good] for value in found]


@pytest.mark.parametrize(("t", "s"), [(1, 1), (1, 2), (2, 1), (2, 2), (3, 2), (4, 1), (4, 2), (5, 1)])
def test_weights_of_copies_count_merging(copies, t, s):
    """At their own vertices, at the one where they join, and behind mirrors and glass beyond that; in float64."""
    W, brute_W, r, brute_r, merged = weights(copies, t, s)
    # Where merging counts little these weights are those of ``gbdpt``.
    much = merged > 0.05
    assert much.sum() > {(2, 2): 15, (5, 1): 30}.get((t, s), -1)
    for ours, theirs in ((W, brute_W), (r, brute_r)):
        error = np.abs(ours / theirs - 1)
        assert len(error) > 100 and np.median(error) < 1e-3 and np.quantile(error, 0.97) < 0.02, np.median(error)
        assert not much.any() or np.quantile(error[much], 0.9) < 0.02, (much.sum(), np.quantile(error[much], 0.9))


def pairs_of(copies, t, number=4096):
    """Base paths at their vertex ``t`` and offset paths there, some of them; and the same the other way."""
    from data_gen.samplers.bdpt.vertex import Vertex

    dr = copies.dr
    (z, there, bsdf, _), (y, alive, own_bsdf, _) = copies.base.from_camera[t - 1], copies.copy.from_camera[t - 1]
    offset = copies.offsets[t - 1]
    good = there & alive & copies.materials.connectable(bsdf) & copies.materials.connectable(own_bsdf)
    good &= offset.apart if t == 1 else offset.joined
    some = np.flatnonzero(np.array(good))
    some = copies.mi.UInt32(some[:: max(1, len(some) // number)])

    def taken(value):
        return dr.gather(type(value), value, some)

    z, y, offset = taken_all((z, y, offset), taken, dr)
    # From the other end the base path is the copy: of its own density.
    own = Vertex(y.si, y.β / offset.r, y.end, y.depth)
    ray = copies.mi.Ray3f(z.si.p + z.si.to_world(z.si.wi), -z.si.to_world(z.si.wi))
    hit = copies.scene.ray_intersect_preliminary(ray)
    back = replace(offset, ray=ray, hit=hit, β=z.β / offset.r, r=1 / offset.r, end=z.end)
    dr.eval(z, own, offset, back)
    return (z, offset), (own, back)


def taken_all(values, taken, dr):
    """``taken`` of all arrays in dataclasses."""
    found = []
    for value in values:
        parts = {name: getattr(value, name) for name in value.__dataclass_fields__}
        found.append(
            type(value)(
                **{
                    name: taken_all((part,), taken, dr)[0] if hasattr(part, "__dataclass_fields__") else taken(part)
                    for name, part in parts.items()
                }
            )
        )
    return found


class Beside:
    """The pairs of vertex ``t``, with a photon beside each on the same surface, and what merging finds of them."""

    def __init__(self, copies, t, radius, number=4096):
        import drjit as dr

        from data_gen.samplers.vcm.differences import ShiftedMerging
        from data_gen.samplers.vcm.merging import Map, Photons

        mi = copies.mi
        self.pairs = pairs_of(copies, t, number)
        z = self.pairs[0][0]
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
        import drjit as dr
        import mitsuba as mi

        x, shifted = self.pairs[end]
        self.photons.η = dr.opaque(mi.Float, η)
        shifted, everywhere = replace(shifted, Δ=dr.zeros(mi.Spectrum, self.n)), dr.full(mi.Bool, True, self.n)
        L, (Δ,) = self.merging.differences(x, x.si.bsdf(), everywhere, [shifted])
        return np.array(L, np.float64), np.array(Δ, np.float64)


@np.errstate(divide="ignore", invalid="ignore")
def check_pairs(copies, t):
    """Δ(y) = -Δ(x), where r r' = 1: at a vertex of the copy's own, and at the one where it joins."""
    # So wide that disks of neighbouring pixels overlap
    beside = Beside(copies, t, 0.4 if t == 1 else 0.05)
    (L, there), (L1, back_again) = beside.found(0), beside.found(1)
    # Some photons may not be near to both, and light may have no way to the copy.
    lit = (L.max(axis=0) > 0) & (L1.max(axis=0) > 0)
    whole = lit & (np.abs(there + 2 * L).max(axis=0) > 1e-3 * L.max(axis=0))
    assert whole.sum() > max(500, 0.5 * lit.sum()), (whole.sum(), lit.sum())
    if t == 1:
        # Those near to one of both bring -2 b / W from there, and nothing from the other end.
        error = np.abs(there - back_again - 2 * (L1 - L)) / (L + L1)
    else:
        error = np.abs(there + back_again) / (np.abs(there) + L)
    assert np.median(error[:, whole]) < 1e-5 and np.quantile(error[:, whole], 0.85) < 1e-2


def check_shared_weight(copies):
    """Δ = 2 (b' - b) / (W(x) + r W(y)) at the vertex where copies join, of points with one photon near by."""
    from scipy.spatial import cKDTree

    beside = Beside(copies, 2, 0.025, number=600)
    points, photons = beside.places
    alone = np.array([len(near) == 1 for near in cKDTree(photons).query_ball_point(points, 0.026)])
    # Where η is beyond all bounds merging has all the weight, W = 1.
    (L, Δ), (L1, _), (b, _), (b1, _) = beside.found(0), beside.found(1), beside.found(0, 1e30), beside.found(1, 1e30)
    r = np.array(beside.pairs[0][1].r, np.float64)
    good = alone & (L.min(axis=0) > 0) & (L1.min(axis=0) > 0)
    assert good.sum() > 100
    W, W1 = (b / L)[:, good], (b1 / L1)[:, good]
    expected = 2 * (r * b1 - b)[:, good] / (W + r[good] * W1)
    error = np.abs(Δ[:, good] - expected) / (b[:, good] / W)
    assert np.median(error) < 1e-4 and np.quantile(error, 0.95) < 1e-2, np.quantile(error, [0.5, 0.95])


def test_pairs_at_shared_vertices_have_the_weight_of_all_strategies(copies):
    check_shared_weight(copies)


@pytest.mark.parametrize("t", [1, 2])
def test_pairs_that_merging_completes_are_the_same_from_both_ends(copies, t):
    check_pairs(copies, t)


# Where nothing but merging finds light, and where all strategies do. Over four pixels no photon is near to both.
QUICK, SLOW = [("glass", 4, 0.5)], [("pane", 1, 2.0), ("caustics", 4, 0.7), ("areas", 4, 0.7), ("glass", 4, 0.1)]


@pytest.mark.parametrize(
    ("name", "pixels", "radius"), QUICK + [pytest.param(*case, marks=pytest.mark.slow) for case in SLOW]
)
def test_differences_are_those_of_the_image(renderer, name, pixels, radius):
    """With the same photons, pass by pass. Where light is found otherwise, too, within a bias that shrinks with r."""
    scene = load(renderer, seen_through_glass if name == "pane" else SCENES[name], (12, 12))
    stacks = passes(scene, 32, pixels, "gvcm", radius=radius)
    assert np.mean([stack["primal"].mean() for stack in stacks]) > 0.01
    assert_no_bias(stacks, pixels)


@pytest.mark.slow
def test_where_nothing_merges_it_is_gbdpt(renderer, monkeypatch):
    """With a radius of nearly nothing: the same paths, splats and shifts from the same random numbers.

    Without glass, through which ``gbdpt`` walks camera paths, and without its roulette of splats.
    """
    from data_gen.samplers.gbdpt import roulette

    monkeypatch.setattr(roulette, "SHARE", float("inf"))
    scene = load(renderer, lambda: {k: v for k, v in SCENES["areas"]().items() if k != "glass"}, (12, 12))
    ours = passes(scene, 2, 1, "gvcm", radius=1e-5, joined_depth=10)
    theirs = passes(scene, 2, 1, "gbdpt")
    for layer in (light_of_gradients, itemgetter("dx"), itemgetter("dy")):
        a, b = (np.stack([layer(stack) for stack in stacks]) for stacks in (ours, theirs))
        # A ray that grazes an edge may go another way where its neighbours are others.
        assert b.any() and np.isclose(a, b, rtol=1e-3, atol=1e-4).mean() > 0.99, layer


@pytest.mark.slow
def test_the_primal_is_that_of_vcm(renderer):
    """The same paths and photons; Russian roulette alone looks at five paths instead of one."""

    def short():
        return SCENES["glass"]() | {"integrator": {"type": "path", "max_depth": 6, "rr_depth": 9}}

    scene = load(renderer, short, (16, 12))
    ours, theirs = (render_ours(scene, sampler, 1, 2, radius=1.0)[0] for sampler in ("gvcm", "vcm"))
    for layer in ("primal", "direct", "albedo", "normal", "depth"):
        assert np.isclose(ours[layer], theirs[layer], rtol=1e-3, atol=1e-5).mean() > 0.99, layer


def test_shifts_by_nothing_find_no_difference(renderer):
    """The copy of a path through its own pixel is the path, but for light paths to the camera, which round."""
    from data_gen.render import render_stack

    scene = load(renderer, seen_through_glass, (12, 12))
    with far_shifts(0):
        layers = render_stack(scene, 2, 0, "gvcm").layers
    assert layers["primal"].any() and not layers["dx"].any() and not layers["dy"].any()


def test_light_that_merging_alone_finds_has_little_noise_in_differences(renderer):
    """Of photons that are near to both of two pixels; a sampler that rejects all is unbiased as well. Measured: 1.9."""
    mean, median = gain(passes(load(renderer, seen_through_glass, (32, 32)), 8, 1, "gvcm", radius=3.0))
    assert mean > 1.5 and median > 1.5, (mean, median)
