"""What is particular to ``bdpt``: MIS weights by brute force, and what is kept of light paths."""

import numpy as np
from bdpt_ends import Ends, check_weights, plan_of, without_hole
from data_gen_scenes import glass
from unbiased import load


def test_weights_are_those_of_all_densities(renderer):
    """Brute force in float64, on stored paths: no z-test sees every wrong term."""
    check_weights(Ends(renderer, load(renderer, without_hole, (24, 24))))


def light_vertices(mi, scene, spp):
    """Camera samples of a 16x16 image with their light paths."""
    from data_gen.film.splats import Splats
    from data_gen.paths.camera import CameraSamples
    from data_gen.paths.eye import Sight
    from data_gen.samplers.bdpt.integrator import Splatter
    from data_gen.samplers.bdpt.light_path import light_path

    camera = CameraSamples(scene.sensors()[0], 0, spp)
    sight = Sight.of(camera)
    light, _, _ = light_path(plan_of(scene, 6), sight, Splatter(Splats(256, 3), sight.ray, sight.importance))
    return camera, light


def test_light_vertices_are_kept_where_they_belong(renderer):
    """Dr.Jit 1.5 (LLVM) loses what lanes write to different places of local memory: all light behind glass, once."""
    import drjit as dr

    scene = load(renderer, glass, (16, 16))
    _, light = light_vertices(renderer, scene, 16)
    kept, count = light.kept, light.count
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
    camera, light = light_vertices(mi, scene, 256)
    kept, count = light.kept, light.count
    ray, _, _ = camera.rays()
    z = scene.ray_intersect(mi.Ray3f(ray))
    _, e = camera.sensor.sample_direction(z, camera.lens)
    vertex = Vertex(z, mi.Spectrum(1), mis.begin_camera(e[0], cosine(z, ray.d)), mi.UInt32(1))
    chosen, times = choose(vertex, z.is_valid(), light, longest, camera.random.clone().next_1d())
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
