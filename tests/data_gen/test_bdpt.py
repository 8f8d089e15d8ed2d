"""What is particular to ``bdpt``: what is kept of light paths. Its weights are tested with the weights of ``vcm``."""

from typing import get_type_hints

import numpy as np
import pytest
from bdpt_ends import plan_of
from data_gen_scenes import glass
from renders import dr, mi
from unbiased import load

from data_gen.film.splats import Splats
from data_gen.paths.camera import CameraSamples
from data_gen.paths.eye import Sight
from data_gen.samplers.bdpt import mis
from data_gen.samplers.bdpt.camera_path import choose
from data_gen.samplers.bdpt.light_path import light_path
from data_gen.samplers.bdpt.vertex import Vertex, cosine


@pytest.fixture(scope="module")
def light(renderer):
    """Camera samples of a 16x16 image, their light paths, and the depths of the vertices kept of these, (5, N)."""
    from data_gen.samplers.bdpt.integrator import Splatter

    scene = load(renderer, glass, (16, 16))
    camera = CameraSamples(scene.sensors()[0], 0, 256)
    sight = Sight.of(camera)
    path, _, _ = light_path(plan_of(scene, 6), sight, Splatter(Splats(256, 3), sight.ray, sight.importance))
    depths = [path.kept.read(renderer.UInt32(i)).depth for i in range(5)]
    dr.eval(path, depths)
    return scene, camera, path, np.array([np.array(depth) for depth in depths])


def test_light_vertices_are_kept_where_they_belong(light):
    """Dr.Jit 1.5 (LLVM) loses what lanes write to different places of local memory: all light behind glass, once."""
    _, _, path, depths = light
    place = np.arange(1, 6)[:, None]
    assert ((depths == 0) | (depths == place)).all() and (depths[place > np.array(path.count)] == 0).all()
    # Behind the glass: nothing was kept of the first vertices, but of the third.
    assert ((depths[0] == 0) & (depths[1] == 0) & (depths[2] == 3)).mean() > 0.01


def test_every_connection_counts_once_in_the_mean(renderer, light):
    """One of them is made, with 1 / its probability: chance and factor cancel for each of them."""
    scene, camera, path, depths = light
    longest = 5
    ray, _, _ = camera.rays()
    z = scene.ray_intersect(mi.Ray3f(ray))
    _, e = camera.sensor.sample_direction(z, camera.lens)
    vertex = Vertex(z, mi.Spectrum(1), mis.begin_camera(e[0], cosine(z, ray.d)), mi.UInt32(1))
    found = choose(vertex, z.is_valid(), path, longest, camera.random.clone().next_1d())
    chosen, times, count, valid = (np.array(x) for x in (*found, path.count, z.is_valid()))
    for i, depth in enumerate(depths):
        here = (depth > 0) & (i < count) & valid & (1 + i + 1 + 1 <= longest)
        made = np.where(chosen == i, times, 0)
        assert not made[~here].any() and (made[here] > 0).any() == here.any()
        if here.any():
            error = made[here].std() / np.sqrt(here.sum())
            assert abs(made[here].mean() - 1) < 4 * error + 1e-6 and error < 0.1, (i, made[here].mean(), error)


def test_nothing_kept_is_a_bool(renderer):
    """Dr.Jit 1.5 aborts the whole process where there is one in local memory."""
    from data_gen.samplers.bdpt import vertex

    hints = get_type_hints(vertex.record_class(renderer.variant()), {"mi": renderer})
    assert renderer.Bool not in hints.values()
