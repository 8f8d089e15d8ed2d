"""What is particular to ``bdpt``: MIS weights, all kinds of lights, what is kept of light paths, refusals.

That it is unbiased on quick scenes, repeats its bits and says how noisy it is, is among the laws of all samplers.
"""

import numpy as np
import pytest
from bdpt_ends import Ends, check_weights, plan_of, without_hole
from bdpt_scenes import SCENES
from data_gen_scenes import glass
from unbiased import REFERENCES, load, render_ours, render_references

from ngpt.errors import NgptError
from ngpt.testing import z_test

QUICK = ("sky",)


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


@pytest.mark.parametrize("joined_depth", [1, pytest.param(3, marks=pytest.mark.slow)])
def test_longer_paths_come_from_the_camera_alone(renderer, joined_depth):
    check(renderer, SCENES["areas"], joined_depth=joined_depth)


@pytest.mark.slow
# In monochromatic variants Dr.Jit does not find a number that the kernel uses.
@pytest.mark.recorded_anew
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


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sensor": {"type": "orthographic"}}, "light paths cannot reach a camera 'orthographic'"),
        ({"lamp": {"type": "projector", "irradiance": 1.0}}, r"from emitter 'lamp' \(Projector\); use --sampler gpt"),
    ],
)
def test_what_it_cannot_render(renderer, change, message):
    from data_gen.render import render_stack

    scene = load(renderer, lambda: SCENES["points"]() | change, (8, 8))
    with pytest.raises(NgptError, match=message):
        render_stack(scene, 1, 0, "bdpt")


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
