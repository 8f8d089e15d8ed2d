"""Camera paths of ``gbdpt`` that go through mirrors or glass behind their first vertex, and their copies."""

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pytest
from bdpt_ends import close, fresh, number, plan_of
from bdpt_scenes import ENDS
from data_gen_scenes import glass
from unbiased import load, render_ours


class Start(NamedTuple):
    """The copy at its own vertex."""

    β: Any
    r: Any
    end: Any


class Bent:
    """The first camera path of each lane that is bent right behind what the camera sees, up to the end of its chain."""

    LENGTH = 4

    def __init__(self, mi, description):
        import drjit as dr

        from data_gen.paths.camera import CameraSamples
        from data_gen.samplers.bdpt.vertex import Vertex
        from data_gen.samplers.gbdpt.base_path import base_step
        from data_gen.samplers.gbdpt.chain_shift import along, no_chain, straight
        from data_gen.samplers.gbdpt.pairs import difference_of_one

        self.mi, self.dr = mi, dr
        self.scene = scene = load(mi, description, (32, 32))
        self.camera = camera = CameraSamples(scene.sensors()[0], 1, 64)
        self.plan = plan = plan_of(scene, pair=difference_of_one)
        ray, _, _ = camera.rays()
        random, x = camera.random.clone(), scene.ray_intersect(mi.Ray3f(ray))
        z = Vertex(x, mi.Spectrum(1), self.first_end(x, ray), mi.UInt32(1))
        active, course, chain = x.is_valid(), straight(), no_chain(dr.width(ray))
        self.good, self.β = mi.Bool(False), mi.Spectrum(0)
        for depth in range(1, self.LENGTH + 1):
            z.depth = mi.UInt32(depth)
            step, _ = base_step(plan, random, z, fresh(mi), active, brightest_offset=mi.Float(0))
            step, course, chain = along(plan, step, course, chain)
            here = active & chain.arrives & ~self.good & dr.all(chain.x1.p == x.p)
            found = (step, chain)
            self.step, self.chain = dr.select(here, found, (self.step, self.chain)) if depth > 1 else found
            self.good |= here
            active = step.goes_on & step.x1.is_valid()
            z = Vertex(step.x1, step.β1, step.end1, mi.UInt32(depth + 1))
            dr.eval(z, active, course, chain, self.step, self.chain, self.good)

    def first_end(self, x, ray):
        from data_gen.samplers.bdpt import mis
        from data_gen.samplers.bdpt.vertex import cosine

        _, e = self.camera.sensor.sample_direction(x, self.camera.lens)
        return mis.begin_camera(e[0], cosine(x, ray.d))

    def own(self, pixels):
        """Where the camera looks so many pixels to the right and half as many down, and what an end knows there."""
        ray, _, inside = self.camera.rays((pixels, pixels / 2))
        x = self.scene.ray_intersect(self.mi.Ray3f(ray))
        active = self.good & inside & x.is_valid() & self.plan.materials.connectable(x.bsdf())
        return x, self.first_end(x, ray), active

    def copy(self, step, chain, x, end, active):
        from data_gen.samplers.gbdpt.chain_shift import follow_chain

        start = Start(self.mi.Spectrum(1), self.mi.Float(1), end)
        found = follow_chain(self.plan, step, chain, start, x, self.mi.Bool(active))
        self.dr.eval(found)
        return found

    def direction(self, x, active):
        """That in which the copy leaves its own vertex."""
        from functools import partial

        from data_gen.paths.manifold import Target, follow, shoot
        from data_gen.samplers.gbdpt import chain_shift

        step, chain, dr = self.step, self.chain, self.dr
        reached = step.x1.is_valid()
        target = Target(step.x1.p, dr.select(reached, self.mi.Vector3f(step.x1.n), step.d), ~reached)
        base = shoot(self.scene, chain.x1, chain.ω, chain.events, target, active)
        ends = partial(chain_shift.ends, self.plan)
        to = {"target": target, "active": active, "ends": ends}
        ω, _, _, _ = follow(self.scene, chain.x1, chain.ω, base, x, chain.events, **to)
        dr.eval(ω)
        return ω


@pytest.fixture(
    scope="module",
    params=["lacquer", *(pytest.param(name, marks=pytest.mark.slow) for name in ("lamp", "wall", "room", "sky"))],
)
def bent(renderer, request):
    return Bent(renderer, ENDS[request.param])


def test_a_path_is_its_own_copy_in_its_own_place(bent):
    dr = bent.dr
    x, end, active = bent.own(0)
    asked = np.array(active).sum()
    assert asked > 500
    _, β, r, end1, C, others = bent.copy(bent.step, bent.chain, x, end, active)
    good = active & (dr.max(β) > 0)
    assert np.array(good).sum() > 0.9 * asked, (np.array(good).sum(), asked)
    close(r, 1, good)
    close(β, bent.step.β1, good)
    there = np.array(good & bent.step.x1.is_valid())
    if there.any():
        close(end1.vc, bent.step.end1.vc, there)
        assert not np.array(end1.vcm).any() and not np.array(bent.step.end1.vcm)[there].any()
    lit = np.array(good & (dr.max(bent.step.C_met) > 0))
    if lit.sum() > 20:
        close(C, bent.step.C_met, lit)
        close(others, bent.step.others_met, lit & (np.array(bent.step.others_met) > 0))


def forward(bent, x, ω, end, good):
    """The copy as a camera path: the point where it arrives, its direction, f / p, both densities, and what its end
    knows there."""
    from data_gen.samplers.bdpt import mis
    from data_gen.samplers.bdpt.vertex import RADIANCE, cosine, evaluate

    mi, dr, scene = bent.mi, bent.dr, bent.scene
    f, p, q = evaluate(RADIANCE, x, x.bsdf(), x.to_local(ω), good)
    P, β, end, d = mi.Float(1), f / p, mis.leave(end, cosine(x, ω), p, q, mi.Bool(False)), mi.Vector3f(ω)
    si, events = scene.ray_intersect(x.spawn_ray(ω), good), mi.UInt32(bent.chain.events)
    end = mis.arrive(end, cosine(si, d), dr.square(si.t))
    for _ in range(6):
        here = good & (events != 0)
        sample, f_p = si.bsdf().sample(mi.BSDFContext(), si, number(mi, dr, events & 3), mi.Point2f(0.5), here)
        d1 = si.to_world(sample.wo)
        reached = scene.ray_intersect(si.spawn_ray(d1), here)
        end1 = mis.leave(end, cosine(si, d1), sample.pdf, mi.Float(0), mi.Bool(True))
        end1 = mis.arrive(end1, cosine(reached, d1), dr.square(reached.t))
        si, d, β, P, end = dr.select(here, (reached, d1, β * f_p, P * sample.pdf, end1), (si, d, β, P, end))
        events >>= 2
        dr.eval(si, d, β, P, end, events)
    return si, d, β, p, P, end


def spread(bent, x, ω, end, good, h=1e-3):
    """The area that directions about ω light where their chains arrive, by finite differences."""
    mi, dr = bent.mi, bent.dr
    frame = mi.Frame3f(ω)
    corners = [
        forward(bent, x, dr.normalize(ω + h * turn), end, good)[0].p for turn in (frame.s, -frame.s, frame.t, -frame.t)
    ]
    s0, s1, t0, t1 = (np.array(corner, np.float64).T for corner in corners)
    return np.linalg.norm(np.cross(s0 - s1, t0 - t1), axis=-1)


def test_copies_are_paths_that_the_camera_could_have_found(bent):
    """β / r is the copy's own throughput, traced forward; weights are those along it; and the copy's copy is the path,
    with 1 / r."""
    dr = bent.dr
    x, end, active = bent.own(0.25)
    asked = np.array(active).sum()
    _, β, r, end1, _, _ = bent.copy(bent.step, bent.chain, x, end, active)
    good = active & (dr.max(β) > 0)
    assert np.array(good).sum() > 0.4 * asked, (np.array(good).sum(), asked)
    # -------------------------- Forward --------------------------
    ω = bent.direction(x, good)
    si, d, β_own, p, P, end_own = forward(bent, x, ω, end, good)
    far = ~bent.step.x1.is_valid()
    off = dr.select(far, dr.norm(d - bent.step.d), dr.norm(si.p - bent.step.x1.p))
    assert np.quantile(np.array(off)[np.array(good)], 0.95) < 3e-3
    close(β / r, β_own, good, most=0.1)
    there = np.array(good & ~far)
    if there.any():
        close(end1.vc, end_own.vc, there, most=0.1)
    # ---------------------- Brute force for r --------------------
    x0, end0, _ = bent.own(0)
    base = forward(bent, x0, bent.chain.ω, end0, good)
    here = there & (np.array(base[3]) > 0)
    if there.any():
        area, area0 = spread(bent, x, ω, end, good), spread(bent, x0, bent.chain.ω, end0, good)
        r_own = np.array(p * P / (base[3] * base[4]), np.float64) * area0 / area
        error = np.abs(np.array(r, np.float64) / r_own - 1)[here]
        # Of 1000 some arrive beside an edge, or by a tangent.
        assert np.median(error) < 0.01 and np.quantile(error, 0.8) < 0.05, np.quantile(error, [0.5, 0.8])
    # -------------------------- And back -------------------------
    chain = replace(bent.chain, x1=x, ω=ω, p=p)
    _, β0, r0, end2, _, _ = bent.copy(bent.step, chain, x0, end0, good)
    back = good & (dr.max(β0) > 0)
    assert np.array(back).sum() > 0.97 * np.array(good).sum()
    close(r * r0, 1, back, median=1e-2, most=0.1)
    close(β0 / r0, bent.step.β1, back, median=1e-2, most=0.1)
    there = np.array(back & ~far)
    if there.any():
        close(end2.vc, bent.step.end1.vc, there, median=1e-2, most=0.1)


@pytest.mark.slow
def test_less_noise_than_without(renderer, monkeypatch):
    """Under a ball of glass in a room, as it looks in an image of 384x384 pixels."""
    from data_gen.samplers.gbdpt import chain_shift

    scene = load(renderer, glass, (384, 384))
    film = renderer.traverse(scene.sensors()[0])
    film["film.crop_size"], film["film.crop_offset"] = [32, 32], [176, 208]
    film.update()

    def noise():
        layers = render_ours(scene, "gbdpt", 1, 64)[0]
        return layers["dx_var"].mean() + layers["dy_var"].mean()

    followed, follow = noise(), chain_shift.follow

    def lost(*args, **more):
        ω, shot, J, found = follow(*args, **more)
        return ω, shot, J, found & False

    monkeypatch.setattr(chain_shift, "follow", lost)
    without = noise()
    assert followed < 0.5 * without, (followed, without)
