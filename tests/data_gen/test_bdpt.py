"""What is particular to ``bdpt``: MIS weights, all kinds of lights, what is kept of light paths, refusals.

That it is unbiased on quick scenes, repeats its bits and says how noisy it is, is among the laws of all samplers.
"""

import numpy as np
import pytest
from bdpt_scenes import SCENES
from data_gen_scenes import glass
from unbiased import REFERENCES, load, render_ours, render_references

from ngpt.errors import NgptError
from ngpt.testing import z_test

QUICK = ("points", "sky", "glass", "bumps")


def check(mi, description, **options):
    scene = load(mi, description, (32, 32))
    stacks = render_ours(scene, "bdpt", batches=24, spp=16, **options)
    references = render_references(mi, scene, spp=96)
    assert references.mean() > 0.01
    result = z_test(np.stack([stack["primal"] for stack in stacks]), references)
    assert result.passed, str(result)


@pytest.mark.parametrize("name", QUICK)
def test_unbiased(renderer, name):
    check(renderer, SCENES[name])


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in SCENES if name not in QUICK])
def test_unbiased_on_more_scenes(renderer, name):
    check(renderer, SCENES[name])


@pytest.mark.parametrize("joined_depth", [1, 3])
def test_longer_paths_come_from_the_camera_alone(renderer, joined_depth):
    check(renderer, SCENES["areas"], joined_depth=joined_depth)


def test_spectral_and_monochromatic_variants(renderer):
    from data_gen.backend import use_variant

    try:
        for variant in ("llvm_ad_spectral", "llvm_ad_mono"):
            use_variant(variant)
            scene = load(renderer, "lens", (16, 16))
            ours = np.stack([s["primal"] for s in render_ours(scene, "bdpt", batches=12, spp=32)])
            primal = np.stack([s["primal"] for s in render_ours(scene, "primal", batches=12, spp=64, seed=REFERENCES)])
            result = z_test(ours, primal)
            assert result.passed, f"{variant}: {result}"
    finally:
        use_variant()


class Ends:
    """Paths from either end of a scene, one from each a lane, and the densities of all strategies in float64."""

    LENGTH = 4

    def __init__(self, mi, scene):
        import drjit as dr

        from data_gen.paths.camera import CameraSamples
        from data_gen.samplers.bdpt import mis
        from data_gen.samplers.bdpt.lights import LightEnds
        from data_gen.samplers.bdpt.vertex import IMPORTANCE, RADIANCE, cosine

        self.mi, self.dr, self.scene = mi, dr, scene
        camera = CameraSamples(scene.sensors()[0], 1, 16)
        self.sensor, self.lens = camera.sensor, camera.lens
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
        from data_gen.samplers.bdpt.vertex import Vertex, context, cosine, leave

        mi, dr, random = self.mi, self.dr, self.random
        found, there = [], si.is_valid()
        for depth in range(1, self.LENGTH + 1):
            vertex, bsdf = Vertex(si, mi.Spectrum(1), end, mi.UInt32(depth)), si.bsdf()
            sample, _ = bsdf.sample(context(mode), si, random.next_1d(), random.next_2d(), there)
            d, end = leave(vertex, bsdf, sample, there)
            found.append((vertex, there, bsdf, event_kind(sample.sampled_type) != SMOOTH))
            there = there & (sample.pdf > 0)
            si = self.scene.ray_intersect(si.spawn_ray(d), there)
            there &= si.is_valid()
            end = mis.arrive(end, cosine(si, d), dr.square(si.t))
            dr.eval(found, si, end, there)
        return found

    def densities(self, t, s, lamp_area):
        """Those of all strategies for the paths of ``t`` vertices from the camera joined to ``s`` from the light.

        By the number of vertices that come from the light, its own point included; per area, of a rectangular lamp.
        """
        mi, dr = self.mi, self.dr
        path = self.from_camera[:t] + self.from_light[:s][::-1]
        points = [v.si.p for v, *_ in path] + [self.start.end.p]
        points = [np.array(p, np.float64).T for p in points]
        points.insert(0, np.array(self.sensor.world_transform().translation(), np.float64).reshape(1, 3))
        normals = [np.array(v.si.n, np.float64).T for v, *_ in path] + [np.array(self.start.end.n, np.float64).T]
        normals.insert(0, None)
        k = len(points) - 1
        ends = (t, t + 1)
        delta = [np.zeros(len(points[1]), bool) for _ in range(k + 1)]
        for i, (*_, sharp) in enumerate(path, 1):
            if i not in ends:
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

        forward = {i: density(i, i - 1, i + 1) for i in range(1, k)}
        backward = {i: density(i, i + 1, i - 1) for i in range(2, k)}
        _, importance = self.sensor.sample_direction(path[0][0].si, self.lens)
        d = points[1] - points[0]
        first = np.array(importance[0], np.float64) * np.abs((normals[1] * d).sum(axis=1)) / np.linalg.norm(d, axis=1)
        d = points[k - 1] - points[k]
        cos_lamp = np.abs((normals[k] * d).sum(axis=1)) / np.linalg.norm(d, axis=1)
        found = []
        for from_light in range(k + 1):
            last = k - from_light  # vertex of the camera path
            p = np.ones(len(first))
            if last > 0:
                p = p * first
            for i in range(1, last):
                p = p * forward[i]
            if from_light > 0:
                p = p / lamp_area
            if from_light > 1:
                p = p * cos_lamp / np.pi * per_area(k, k - 1)
            for i in range(k - 1, last + 1, -1):
                p = p * backward[i]
            for i in (last, last + 1):
                if from_light and 0 < i < k:
                    p = np.where(delta[i], 0, p)
            found.append(p)
        return found


def test_weights_are_those_of_all_densities(renderer):
    """Brute force in float64, on stored paths: no z-test sees every wrong term."""
    import drjit as dr

    from data_gen.samplers.bdpt.strategies import connected, to_camera, to_light
    from data_gen.samplers.bdpt.vertex import RADIANCE, evaluate, scatters_smoothly

    def scene_without_hole():
        scene = glass()
        del scene["hole"]
        return scene

    mi = renderer
    ends = Ends(mi, load(mi, scene_without_hole, (24, 24)))
    scene, area = ends.scene, 2.6**2

    def compare(others, densities, s, good, vertices):
        good = np.array(good & dr.all([there for _, there, *_ in vertices]))
        with np.errstate(divide="ignore", invalid="ignore"):
            brute = sum(p for i, p in enumerate(densities) if i != s) / densities[s]
        # Of directions that graze rough glass, positions in float32 may lie on the other side: density 0 there.
        assert good.sum() > 100 and np.isfinite(brute[good]).mean() > 0.9
        good &= np.isfinite(brute)
        error = np.abs(np.array(others) - brute)[good] / (1 + brute[good])
        # Of grazing directions float32 leaves a part in a thousand.
        assert np.median(error) < 1e-4 and np.quantile(error, 0.99) < 0.01, (len(vertices), s)

    for t in range(1, 4):
        for s in range(1, 4):
            (z, _, z_bsdf, _), (y, _, y_bsdf, _) = ends.from_camera[t - 1], ends.from_light[s - 1]
            smooth = scatters_smoothly(z_bsdf) & scatters_smoothly(y_bsdf)
            vertices = ends.from_camera[:t] + ends.from_light[:s]
            C, others = connected(scene, z, z_bsdf, y, smooth)
            compare(others, ends.densities(t, s, area), s + 1, smooth & (dr.max(C) > 0), vertices)
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
        C, others = to_light(ends.lights, z, light, mi.Spectrum(1), f, p, q)
        good = scatters_smoothly(z_bsdf) & (dr.max(C) > 0) & (light.pdf > 0)
        compare(others, ends.densities(t, 0, area), 1, good, ends.from_camera[:t])
    for s in range(1, 4):
        y, _, y_bsdf, _ = ends.from_light[s - 1]
        C, others, _ = to_camera(
            ends.sensor, ends.lens, y, y_bsdf, scatters_smoothly(y_bsdf), lambda si, toward, active: mi.Bool(False)
        )
        compare(others, ends.densities(0, s, area), s + 1, dr.max(C) > 0, ends.from_light[:s])


def light_vertices(mi, scene, spp):
    """Camera samples of a 16x16 image with what is kept of their light paths: (camera, kept, count)."""
    from data_gen.film.splats import Splats
    from data_gen.paths.camera import CameraSamples
    from data_gen.samplers.bdpt.integrator import Splatter
    from data_gen.samplers.bdpt.lights import LightEnds
    from data_gen.samplers.common import like_path

    camera = CameraSamples(scene.sensors()[0], 0, spp)
    ray, importance, _ = camera.rays()
    integrator = like_path(scene, "bdpt")
    splatter = Splatter(Splats(256, 3), ray, importance)
    kept, count, *_ = integrator.light_path(scene, LightEnds(scene), camera, camera.random.clone(), ray, 6, splatter)
    return camera, kept, count


def test_light_vertices_are_kept_where_they_belong(renderer):
    """Dr.Jit 1.5 (LLVM) loses what lanes write to different places of local memory: all light behind glass, once."""
    import drjit as dr

    scene = load(renderer, glass, (16, 16))
    _, kept, count = light_vertices(renderer, scene, 16)
    depths = [kept.read(renderer.UInt32(i)).depth for i in range(5)]
    dr.eval(depths, count)
    depths, count = np.stack([np.array(depth) for depth in depths], axis=1), np.array(count)[:, None]
    place = np.arange(1, 6)
    assert np.isin(depths, (0, *place)).all() and ((depths == 0) | (depths == place)).all()
    assert (depths[place > count] == 0).all()
    # Behind the glass: nothing was kept of the first vertices, but of the third.
    assert ((depths[:, 0] == 0) & (depths[:, 1] == 0) & (depths[:, 2] == 3)).mean() > 0.01


def test_every_connection_counts_once_in_the_mean(renderer):
    """One of them is made, with 1 / its probability: chance and factor cancel for each of them."""
    import drjit as dr

    from data_gen.samplers.bdpt import mis
    from data_gen.samplers.bdpt.choice import choose
    from data_gen.samplers.bdpt.vertex import Vertex, cosine

    mi, longest = renderer, 5
    scene = load(mi, glass, (16, 16))
    camera, kept, count = light_vertices(mi, scene, 256)
    ray, _, _ = camera.rays()
    z = scene.ray_intersect(mi.Ray3f(ray))
    _, e = camera.sensor.sample_direction(z, camera.lens)
    vertex = Vertex(z, mi.Spectrum(1), mis.begin_camera(e[0], cosine(z, ray.d)), mi.UInt32(1))
    chosen, times = choose(vertex, z.is_valid(), kept, count, longest, camera.random.clone().next_1d())
    depths = [kept.read(mi.UInt32(i)).depth for i in range(5)]
    dr.eval(chosen, times, depths, count)
    chosen, times, count, valid = (np.array(x) for x in (chosen, times, count, z.is_valid()))
    for i, depth in enumerate(depths):
        here = (np.array(depth) > 0) & (i < count) & valid & (1 + i + 1 + 1 <= longest)
        made = np.where(chosen == i, times, 0)
        assert not made[~here].any() and (made[here] > 0).any() == here.any()
        if here.any():
            error = made[here].std() / np.sqrt(here.sum())
            assert abs(made[here].mean() - 1) < 4 * error + 1e-6 and error < 0.1, (i, made[here].mean(), error)


def test_nothing_kept_is_a_bool(renderer):
    """Dr.Jit 1.5 aborts the whole process where there is one in local memory."""
    from typing import get_type_hints

    import mitsuba as mi

    from data_gen.samplers.bdpt import vertex

    assert mi.Bool not in get_type_hints(vertex.record_class(mi.variant()), {"mi": mi}).values()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sensor": {"type": "orthographic"}}, "light paths cannot reach a camera of type OrthographicCamera"),
        ({"lamp": {"type": "projector", "irradiance": 1.0}}, r"from emitter 'lamp' \(Projector\); use --sampler gpt"),
    ],
)
def test_what_it_cannot_render(renderer, change, message):
    from data_gen.render import render_stack

    scene = load(renderer, lambda: SCENES["points"]() | change, (8, 8))
    with pytest.raises(NgptError, match=message):
        render_stack(scene, 1, 0, "bdpt")


def test_options_out_of_range(renderer):
    from data_gen.render import render_stack

    with pytest.raises((NgptError, RuntimeError), match=r"joined_depth 0 is out of range; use 1 \.\. 64"):
        render_stack(load(renderer, "diffuse", (8, 8)), 1, 0, "bdpt", joined_depth=0)


def test_scenes_without_lights_are_black(renderer):
    from data_gen.render import render_stack

    def dark():
        scene = SCENES["points"]()
        return {key: value for key, value in scene.items() if key not in ("point", "spot", "sun")}

    stack = render_stack(load(renderer, dark, (8, 8)), 4, 0, "bdpt")
    assert not stack["primal"].any() and stack["albedo"].any()


def test_media_are_refused():
    from data_gen.samplers import find
    from data_gen.scenes.facts import Facts

    with pytest.raises(NgptError, match=r"there are media .*, which 'bdpt' does not see"):
        find("bdpt", Facts("path", ("air",)))
