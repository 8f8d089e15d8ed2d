"""Paths from both ends of a scene, their copies, and the densities of all ways to find them, in float64."""

from copy import copy
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from data_gen_scenes import glass
from renders import dr, mi

from data_gen.paths.camera import CameraSamples
from data_gen.paths.eye import Eye
from data_gen.paths.light_ends import LightEnds
from data_gen.paths.vertex import SMOOTH, Materials, event_kind
from data_gen.paths.walk import Limits, Sky
from data_gen.samplers import SAMPLERS
from data_gen.samplers.bdpt import mis
from data_gen.samplers.bdpt.strategies import connected, connection, to_camera, to_light
from data_gen.samplers.bdpt.vertex import (
    IMPORTANCE,
    RADIANCE,
    Vertex,
    context,
    cosine,
    evaluate,
    leave,
    light_leaves,
    scatters_smoothly,
)


def without_hole():
    """``glass``, where every vertex is one of the path."""
    scene = glass()
    del scene["hole"]
    return scene


def plan_of(scene, longest=8, roughness=0.05, **more):
    """The plan of ``gbdpt`` for paths of at most ``longest`` edges, with a roulette that ends none of them."""
    from data_gen.samplers.gbdpt.base_path import Plan

    lights, materials, integrator = LightEnds(scene), Materials(scene, roughness), SAMPLERS["gbdpt"].integrator(scene)
    ways = {"first_hit": integrator.first_hit, "hidden": integrator.hidden_from_camera}
    return Plan(scene, lights, materials, limits=Limits(longest, 100), longest=longest, **ways, **more)


def fresh():
    """What the base path has gone through at its first vertex."""
    from data_gen.samplers.gbdpt.base_path import Past

    return Past(mi.Float(1), Sky.from_camera(False))


@dataclass
class Met:
    """A vertex of a path, and the event by which the path goes on."""

    vertex: Any
    there: Any
    bsdf: Any
    sharp: Any  # the event is not smooth
    sample: Any = None
    d: Any = None  # in which the path came

    @property
    def si(self):
        return self.vertex.si


class Ends:
    """Paths from either end of a scene with one lamp, a rectangle, one path from each end a lane.

    ``η`` is the same as in ``mis``. Photons are gathered at materials that are ``connectable``; None: nowhere.
    """

    def __init__(self, scene, η=0.0, connectable=None, spp=16, length=4):
        self.scene, self.connectable, self.length = scene, connectable, length
        self.η = dr.opaque(mi.Float, η)
        self.camera = camera = CameraSamples(scene.sensors()[0], 1, spp)
        self.sensor, self.lens, self.eye = camera.sensor, camera.lens, Eye.of(camera)
        ray, _, _ = camera.rays()
        self.random, self.lights = camera.random.clone(), LightEnds(scene)
        self.start = start = self.lights.sample(scene, self.random, ray.time, ray.wavelengths)
        y, d = scene.ray_intersect(start.ray), start.ray.d
        e, p = self.lights.densities(scene, start, y)
        self.from_light = self.walk("Importance", y, start.β, mis.begin_light(e, p, start.delta, cosine(y, d)), d)
        z = scene.ray_intersect(mi.Ray3f(ray))
        self.from_camera = self.camera_path(z, self.first_end(z, ray.d), ray.d)

    def first_end(self, z, d):
        """What a path knows at the first vertex that the camera sees."""
        _, e = self.sensor.sample_direction(z, self.lens)
        return mis.begin_camera(e[0], cosine(z, d))

    def camera_path(self, z, end, d):
        return self.walk("Radiance", z, mi.Spectrum(1), end, d)

    def walk(self, mode, si, β, end, d):
        """The vertices of one end."""
        found, there, random = [], si.is_valid(), self.random
        for depth in range(1, self.length + 1):
            bsdf = si.bsdf()
            η = dr.select(self.connectable(bsdf), self.η, 0) if self.connectable else mi.Float(0)
            end = mis.gathered(end, η) if mode == IMPORTANCE else end
            vertex = Vertex(si, β, end, mi.UInt32(depth))
            sample, f_p = bsdf.sample(context(mode), si, random.next_1d(), random.next_2d(), there)
            sharp = event_kind(sample.sampled_type) != SMOOTH
            found.append(Met(vertex, there, bsdf, sharp, mi.BSDFSample3f(sample), d))
            if mode == IMPORTANCE:
                d, f_p, end = light_leaves(vertex, bsdf, sample, f_p, there)
            else:
                # Camera paths know at the next event whether photons are gathered.
                d, end = leave(vertex, bsdf, sample, there, η)
            β, there = β * f_p, there & (sample.pdf > 0)
            si = self.scene.ray_intersect(si.spawn_ray(d), there)
            there &= si.is_valid()
            end = mis.arrive(end, cosine(si, d), dr.square(si.t))
            dr.eval(found, si, β, end, there, d)
        return found

    def brute(self, t, s, lamp=None):
        """``densities`` of the paths of ``t`` vertices from the camera joined to ``s`` from the light."""
        return self.densities(self.from_camera[:t] + self.from_light[:s][::-1], t, lamp)

    @np.errstate(divide="ignore", invalid="ignore")
    def densities(self, path, t, lamp=None):
        """Densities of a path joined behind ``t`` vertices: (of all strategies, f, of the first vertex on the film).

        Strategies that join come first, by the number of vertices from the light, its own point included (or another
        point on it, ``lamp``). Strategies that merge follow, by the vertex from the camera at which they do. All
        densities are per area.
        """
        ends = [*((met.si.p, met.si.n) for met in path), lamp or (self.start.end.p, self.start.end.n)]
        points, normals = ([np.array(each, np.float64).T for each in some] for some in zip(*ends, strict=True))
        points.insert(0, np.array(self.sensor.world_transform().translation(), np.float64).reshape(1, 3))
        normals.insert(0, None)
        k = len(points) - 1
        sharp = [np.array(False), *(np.array(met.sharp) for met in path), np.array(False)]
        for i in {t, t + 1} - {k + 1}:
            sharp[i] = np.zeros_like(sharp[i])

        def cos_at(i, j):
            d = points[j] - points[i]
            return np.abs((normals[i] * d).sum(axis=1)) / np.linalg.norm(d, axis=1)

        def per_area(i, j):
            return cos_at(j, i) / ((points[j] - points[i]) ** 2).sum(axis=1)

        def scatter(i, come_from, go_to):
            """f and p per area; what smooth events alone have is 1 of others."""
            si, others = mi.SurfaceInteraction3f(path[i - 1].si), (come_from, go_to)
            turned = (mi.Vector3f(*(points[j] - points[i]).T.astype(np.float32)) for j in others)
            si.wi, wo = (si.to_local(dr.normalize(d)) for d in turned)
            f, p = path[i - 1].bsdf.eval_pdf(mi.BSDFContext(), si, wo)
            one = np.array(f, np.float64) * per_area(i, go_to), np.array(p, np.float64) * per_area(i, go_to)
            return [np.where(sharp[i], per_area(i, go_to), value) for value in one]

        # Of all vertices up to i: from the camera, and from the light
        _, importance = self.sensor.sample_direction(path[0].si, self.lens)
        first = np.array(importance[0], np.float64) * cos_at(1, 0)
        area = self.scene.emitters()[0].get_shape().surface_area()[0]
        f, from_camera, from_light = first, [np.ones(len(first)), first], {k + 1: np.ones(len(first)), k: 1 / area}
        for i in range(1, k):
            f_i, p = scatter(i, i - 1, i + 1)
            f = f * f_i
            from_camera.append(from_camera[i] * p)
        from_light[k - 1] = from_light[k] * cos_at(k, k - 1) / np.pi * per_area(k, k - 1)
        for i in range(k - 1, 1, -1):
            from_light[i - 1] = from_light[i] * scatter(i, i + 1, i - 1)[1]
        found = []
        for s in range(k + 1):
            p = from_camera[k - s] * from_light[k - s + 1]
            for i in (k - s, k - s + 1):
                if s and 0 < i < k:
                    p = np.where(sharp[i], 0, p)
            found.append(p)
        for i in range(1, k) if self.connectable else ():
            # Where light comes from a delta event
            merges = ~sharp[i] & sharp[i + 1] & np.array(self.connectable(path[i - 1].bsdf))
            found.append(np.where(merges, from_camera[i] * from_light[i] * self.η[0], 0))
        return found, f, first


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
        from data_gen.samplers.gbdpt.base_path import base_step
        from data_gen.samplers.gbdpt.offset_path import own_vertex, start, take_step

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
        from data_gen.samplers.gbdpt.light_shift import Splatted

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
    from data_gen.samplers.gbdpt.light_shift import shifted

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
    from data_gen.samplers.gbdpt.offset_path import step_own

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


def compare(others, densities, strategy, good, path, worst=0.01, least=100):
    """``others`` of ``mis`` and what it is by brute force, where ``good`` and all vertices of the path are there."""
    dr.eval(good, others)
    good = np.array(good & dr.all([met.there for met in path]))
    with np.errstate(divide="ignore", invalid="ignore"):
        brute = sum(p for i, p in enumerate(densities) if i != strategy) / densities[strategy]
    # Of directions that graze rough glass, positions in float32 may lie on the other side: density 0 there.
    assert good.sum() > least and np.isfinite(brute[good]).mean() > 0.9, (good.sum(), np.isfinite(brute[good]).mean())
    good &= np.isfinite(brute)
    error = np.abs(np.array(others) - brute)[good] / (1 + brute[good])
    # Of grazing directions float32 leaves a part in a thousand.
    assert np.median(error) < 1e-4 and np.quantile(error, 0.99) < worst, (len(path), strategy)


def check_weights(ends):
    """The weights of all connections: to vertices, the light's own point and the camera."""
    scene, plan = ends.scene, plan_of(ends.scene)
    for t in range(1, 4):
        for s in range(1, 4):
            z, y = ends.from_camera[t - 1], ends.from_light[s - 1]
            smooth = scatters_smoothly(z.bsdf) & scatters_smoothly(y.bsdf)
            C, others = connected(plan, z.vertex, z.bsdf, y.vertex, smooth)
            path = ends.from_camera[:t] + ends.from_light[:s]
            compare(others, ends.brute(t, s)[0], s + 1, smooth & (dr.max(C) > 0), path)
    for t in range(1, 4):
        # To the light's own point, as if it had been sampled from there
        z = ends.from_camera[t - 1]
        light = mi.DirectionSample3f(ends.start.end)
        to = mi.Vector3f(light.p - z.si.p)
        light.dist = dr.norm(to)
        light.d = to / light.dist
        light.emitter, light.delta = ends.start.emitter, False
        light.pdf = scene.pdf_emitter_direction(z.si, light)
        f, p, q = evaluate(RADIANCE, z.si, z.bsdf, z.si.to_local(light.d))
        C, others = to_light(ends.lights, z.vertex, light, mi.Spectrum(1), f, p=p, q=q)
        good = scatters_smoothly(z.bsdf) & (dr.max(C) > 0) & (light.pdf > 0)
        compare(others, ends.brute(t, 0)[0], 1, good, ends.from_camera[:t])
    for s in range(1, 4):
        y = ends.from_light[s - 1]
        C, others, _ = to_camera(ends.eye, ends.lens, y.vertex, y.bsdf, scatters_smoothly(y.bsdf), lambda *_: 1)
        compare(others, ends.brute(0, s)[0], s + 1, dr.max(C) > 0, ends.from_light[:s])
