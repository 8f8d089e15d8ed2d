"""Paths from both ends of a scene, and the densities of all ways to find them, in float64."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from data_gen_scenes import glass
from renders import dr, mi

from data_gen.paths.camera import CameraSamples
from data_gen.paths.eye import Eye
from data_gen.paths.light_ends import LightEnds
from data_gen.paths.vertex import SMOOTH, Materials, event_kind
from data_gen.paths.walk import Limits
from data_gen.samplers import SAMPLERS
from data_gen.samplers.bdpt import mis
from data_gen.samplers.bdpt.strategies import connected, to_camera, to_light
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


def plan_of(scene, longest=8, roughness=0.05, sampler="bdpt", **more):
    """The sampler's plan for paths of at most ``longest`` edges, with a roulette that ends none of them."""
    lights, materials, integrator = LightEnds(scene), Materials(scene, roughness), SAMPLERS[sampler].integrator(scene)
    ways = {"first_hit": integrator.first_hit, "hidden": integrator.hidden_from_camera}
    more |= {"limits": Limits(longest, 100), "longest": longest}
    return integrator.plan_class(scene, lights, materials, **ways, **more)


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
