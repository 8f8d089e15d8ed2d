"""Lamps of few faces with smooth normals, in all samplers, against images that sample no lamps.

Mitsuba's ``path`` weighs such a lamp by its vertex normals (its issue 1952), and so it is no reference here. Emission
that is met by chance has no density.
"""

import numpy as np
import pytest
from unbiased import differences, light_apart, load, render_ours

from data_gen.samplers import FRAME_SAMPLERS, SAMPLERS
from ngpt.testing import z_test

SIZE, BLOCK = (48, 32), 4
# Without those whose radius blurs (vcm gathers little of direct light), and those that leave such lamps to Mitsuba
RIGHT = [pytest.param("vcm", marks=pytest.mark.slow)]
RIGHT += [
    name for name, entry in SAMPLERS.items() if not (entry.biased or entry.leaves_lamps or entry.standing == "study")
]


def ball(**surface):
    """A ball of 20 faces with the normals of a sphere, low over a matt floor, which sees it from all around."""
    from lamps_scenes import bowl

    from data_gen.scenes.builtin import _camera, _diffuse, _rgb, _wall

    lamp = bowl([0, 0.5, 0], 0.4, rows=4) | {"bsdf": _diffuse(0, 0, 0)} | surface
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 2},
        "sensor": _camera([0, 2.2, 2], [0, 0.2, 0], 40),
        "floor": _wall([0, 0, 0], [0, 1, 0], (9, 9), _diffuse(0.6, 0.5, 0.4)),
        "lamp": lamp | {"emitter": {"type": "area", "radiance": _rgb(6, 4, 2)}},
    }


@pytest.fixture(scope="module")
def expected(renderer):
    scene = load(renderer, ball(), SIZE)
    integrator = renderer.load_dict({"type": "direct", "emitter_samples": 0, "bsdf_samples": 1})
    images = [renderer.render(scene, integrator=integrator, spp=512, seed=1000 + i) for i in range(24)]
    return np.stack([np.array(image) for image in images])


def off(images, references):
    """The root of the mean of z² over blocks of grey pixels; 1 where only noise differs."""
    result = z_test(*(each.mean(axis=-1, keepdims=True) for each in (images, references)), block=BLOCK)
    return float(np.sqrt((result.z[result.z != 0] ** 2).mean()))


@pytest.mark.slow
def test_mitsuba_is_no_reference(renderer, expected):
    """The day that Mitsuba is right, ``paths/bent.py`` can go."""
    scene = load(renderer, ball(), SIZE)
    theirs = np.stack([np.array(renderer.render(scene, spp=64, seed=i)) for i in range(16)])
    assert off(theirs, expected) > 2


@pytest.mark.parametrize("sampler", RIGHT)
def test_samplers_have_the_light_of_paths_that_sample_no_lamps(renderer, expected, sampler):
    # Where a sample is a pass, few of them: a pass takes long to start.
    spp = 16 if SAMPLERS[sampler].batch == 1 else 64
    stacks = render_ours(load(renderer, ball(), SIZE), sampler, 16, spp)
    assert off(np.stack([stack["primal"] for stack in stacks]), expected) < 1.3
    for axis, name in enumerate(("dx", "dy") if "dx" in stacks[0] else ()):
        ours = np.stack([stack[name] + differences(light_apart(stack))[axis] for stack in stacks])
        assert off(ours, np.stack([differences(each)[axis] for each in expected])) < 1.3


def test_it_is_said_of_samplers_that_leave_lamps_to_mitsuba(renderer, caplog):
    from data_gen.inspect import warn_of_lost_light

    scene = load(renderer, ball(), SIZE)
    for sampler in {**SAMPLERS, **FRAME_SAMPLERS}:
        caplog.clear()
        warn_of_lost_light(scene, sampler)
        leaves = (FRAME_SAMPLERS.get(sampler) or SAMPLERS[sampler]).leaves_lamps
        assert ("wrong normal" in caplog.text) == leaves


@pytest.mark.parametrize("inside", [False, True])
def test_a_sampled_point_has_the_density_of_the_same_point_met(renderer, inside):
    """Also inside a ball whose normals are flipped; and never one that does not shine."""
    import drjit as dr

    from data_gen.paths.lights import Lights, emission

    mi, lanes = renderer, 1 << 14
    scene = load(mi, ball(flip_normals=inside), SIZE)
    lights, random = Lights(scene), mi.PCG32(lanes)
    at = mi.Point3f(*(random.next_float32() - 0.5 for _ in "xyz")) * (0.2 if inside else 3)
    x = dr.zeros(mi.SurfaceInteraction3f, lanes)
    x.p, x.n = at + mi.Vector3f(0, 0.5, 0), mi.Normal3f(0, 1, 0)
    u = mi.Point2f(random.next_float32(), random.next_float32())
    light, weight, _ = lights.sample(scene, x, u, mi.Bool(True))
    x1 = scene.ray_intersect(x.spawn_ray(light.d))
    Le, p = emission(scene, x1, x, mi.Bool(True), mi.Bool(True), lights)
    seen = (light.pdf > 0) & (dr.norm(x1.p - light.p) < 2e-3)
    seen &= dr.norm(x.p - mi.Point3f(0, 0.5, 0)) < 0.25 if inside else dr.norm(x.p - mi.Point3f(0, 0.5, 0)) > 0.41
    seen = np.array(seen)
    assert seen.sum() > 2000
    assert (np.abs(np.array(light.pdf / p)[seen] - 1) < 1e-2).mean() > 0.98
    assert (np.abs(np.array(weight * p - Le))[:, seen] < 0.1).mean() > 0.98
    assert (np.array(weight)[:, np.array(light.pdf == 0)] == 0).all()
