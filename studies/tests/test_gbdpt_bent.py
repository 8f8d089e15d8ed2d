"""Paths of ``gbdpt`` that go through mirrors or glass beside the vertex that the camera sees, and their copies.

Camera paths do so behind it, up to a vertex that stays; light paths in front of it, from one that stays.
"""

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from bdpt_ends import Ends
from bdpt_scenes import by_a_point, by_a_wall, by_the_sun, lacquered, under_a_sky
from data_gen_scenes import caustics, glass
from path_copies import check_back, close, fresh, plan_of
from renders import dr, mi
from unbiased import load, render_ours

from data_gen.samplers import SAMPLERS
from data_gen.samplers.bdpt import mis
from data_gen.samplers.bdpt.strategies import to_camera
from data_gen.samplers.bdpt.vertex import (
    IMPORTANCE,
    RADIANCE,
    Vertex,
    context,
    cosine,
    evaluate,
    light_leaves,
    scatters_smoothly,
)
from ngpt_studies.gbdpt.pairs import difference_of_one

# Light behind mirrors and glass: where light paths end through them, and where camera paths do
LIT = {"lamp": caustics, "point": by_a_point, "sun": by_the_sun, "wall": by_a_wall}
ENDS = {"lamp": caustics, "wall": by_a_wall, "sky": under_a_sky, "room": glass, "lacquer": lacquered}


def event(si, code, mode, active):
    """The event of that code that a path meets at ``si``: a sample, and f / p."""
    lobe = dr.select(code == 1, mi.Float(0), 1 - dr.epsilon(mi.Float))
    return si.bsdf().sample(context(mode), si, lobe, mi.Point2f(0.5), active)


def some_slow(scenes, quick):
    return [name if name in quick else pytest.param(name, marks=pytest.mark.slow) for name in scenes]


# ------------------------- Camera paths -------------------------


class Bent(Ends):
    """The first camera path of each lane that is bent right behind what the camera sees, up to the end of its chain."""

    def __init__(self, description):
        scene = load(mi, description, (32, 32))
        self.plan = plan_of(scene, pair=difference_of_one)
        super().__init__(scene, spp=64, length=0)

    def camera_path(self, x, end, d):
        from ngpt_studies.gbdpt.base_path import base_step
        from ngpt_studies.gbdpt.chain_shift import along, no_chain, straight

        z = Vertex(x, mi.Spectrum(1), end, mi.UInt32(1))
        active, course, chain, self.good = x.is_valid(), straight(), no_chain(dr.width(d)), mi.Bool(False)
        for depth in range(1, 5):
            step, _ = base_step(self.plan, self.random, z, fresh(), active, brightest_offset=mi.Float(0))
            step, course, chain = along(self.plan, step, course, chain)
            here = active & chain.arrives & ~self.good & dr.all(chain.x1.p == x.p)
            found = (step, chain)
            self.step, self.chain = dr.select(here, found, (self.step, self.chain)) if depth > 1 else found
            self.good |= here
            active = step.goes_on & step.x1.is_valid()
            z = Vertex(step.x1, step.β1, step.end1, mi.UInt32(depth + 1))
            dr.eval(z, active, course, chain, self.step, self.chain, self.good)
        return []

    def own(self, pixels):
        """Where the camera looks so many pixels to the right and half as many down, and what an end knows there."""
        ray, _, inside = self.camera.rays((pixels, pixels / 2))
        x = self.scene.ray_intersect(mi.Ray3f(ray))
        active = self.good & inside & x.is_valid() & self.plan.materials.connectable(x.bsdf())
        return x, self.first_end(x, ray.d), active

    def copy(self, chain, x, end, active):
        from ngpt_studies.gbdpt.chain_shift import follow_chain

        start = SimpleNamespace(β=mi.Spectrum(1), r=mi.Float(1), end=end)
        found = follow_chain(self.plan, self.step, chain, start, x, mi.Bool(active))
        dr.eval(found)
        return found[1:]

    def direction(self, x, active):
        """That in which the copy leaves its own vertex."""
        from ngpt_studies.gbdpt import chain_shift
        from ngpt_studies.gbdpt.manifold import Target, follow, shoot

        step, chain = self.step, self.chain
        reached = step.x1.is_valid()
        target = Target(step.x1.p, dr.select(reached, mi.Vector3f(step.x1.n), step.d), ~reached)
        base = shoot(self.scene, chain.x1, chain.ω, chain.events, target, active)
        to = {"target": target, "active": active, "ends": partial(chain_shift.ends, self.plan)}
        ω, _, _, _ = follow(self.scene, chain.x1, chain.ω, base, x, chain.events, **to)
        dr.eval(ω)
        return ω

    def forward(self, x, ω, end, good):
        """The copy as a camera path: f / p, p of its first direction, and what its end knows where it arrives."""
        scene = self.scene
        f, p, q = evaluate(RADIANCE, x, x.bsdf(), x.to_local(ω), good)
        β, end = f / p, mis.leave(end, cosine(x, ω), p, q, mi.Bool(False))
        si, events = scene.ray_intersect(x.spawn_ray(ω), good), mi.UInt32(self.chain.events)
        end = mis.arrive(end, cosine(si, ω), dr.square(si.t))
        for _ in range(6):
            here = good & (events != 0)
            sample, f_p = event(si, events & 3, RADIANCE, here)
            d1 = si.to_world(sample.wo)
            reached = scene.ray_intersect(si.spawn_ray(d1), here)
            end1 = mis.leave(end, cosine(si, d1), sample.pdf, mi.Float(0), mi.Bool(True))
            end1 = mis.arrive(end1, cosine(reached, d1), dr.square(reached.t))
            si, β, end = dr.select(here, (reached, β * f_p, end1), (si, β, end))
            events >>= 2
            dr.eval(si, β, end, events)
        return β, p, end


@pytest.fixture(scope="module", params=some_slow(("lacquer", "lamp", "wall", "room", "sky"), ("lacquer",)))
def bent(renderer, request):
    return Bent(ENDS[request.param])


def test_a_camera_path_is_its_own_copy_in_its_own_place(bent):
    step = bent.step
    x, end, active = bent.own(0)
    β, r, end1, C, others = bent.copy(bent.chain, x, end, active)
    good, asked = active & (dr.max(β) > 0), np.array(active).sum()
    assert asked > 500 and np.array(good).sum() > 0.9 * asked, (np.array(good).sum(), asked)
    close(r, 1, good)
    close(β, step.β1, good)
    there = np.array(good & step.x1.is_valid())
    if there.any():
        close(end1.vc, step.end1.vc, there)
        assert not np.array(end1.vcm).any() and not np.array(step.end1.vcm)[there].any()
    lit = np.array(good & (dr.max(step.C_met) > 0))
    if lit.sum() > 20:
        close(C, step.C_met, lit)
        close(others, step.others_met, lit & (np.array(step.others_met) > 0))


def test_copies_of_camera_paths_are_paths_that_the_camera_could_have_found(bent):
    """β / r is the copy's own throughput, traced forward; weights are those along it; and the copy's copy is the path,
    with 1 / r. Jacobians by finite differences: test_manifold.py."""
    step, chain = bent.step, bent.chain
    x, end, active = bent.own(0.25)
    β, r, end1, _, _ = bent.copy(chain, x, end, active)
    good, asked = active & (dr.max(β) > 0), np.array(active).sum()
    assert np.array(good).sum() > 0.4 * asked, (np.array(good).sum(), asked)
    # -------------------------- Forward --------------------------
    ω, far = bent.direction(x, good), ~step.x1.is_valid()
    β_own, p, end_own = bent.forward(x, ω, end, good)
    close(β / r, β_own, good, most=0.1)
    there = np.array(good & ~far)
    if there.any():
        close(end1.vc, end_own.vc, there, most=0.1)
    # -------------------------- And back -------------------------
    x0, end0, _ = bent.own(0)
    β0, r0, end2, _, _ = bent.copy(replace(chain, x1=x, ω=ω, p=p), x0, end0, good)
    there = check_back(good, step.β1, r, β0, r0, least=0.97, median=1e-2, most=0.1) & ~np.array(far)
    if there.any():
        close(end2.vc, step.end1.vc, there, median=1e-2, most=0.1)


# ------------------------- Light paths -------------------------


class Caustics(Ends):
    """One light path of each lane up to the first vertex behind mirrors or glass, which the camera sees."""

    def __init__(self, description):
        from ngpt_studies.gbdpt.light_again import first_link, next_link
        from ngpt_studies.gbdpt.light_shift import Splatted

        super().__init__(load(mi, description, (32, 32)), spp=64, length=5)
        self.plan = plan_of(self.scene)
        link, before, found = first_link(), self.from_light[0].vertex, None
        for depth, met in enumerate(self.from_light, 1):
            y, rough = met.vertex, scatters_smoothly(met.bsdf)
            good = met.there & (link.events != 0) & link.whole & rough & self.plan.materials.connectable(met.bsdf)
            here = y, met.d, link, before, good
            found = dr.select(good & ~found[4], here, found) if found else here
            before = dr.select(met.there & rough, y, before)
            link = next_link(link, mi.UInt32(depth), met.sample, mi.Float(1))
            dr.eval(found, before, link)
        y, d, link, before, good = found
        C, others, uv = to_camera(self.eye, self.lens, y, y.si.bsdf(), good, self.seen)
        before_it = {"first": link.depth == 0, "start": self.start, "before": before, "p": link.p}
        before_it |= {"survival": link.survival, "events": link.events}
        self.path = Splatted(y, d, uv, self.lens, C, others, **before_it, allowed=good)
        dr.eval(self.path)

    def camera_path(self, z, end, d):
        return []

    def seen(self, y, to, active):
        return dr.select(self.scene.ray_test(y.si.spawn_ray_to(to.p), active), mi.Float(0), 1)

    def shift(self, path, uv, active):
        """(C', r, others') at that place on the film."""
        from ngpt_studies.gbdpt.light_shift import shifted

        return shifted(self.plan, self.eye, path, uv, active, True)

    def copy(self, pixels):
        """The path's copy so many pixels to the right and half as many down: where it is, and C', r, others'."""
        uv = self.path.uv + mi.Vector2f(pixels, pixels / 2)
        active = self.path.allowed & self.eye.shows(uv) & (dr.max(self.path.C) > 0)
        return uv, active, self.shift(self.path, uv, active)

    def moved(self, uv, good):
        """The copy at ``uv`` as if light had found it: traced forward from the vertex that stays."""
        from ngpt_studies.gbdpt.light_shift import through_glass

        scene, path = self.scene, self.path
        x = scene.ray_intersect(self.eye.ray(uv, path.lens), good)
        d, β, *_ = through_glass(self.plan, path, x, good & x.is_valid())
        good &= dr.max(β) > 0
        dr.eval(x, d, good)
        # ------------------- To the vertex that stays ----------------
        events, ray, last = mi.UInt32(path.events), x.spawn_ray(-d), mi.Point3f(x.p)
        for _ in range(6):
            here = good & (events != 0)
            si = scene.ray_intersect(ray, here)
            last = dr.select(here, si.p, last)
            sample, _ = event(si, events & 3, RADIANCE, here)
            ray = dr.select(here, si.spawn_ray(si.to_world(sample.wo)), ray)
            events >>= 2
            dr.eval(events, ray, last)
        # -------------------------- And back -------------------------
        beyond = mi.SurfaceInteraction3f(x)
        beyond.p = last
        start, ratio, _ = self.lights.redirected(scene, path.start, beyond)
        start.β /= ratio
        before = path.before.si
        away = dr.normalize(last - before.p)
        f, p, q = evaluate(IMPORTANCE, before, before.bsdf(), before.to_local(away), good & ~path.first)
        # What is infinitely far away begins elsewhere.
        far = path.first & self.lights.far(path.start.index)
        origin = dr.select(far, last - 3 * start.ray.d, start.end.p)
        ray = dr.select(path.first, mi.Ray3f(origin, start.ray.d), before.spawn_ray(away))
        d = mi.Vector3f(dr.select(path.first, start.ray.d, away))
        β = dr.select(path.first, start.β, path.before.β * f / p)
        si = scene.ray_intersect(ray, good)
        end = mis.leave(path.before.end, cosine(before, d), p, q, mi.Bool(False))
        e, p_light = self.lights.densities(scene, start, si)
        begun = mis.begin_light(e, p_light, start.delta, cosine(si, d))
        end = dr.select(path.first, begun, mis.arrive(end, cosine(si, d), dr.square(si.t)))
        for k in range(5, -1, -1):
            code = (path.events >> (2 * k)) & 3
            here = good & (code != 0)
            y = Vertex(si, β, end, mi.UInt32(1))
            sample, f_p = event(si, code, IMPORTANCE, here)
            d_next, f_p, left = light_leaves(y, si.bsdf(), sample, f_p, here)
            reached = scene.ray_intersect(si.spawn_ray(d_next), here)
            left = mis.arrive(left, cosine(reached, d_next), dr.square(reached.t))
            si, d, β, end = dr.select(here, (reached, d_next, β * f_p, left), (si, d, β, end))
            dr.eval(si, d, β, end)
        y = Vertex(si, β, end, path.y.depth)
        C, others, uv = to_camera(self.eye, path.lens, y, si.bsdf(), good, self.seen)
        p = dr.select(path.first, path.p, p)
        moved = replace(path, y=y, d=d, uv=uv, C=C, others=others, start=start, p=p)
        dr.eval(moved, good)
        return moved, good


@pytest.fixture(scope="module", params=some_slow(LIT, ("lamp", "sun")))
def caustics(renderer, request):
    return Caustics(LIT[request.param])


def test_a_light_path_is_its_own_copy_in_its_own_place(caustics):
    _, good, (C, r, others) = caustics.copy(0)
    found, path = good & (dr.max(C) > 0), caustics.path
    assert np.array(good).sum() > 500 and np.array(found).sum() > 0.9 * np.array(good).sum()
    close(C, path.C, found)
    close(r, 1, found)
    close(others, path.others, np.array(found) & (np.array(path.others) > 0))


def test_copies_of_light_paths_are_paths_that_light_could_have_found(caustics):
    """C' / r is the contribution of the copy by its own density, traced forward; weights are those along it; and the
    copy's copy is the path, with 1 / r."""
    path = caustics.path
    uv, active, (C, r, others) = caustics.copy(0.25)
    good, asked = active & (dr.max(C) > 0), np.array(active).sum()
    # Of large curved things; where a copy would leave them, there is none.
    assert np.array(good).sum() > 0.4 * asked, (np.array(good).sum(), asked)
    moved, good = caustics.moved(uv, good)
    assert np.quantile(np.linalg.norm(np.array(moved.uv - uv), axis=0)[np.array(good)], 0.95) < 0.1
    lit = good & (dr.max(moved.C) > 0)
    assert np.array(lit).sum() > 0.9 * np.array(good).sum()
    close(C / r, moved.C, lit, most=0.1)
    close(others, moved.others, np.array(lit) & (np.array(others) > 0), most=0.1)
    C_back, r_back, _ = caustics.shift(moved, path.uv, lit)
    check_back(lit, path.C, r, C_back, r_back, least=0.97, median=1e-2, most=0.1)


# ------------------------- In renders -------------------------


@pytest.mark.slow
def test_less_noise_than_without(renderer, monkeypatch):
    """Light of one direction, through a ball, by a mirror and straight to a floor."""
    from ngpt_studies.gbdpt import light_shift

    scene = load(renderer, by_the_sun, (48, 48))
    # Much less of the time goes by with recording kernels.
    monkeypatch.setitem(SAMPLERS, "gbdpt", replace(SAMPLERS["gbdpt"], batch=64))

    def noise():
        layers = render_ours(scene, "gbdpt", 1, 128)[0]
        return layers["dx_var"].mean() + layers["dy_var"].mean()

    def without_glass(plan, path, x, active):
        return renderer.Vector3f(path.d), renderer.Spectrum(0), renderer.Float(0), renderer.Float(0)

    followed = noise()
    monkeypatch.setattr(light_shift, "through_glass", without_glass)
    without = noise()
    assert followed < 0.5 * without, (followed, without)
