"""Copies of paths from both ends, as ``gbdpt`` makes them, and what tests of them compare in float64."""

from copy import copy
from dataclasses import replace
from functools import partial

import bdpt_ends
import numpy as np
from bdpt_ends import Ends, Met
from renders import dr, mi

from data_gen.paths.vertex import SMOOTH
from data_gen.paths.walk import Sky
from data_gen.samplers.bdpt import mis
from data_gen.samplers.bdpt.strategies import connection, to_camera
from data_gen.samplers.bdpt.vertex import IMPORTANCE, RADIANCE, Vertex, context, scatters_smoothly
from data_gen.scenes.builtin import _camera, _diffuse, _light, _sphere, _wall


def corner():
    """All is diffuse or glossy, and one lamp is a rectangle of area 1; some paths begin in a mirror."""
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 8, "rr_depth": 100},
        "sensor": _camera([0, 0.9, 3.6], [0, 0.6, 0], 45),
        "floor": _wall([0, 0, 0], [0, 1, 0], (6, 6), _diffuse(0.6, 0.5, 0.4)),
        "back": _wall([0, 1, -1.2], [0, 0, 1], (6, 3), _diffuse(0.4, 0.6, 0.4)),
        "wall": _wall([1.2, 1, 0], [-1, 0, 0], (6, 3), _diffuse(0.7, 0.2, 0.2)),
        "ball": _sphere([0.3, 0.4, 0], 0.4, {"type": "roughconductor", "material": "Cu", "alpha": 0.3}),
        "mirror": _sphere([-0.6, 0.4, 0.2], 0.4, {"type": "conductor", "material": "Al"}),
        "lamp": _light([0, 2, 0.3], [0, -1, 0], (1, 1), (3, 4, 5)),
    }


plan_of = partial(bdpt_ends.plan_of, sampler="gbdpt")


def fresh():
    """What the base path has gone through at its first vertex."""
    from ngpt_studies.gbdpt.base_path import Past

    return Past(mi.Float(1), Sky.from_camera(False))


class Copies(Ends):
    """Paths of the camera and their copies through another pixel: ``copy`` has these instead.

    ``steps`` and ``offsets`` are what the base paths have at each of their vertices.
    """

    def __init__(self, scene, shift, η=0.0, length=4, roughness=0.05):
        self.shift, self.plan = shift, plan_of(scene, 12, roughness, **({"η": mi.Float(η)} if η else {}))
        self.materials = self.plan.materials
        super().__init__(scene, η, self.materials.connectable, 64, length)
        self.copy = copy(self)
        self.copy.from_camera = self.copied

    def camera_path(self, x, end, d):
        from ngpt_studies.gbdpt.base_path import base_step
        from ngpt_studies.gbdpt.offset_path import own_vertex, start, take_step

        shifted = self.camera.rays(self.shift)
        offsets = [start(self.plan, self.eye, x, shifted)]
        z, active = Vertex(x, mi.Spectrum(1), end, mi.UInt32(1)), x.is_valid()
        found, self.copied, self.steps, self.offsets = [], [], [], []
        for _ in range(self.length):
            step, _ = base_step(self.plan, self.random, z, fresh(), active, brightest_offset=mi.Float(0))
            offset, sharp = offsets[0], step.kind != SMOOTH
            si = dr.select(offset.apart | offset.joined, own_vertex(offset, z.si), z.si)
            found.append(Met(z, active, z.si.bsdf(), sharp))
            there = active & (dr.max(offset.β) > 0)
            self.copied.append(Met(Vertex(si, offset.β, offset.end, z.depth), there, si.bsdf(), sharp))
            self.steps.append(step)
            self.offsets.append(offset)
            offsets = take_step(self.plan, step, offsets)
            z = Vertex(step.x1, step.β1, step.end1, z.depth + 1)
            active = step.goes_on & step.x1.is_valid()
            dr.eval(found, self.copied, step, offset, offsets, z, active)
        return found

    def straight(self, t):
        """Where there are copies of the first ``t`` vertices; behind mirrors they have Jacobians of their own."""
        good = self.copied[t - 1].there & self.offsets[0].apart
        return good & ~self.from_camera[0].sharp if t > 1 else good

    def joined(self, t, s):
        """Arguments of ``compare_copies`` for paths of ``t`` vertices that are connected to light paths of ``s``."""
        z, own, y, offset = self.from_camera[t - 1], self.copied[t - 1], self.from_light[s - 1], self.offsets[t - 1]
        good = self.straight(t) & scatters_smoothly(y.bsdf)
        for met in (z, own, y):
            good &= self.materials.connectable(met.bsdf)
        for met in self.from_light[:s]:
            good &= met.there
        dr.eval(good)
        g, _, through = connection(self.plan, z.vertex, z.bsdf, y.vertex, good)

        def sees(v, y, lit):
            return self.plan.sees_alike(v.si, y.si.p, through, lit & ~offset.joined), 0

        g1, edge, _ = connection(self.plan, own.vertex, own.bsdf, y.vertex, good, sees)
        found = offset.β * g1, offset.r, mis.others_connected(own.vertex.end, y.vertex.end, edge)
        return z.vertex.β * g, found, self.brute(t, s), self.copy.brute(t, s), s + 1, good

    def splatted(self, s):
        """Light paths of ``s`` vertices beside their light's own that end at the camera, where both are connectable."""
        from ngpt_studies.gbdpt.light_shift import Splatted

        y, before, connectable = self.from_light[s - 1], self.from_light[max(s - 2, 0)], self.materials.connectable
        good = y.there & connectable(y.bsdf)
        good &= s == 1 or (~before.sharp & connectable(before.bsdf))
        C, others, uv = to_camera(self.eye, self.lens, y.vertex, y.bsdf, good, self.plan.seen_by_camera)
        path = {"first": dr.opaque(mi.Bool, s == 1), "start": self.start, "before": before.vertex}
        path |= {"p": before.sample.pdf, "survival": mi.Float(1), "events": mi.UInt32(0), "allowed": mi.Bool(good)}
        path = Splatted(y.vertex, y.d, uv, self.lens, C, others, **path)
        # All have the same kernels.
        dr.eval(path)
        return path


def check_copies_to_the_camera(copies, s):
    """Light paths of ``s`` vertices, seen by another pixel: by brute force; and the copy's copy is the path."""
    from ngpt_studies.gbdpt.light_shift import shifted

    path, y, scene = copies.splatted(s), copies.from_light[s - 1], copies.scene
    uv = path.uv + mi.Vector2f(*copies.shift)
    good = path.allowed & copies.eye.shows(uv) & (dr.max(path.C) > 0)
    found = C, r, _ = shifted(copies.plan, copies.eye, path, uv, good)
    x = scene.ray_intersect(copies.eye.ray(uv, copies.lens), good)
    moved = replace(y, vertex=replace(y.vertex, si=x), bsdf=x.bsdf())
    own = copies.densities([moved, *copies.from_light[: s - 1][::-1]], 0)
    compare_copies(path.C, found, copies.brute(0, s), own, s + 1, good)
    before, good, start, p = path.before.si, good & (dr.max(C) > 0), path.start, path.p
    allowed = good & copies.materials.connectable(x.bsdf())
    if s == 1:
        start, ratio, _ = copies.lights.redirected(scene, start, x)
        start.β /= ratio
    else:
        p = before.bsdf().pdf(context(IMPORTANCE), before, before.to_local(dr.normalize(x.p - before.p)))
    d = start.ray.d if s == 1 else dr.normalize(x.p - before.p)
    back = replace(path, y=moved.vertex, d=d, uv=uv, start=start, p=p)
    C_back, r_back, others = shifted(copies.plan, copies.eye, back, path.uv, allowed)
    close(others, path.others, check_back(good, path.C, r, C_back, r_back))


def check_going_straight_and_back(copies):
    """Camera paths that join their base paths at the second vertex: the copy's copy is the path."""
    from ngpt_studies.gbdpt.offset_path import step_own

    step, offset, there = copies.steps[0], copies.offsets[0], copies.offsets[1]
    x, y, d = copies.from_camera[0].vertex, copies.copied[0], there.ray.d
    wo, (ray, *_) = y.si.to_local(d), copies.camera.rays()
    hit = copies.scene.ray_intersect_preliminary(mi.Ray3f(ray))
    p = y.bsdf.pdf(context(RADIANCE), y.si, wo)
    connectable = copies.materials.connectable(y.bsdf)
    way = replace(step.way, o=y.si.p, p=p)
    reverse = replace(step, z=y.vertex, wo=wo, d=d, p=p, way=way, connectable=connectable)
    base = replace(offset, ray=mi.Ray3f(ray), hit=hit, β=x.β, r=mi.Float(1), end=x.end)
    found = step_own(copies.plan, reverse, base)
    good = check_back(there.joined & (dr.max(there.β) > 0), step.β1, there.r, found.β, found.r)
    close(found.end.vcm, step.end1.vcm, good)
    close(found.end.vc, step.end1.vc, good)


@np.errstate(divide="ignore", invalid="ignore")
def close(ours, theirs, good, median=1e-3, most=0.03):
    error = np.abs(np.array(ours, np.float64) / np.array(theirs, np.float64) - 1)
    error = error[..., np.array(good)]
    assert np.median(error) < median and np.quantile(error, 0.97) < most, (np.median(error), np.quantile(error, 0.97))


def check_back(good, C, r, C_back, r_back, least=0.99, **tolerance):
    """Copies of copies are the paths, whose C (or β) is f / p, and r r' = 1; returned is where they are."""
    back = np.array(good & (dr.max(C_back) > 0))
    assert back.sum() > max(100, least * np.array(good).sum()), (back.sum(), np.array(good).sum())
    close(r * r_back, 1, back, **tolerance)
    close(C_back * r, C, back & (np.array(C) > 0).any(axis=0), **tolerance)
    return back


@np.errstate(divide="ignore", invalid="ignore")
def compare_copies(C, found, base, copy, s, good):
    """``found`` = (C', r, others') of the copies of bases of contribution C against brute force.

    Returns errors of (r, W), (2, N), and which of the lanes they are of.
    """
    C, C1, r, others = (np.array(v, np.float64) for v in (C, *found))
    (p, f, first), (p1, f1, first1) = base, copy
    good = np.array(good) & (C1.max(axis=0) > 0) & (C.max(axis=0) > 0)
    assert good.sum() > 100
    J = first / first1
    # The share of strategy s, from this end, of a pair; over all of them, from both ends, they sum to 1.
    share, brute_share = 1 / (sum(p) / p[s] + r * (1 + others)), p[s] / (sum(p) + J * sum(p1))
    pairs = [(r, p1[s] * J / p[s]), (1 + others, sum(p1) / p1[s]), (share, brute_share)]
    pairs += zip(C1 / C, f1 * J / f, strict=True)
    errors = np.stack([np.broadcast_to(np.abs(ours / theirs - 1), good.shape) for ours, theirs in pairs])
    # Of grazing directions float32 leaves little: some densities are 0 by one way and not by the other.
    finite = np.isfinite(errors)
    assert finite[:, good].mean(axis=1).min() > 0.9, finite[:, good].mean(axis=1)
    for number, error in enumerate(errors):
        error = error[good & finite[number]]
        assert np.median(error) < 1e-3 and np.quantile(error, 0.97) < 0.02, (number, np.quantile(error, [0.5, 0.97]))
    good &= finite[:2].all(axis=0)
    return errors[:2, good], good
