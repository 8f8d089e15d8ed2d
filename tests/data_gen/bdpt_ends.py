"""Paths from both ends of a scene, and the densities of all ways to find them, in float64: what MIS weights are."""

import numpy as np
from data_gen_scenes import glass

# Of the lamp of ``glass``
LAMP_AREA = 2.6**2


def without_hole():
    """``glass``, where every vertex is one of the path."""
    scene = glass()
    del scene["hole"]
    return scene


def plan_of(scene, longest=8, **more):
    """That of ``gbdpt``, for paths of at most so many edges, whose roulette lets all of them live."""
    from data_gen.paths.light_ends import LightEnds
    from data_gen.paths.vertex import Materials
    from data_gen.paths.walk import Limits
    from data_gen.samplers import SAMPLERS
    from data_gen.samplers.gbdpt.base_path import Plan

    lights, materials, integrator = LightEnds(scene), Materials(scene, 0.05), SAMPLERS["gbdpt"].integrator(scene)
    ways = {"first_hit": integrator.first_hit, "hidden": integrator.hidden_from_camera}
    return Plan(scene, lights, materials, limits=Limits(longest, 100), longest=longest, **ways, **more)


def fresh(mi):
    """What the base path has gone through at its first vertex."""
    from data_gen.paths.walk import Sky
    from data_gen.samplers.gbdpt.base_path import Past

    return Past(mi.Float(1), Sky.from_camera(False))


class Ends:
    """Paths from either end of a scene, one from each a lane, and the densities of all strategies in float64.

    ``η`` is that of ``mis``, and photons are gathered at materials that are ``connectable``; None: nowhere.
    """

    LENGTH = 4

    def __init__(self, mi, scene, η=0.0, connectable=None, spp=16):
        import drjit as dr

        from data_gen.paths.camera import CameraSamples
        from data_gen.paths.eye import Eye
        from data_gen.paths.light_ends import LightEnds
        from data_gen.samplers.bdpt import mis
        from data_gen.samplers.bdpt.vertex import IMPORTANCE, RADIANCE, cosine

        self.mi, self.dr, self.scene, self.η, self.connectable = mi, dr, scene, η, connectable
        camera = CameraSamples(scene.sensors()[0], 1, spp)
        self.sensor, self.lens, self.eye = camera.sensor, camera.lens, Eye.of(camera)
        ray, _, _ = camera.rays()
        self.random, self.lights = camera.random.clone(), LightEnds(scene)
        self.start = start = self.lights.sample(scene, self.random, ray.time, ray.wavelengths)
        y = scene.ray_intersect(start.ray)
        e, p = self.lights.densities(scene, start, y)
        self.from_light = self.walk(IMPORTANCE, y, mis.begin_light(e, p, start.delta, cosine(y, start.ray.d)))
        z = scene.ray_intersect(mi.Ray3f(ray))
        _, e = self.sensor.sample_direction(z, self.lens)
        self.from_camera = self.walk(RADIANCE, z, mis.begin_camera(e[0], cosine(z, ray.d)))

    def walk(self, mode, si, end):
        """The vertices of one end: (Vertex, whether it is there, its material, whether its event is not smooth)."""
        from data_gen.paths.vertex import SMOOTH, event_kind
        from data_gen.samplers.bdpt import mis
        from data_gen.samplers.bdpt.vertex import IMPORTANCE, Vertex, context, cosine, leave

        mi, dr, random = self.mi, self.dr, self.random
        found, there = [], si.is_valid()
        for depth in range(1, self.LENGTH + 1):
            bsdf = si.bsdf()
            η = dr.select(self.connectable(bsdf), mi.Float(self.η), 0) if self.connectable else mi.Float(0)
            end = mis.gathered(end, η) if mode == IMPORTANCE else end
            vertex = Vertex(si, mi.Spectrum(1), end, mi.UInt32(depth))
            sample, _ = bsdf.sample(context(mode), si, random.next_1d(), random.next_2d(), there)
            # Camera paths know at the next event whether photons are gathered.
            d, end = leave(vertex, bsdf, sample, there, 0.0 if mode == IMPORTANCE else η)
            delta = event_kind(sample.sampled_type) != SMOOTH
            found.append((vertex, there, bsdf, delta))
            there = there & (sample.pdf > 0)
            si = self.scene.ray_intersect(si.spawn_ray(d), there)
            there &= si.is_valid()
            end = mis.arrive(end, cosine(si, d), dr.square(si.t))
            dr.eval(found, si, end, there)
        return found

    def densities(self, t, s):
        """Those of all strategies for the paths of ``t`` vertices from the camera joined to ``s`` from the light.

        By the number of vertices that come from the light, its own point included; behind them those that merge, at the
        first vertex that the camera sees, the second ...; per area, of a rectangular lamp.
        """
        mi, dr = self.mi, self.dr
        path = self.from_camera[:t] + self.from_light[:s][::-1]
        points = [v.si.p for v, *_ in path] + [self.start.end.p]
        points = [np.array(p, np.float64).T for p in points]
        points.insert(0, np.array(self.sensor.world_transform().translation(), np.float64).reshape(1, 3))
        normals = [np.array(v.si.n, np.float64).T for v, *_ in path] + [np.array(self.start.end.n, np.float64).T]
        normals.insert(0, None)
        k = len(points) - 1
        delta = [np.zeros(len(points[1]), bool) for _ in range(k + 1)]
        for i, (*_, sharp) in enumerate(path, 1):
            if i not in (t, t + 1):
                delta[i] = np.array(sharp)

        def per_area(i, j):
            d = points[j] - points[i]
            return np.abs((normals[j] * d).sum(axis=1)) / (d**2).sum(axis=1) ** 1.5

        def density(i, come_from, go_to):
            vertex, _, bsdf, _ = path[i - 1]
            si = mi.SurfaceInteraction3f(vertex.si)
            wi, wo = (
                si.to_local(dr.normalize(mi.Vector3f(*(points[j] - points[i]).T.astype(np.float32))))
                for j in (come_from, go_to)
            )
            si.wi = wi
            p = np.array(bsdf.pdf(mi.BSDFContext(), si, wo), np.float64)
            return np.where(delta[i], 1, p) * per_area(i, go_to)

        # Of all vertices up to i: from the camera, and from the light
        _, importance = self.sensor.sample_direction(path[0][0].si, self.lens)
        d = points[1] - points[0]
        first = np.array(importance[0], np.float64) * np.abs((normals[1] * d).sum(axis=1)) / np.linalg.norm(d, axis=1)
        from_camera = [np.ones(len(first)), first]
        for i in range(1, k):
            from_camera.append(from_camera[i] * density(i, i - 1, i + 1))
        d = points[k - 1] - points[k]
        cos_lamp = np.abs((normals[k] * d).sum(axis=1)) / np.linalg.norm(d, axis=1)
        from_light = {k + 1: np.ones(len(first)), k: np.ones(len(first)) / LAMP_AREA}
        from_light[k - 1] = from_light[k] * cos_lamp / np.pi * per_area(k, k - 1)
        for i in range(k - 1, 1, -1):
            from_light[i - 1] = from_light[i] * density(i, i + 1, i - 1)
        found = []
        for s in range(k + 1):
            p = from_camera[k - s] * from_light[k - s + 1]
            for i in (k - s, k - s + 1):
                if s and 0 < i < k:
                    p = np.where(delta[i], 0, p)
            found.append(p)
        if self.connectable:
            for i in range(1, k):
                # Where light comes from a delta event
                merges = ~delta[i] & delta[i + 1] & np.array(self.connectable(path[i - 1][2]))
                found.append(np.where(merges, from_camera[i] * from_light[i] * self.η, 0))
        return found


def compare(others, densities, strategy, good, vertices, worst=0.01, least=100):
    """``others`` of ``mis`` and what it is by brute force, where ``good`` and all ``vertices`` are there."""
    import drjit as dr

    good = np.array(good & dr.all([there for _, there, *_ in vertices]))
    with np.errstate(divide="ignore", invalid="ignore"):
        brute = sum(p for i, p in enumerate(densities) if i != strategy) / densities[strategy]
    # Of directions that graze rough glass, positions in float32 may lie on the other side: density 0 there.
    assert good.sum() > least and np.isfinite(brute[good]).mean() > 0.9, (good.sum(), np.isfinite(brute[good]).mean())
    good &= np.isfinite(brute)
    error = np.abs(np.array(others) - brute)[good] / (1 + brute[good])
    # Of grazing directions float32 leaves a part in a thousand.
    assert np.median(error) < 1e-4 and np.quantile(error, 0.99) < worst, (len(vertices), strategy)


def check_weights(ends):
    """Of all connections, to vertices, the light's own point and the camera."""
    import drjit as dr

    from data_gen.samplers.bdpt.strategies import connected, to_camera, to_light
    from data_gen.samplers.bdpt.vertex import RADIANCE, evaluate, scatters_smoothly

    mi, scene = ends.mi, ends.scene
    for t in range(1, 4):
        for s in range(1, 4):
            (z, _, z_bsdf, _), (y, _, y_bsdf, _) = ends.from_camera[t - 1], ends.from_light[s - 1]
            smooth = scatters_smoothly(z_bsdf) & scatters_smoothly(y_bsdf)
            vertices = ends.from_camera[:t] + ends.from_light[:s]
            C, others = connected(scene, z, z_bsdf, y, smooth)
            compare(others, ends.densities(t, s), s + 1, smooth & (dr.max(C) > 0), vertices)
    for t in range(1, 4):
        # To the light's own point, as if it had been sampled from there
        z, _, z_bsdf, _ = ends.from_camera[t - 1]
        light = mi.DirectionSample3f(ends.start.end)
        to = mi.Vector3f(light.p - z.si.p)
        light.dist = dr.norm(to)
        light.d = to / light.dist
        light.emitter, light.delta = ends.start.emitter, False
        light.pdf = scene.pdf_emitter_direction(z.si, light)
        f, p, q = evaluate(RADIANCE, z.si, z_bsdf, z.si.to_local(light.d))
        C, others = to_light(ends.lights, z, light, mi.Spectrum(1), f, p=p, q=q)
        good = scatters_smoothly(z_bsdf) & (dr.max(C) > 0) & (light.pdf > 0)
        compare(others, ends.densities(t, 0), 1, good, ends.from_camera[:t])
    for s in range(1, 4):
        y, _, y_bsdf, _ = ends.from_light[s - 1]
        C, others, _ = to_camera(
            ends.eye, ends.lens, y, y_bsdf, scatters_smoothly(y_bsdf), lambda si, toward, active: mi.Bool(False)
        )
        compare(others, ends.densities(0, s), s + 1, dr.max(C) > 0, ends.from_light[:s])


@np.errstate(divide="ignore", invalid="ignore")
def close(ours, theirs, good, median=1e-3, most=0.03):
    error = np.abs(np.array(ours, np.float64) / np.array(theirs, np.float64) - 1)
    error = error[..., np.array(good)]
    assert np.median(error) < median and np.quantile(error, 0.97) < most, (np.median(error), np.quantile(error, 0.97))


def number(mi, dr, code):
    """A random number with which an event of that code is sampled."""
    return dr.select(code == 1, mi.Float(0), 1 - dr.epsilon(mi.Float))
