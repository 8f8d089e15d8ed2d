"""What the kernel contains is decided by the scene, and changes nothing but its cost."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from data_gen_scenes import plenty, polished
from unbiased import load

from data_gen.paths.lights import Lights, emission, replay_light, sample_light, shadowed, shared_emission
from data_gen.paths.vertex import seen_from
from data_gen.paths.walk import Limits
from data_gen.samplers import SAMPLERS
from data_gen.samplers.gpt.plan import make_plan

FAILURES = "diagnostics.shiftFailures"


def render(scene, spp=16, **options):
    """Layers of our integrator with these parameters, and the rate of failed shifts if that is asked for."""
    integrator = SAMPLERS["gpt"].integrator(scene)
    for name, value in options.items():
        setattr(integrator, name, value)
    film = integrator.render_film(scene, scene.sensors()[0], 0, spp)
    return film.develop() | {k: v for k, v in film.diagnose().items() if k == FAILURES}


def test_plans(renderer):
    """Whether shifts replay, and whether emitters answer the same numbers alike everywhere: a point light is neither
    far away nor a surface."""
    plans = [
        ("diffuse", (False, True)),
        ("glossy", (True, True)),
        ("environment", (True, True)),
        ("lens", (False, False)),
        (plenty, (True, False)),
        (lambda: polished(0.01), (True, True)),
        (lambda: polished(0.3), (False, True)),
    ]
    for description, expected in plans:
        plan = make_plan(load(renderer, description, (4, 4)), Limits())
        assert (plan.replays, plan.lights.shared) == expected, description
        assert not plan.half_vectors and not plan.hides and not plan.space.media
    hiding, by_half_vectors = Limits(hide_emitters=True), {"shift": "half-vector"}
    scene = load(renderer, "environment", (4, 4))
    assert make_plan(scene, hiding).hides and make_plan(scene, Limits(), **by_half_vectors).half_vectors
    assert not make_plan(load(renderer, "diffuse", (4, 4)), hiding, **by_half_vectors).half_vectors


AREA = {"emitter": {"type": "area"}}
LAMPS = {
    **{shape: {"type": shape, **AREA} for shape in ("rectangle", "disk", "cylinder", "cube")},
    **{sky: {"type": sky} for sky in ("constant", "sunsky", "directional", "envmap")},
    "two": {"type": "rectangle", **AREA},
}


@pytest.mark.parametrize("name", LAMPS)
def test_shared_emitters_are_what_sampling_would_find(renderer, name):
    """Taken over from another vertex, an emitter has the direction, density and weight that it has here."""
    lamp = dict(LAMPS[name])
    if name == "envmap":
        lamp["bitmap"] = mi.Bitmap(np.random.default_rng(1).random((8, 16, 3)).astype(np.float32))
    block = {"type": "sphere", "center": [0, 0, 2.5], "radius": 0.4}
    scene = {"type": "scene", "lamp": lamp, "block": block} | ({"sky": {"type": "constant"}} if name == "two" else {})
    scene = load(mi, scene)
    lights = Lights(scene)
    assert lights.shared
    random = mi.load_dict({"type": "independent"})
    random.seed(3, 1 << 14)

    def vertex():
        """Somewhere around the lamp; some of it is hidden by the block."""
        si = dr.zeros(mi.SurfaceInteraction3f, 1 << 14)
        p = 8 * mi.Point3f(random.next_1d(), random.next_1d(), random.next_1d()) - 4
        si.p = dr.select(dr.norm(p) < 2, p + mi.Vector3f(0, 0, 5), p)
        si.n = mi.Normal3f(0, 0, 1)
        return si

    x, y, u, yes = vertex(), vertex(), random.next_2d(), mi.Bool(True)
    base, weight = scene.sample_emitter_direction(x, u, False, yes)
    shared, own = replay_light(scene, lights, base, weight, u, y, lit=yes), sample_light(scene, y, u, yes)
    shared.weight = shadowed(scene, y, shared, mi.Spectrum(1))
    found = dr.max(own.weight) > 0
    assert dr.count(found)[0] > 500
    assert mostly((dr.max(shared.weight) > 0) == found)
    assert mostly(dr.all(dr.abs(shared.weight - own.weight) <= 1e-3 * dr.abs(own.weight)))
    assert mostly(~found | ((dr.norm(shared.d - own.d) < 1e-3) & (dr.abs(shared.p - own.p) <= 2e-3 * own.p)))

    # The same for emission that is met, along rays from x to where y connects.
    ray = x.spawn_ray(dr.normalize(mi.Vector3f(2 * random.next_1d() - 1, 2 * random.next_1d() - 1, 0) - x.p))
    x1 = scene.ray_intersect(ray)
    Le, p = emission(scene, x1, x, yes, yes)
    direction = dr.select(x1.is_valid(), dr.normalize(x1.p - y.p), ray.d)
    y1 = seen_from(x1, direction)
    J = dr.squared_norm(x1.p - y.p) / dr.square(x1.t)
    shared = shared_emission(scene, lights, x1, Le, p, x=x, y=y, y1=y1, J=J)
    own = emission(scene, y1, y, yes, yes)
    assert dr.any(dr.max(own[0]) > 0) or name == "directional"
    assert mostly(dr.all(dr.abs(shared[0] - own[0]) <= 1e-3 * dr.abs(own[0])))
    assert mostly((dr.abs(shared[1] - own[1]) <= 5e-3 * own[1]) | (dr.max(own[0]) == 0))


def mostly(condition):
    """All but a few lanes, where rounding decides: emitters seen edge-on."""
    return np.array(condition).mean() > 0.99


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["glossy", plenty])
def test_the_primal_of_base_and_offset_paths_has_less_noise(renderer, scene):
    scene = load(renderer, scene, (32, 32))
    base, reused = render(scene, 64), render(scene, 64, reuse=True)
    assert np.array_equal(base["dx"], reused["dx"])
    dark = base["direct"].sum(axis=-1) == 0
    # The median: means are those of a few fireflies.
    assert np.median(reused["primal_var"][dark] / base["primal_var"][dark]) < 0.65


def test_the_primal_of_base_and_offset_paths_is_of_neighbours(renderer):
    """Their samples lie a block apart, not a pass; without neighbours it is that of the base paths."""
    scene = load(renderer, "diffuse", (16, 16))
    many, few, base = (
        render(scene, spp, reuse=reuse)["primal"] for spp, reuse in ((70, True), (16, True), (70, False))
    )
    assert np.abs(many - base).mean() < np.abs(few - many).mean()
    pixel = load(renderer, "diffuse", (1, 1))
    assert np.allclose(render(pixel)["primal"], render(pixel, reuse=True)["primal"], rtol=1e-5)


def test_failed_shifts_are_counted_when_asked(renderer):
    """Mirrors sampled at joined vertices are what fails most: glossier scenes fail more often than matte ones."""
    glossy, diffuse = (load(renderer, name, (32, 32)) for name in ("glossy", "diffuse"))
    plain, counted = render(glossy), render(glossy, diagnostics=True)
    failures = counted.pop(FAILURES)
    assert failures.shape == (32, 32) and failures.min() >= 0 and 0.01 < failures.mean() < 0.5 and failures.max() <= 1
    assert render(diffuse, diagnostics=True)[FAILURES].mean() < failures.mean()
    assert plain.keys() == counted.keys()
    for name in plain:
        assert np.array_equal(plain[name], counted[name]), name
