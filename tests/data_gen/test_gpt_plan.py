"""What the kernel contains is decided by the scene, and changes nothing but its cost."""

import numpy as np
import pytest
from data_gen_scenes import plenty, polished
from unbiased import load

from ngpt.testing import z_test


def make_plan(scene, *args, hide_emitters=False, **options):
    from data_gen.paths.walk import Limits
    from data_gen.samplers.gpt import plan

    return plan.make_plan(scene, *(args or [Limits(8, hide_emitters=hide_emitters)]), **options)


def render(scene, spp=16, size=None, **options):
    """Layers of our integrator with these parameters, and the rate of failed shifts if that is asked for."""
    from data_gen.samplers import SAMPLERS

    integrator = SAMPLERS["gpt"].integrator(scene)
    for name, value in options.items():
        setattr(integrator, name, value)
    film = integrator.render_film(scene, scene.sensors()[0], 0, spp)
    return film.develop() | {k: v for k, v in film.diagnose().items() if k == FAILURES}


FAILURES = "diagnostics.shiftFailures"


def test_plans(renderer):
    plans = {name: make_plan(load(renderer, name, (4, 4))) for name in ("diffuse", "glossy", "environment", "lens")}
    assert [name for name, plan in plans.items() if plan.replays] == ["glossy", "environment"]
    assert [name for name, plan in plans.items() if plan.lights.shared] == ["diffuse", "glossy", "environment"]
    assert not plans["glossy"].half_vectors and not plans["environment"].hides
    scene = load(renderer, "environment", (4, 4))
    assert make_plan(scene, shift="half-vector").half_vectors and make_plan(scene, hide_emitters=True).hides
    assert not make_plan(load(renderer, "diffuse", (4, 4)), shift="half-vector", hide_emitters=True).half_vectors
    assert make_plan(load(renderer, lambda: polished(0.01), (4, 4))).replays
    assert not make_plan(load(renderer, lambda: polished(0.3), (4, 4))).replays
    # A point light is neither far away nor a surface; without any light there is nothing to share.
    assert not make_plan(load(renderer, plenty, (4, 4))).lights.shared


@pytest.mark.parametrize(("name", "flag"), [("diffuse", "replays"), ("glossy", "shared"), ("environment", "shared")])
def test_the_general_kernel_renders_the_same(renderer, name, flag, monkeypatch):
    """Code that a scene does not need, put in by force."""
    from data_gen.samplers.gpt import integrator as gpt

    scene = load(renderer, name, (32, 32))
    lean = render(scene)

    def general(*args, **options):
        plan = make_plan(*args, **options)
        if flag == "replays":
            plan.replays = True
        else:
            plan.lights.shared = False
        return plan

    monkeypatch.setattr(gpt, "make_plan", general)
    full = render(scene)
    for layer in ("primal", "dx", "dy"):
        # Paths are the same but for rounding, which now and then decides whether something is hit.
        off = np.abs(lean[layer] - full[layer]) > 1e-3 * np.abs(full["primal"]).mean()
        assert off.mean() < 0.01, layer


LAMPS = {
    "rectangle": {"type": "rectangle", "emitter": {"type": "area"}},
    "disk": {"type": "disk", "emitter": {"type": "area"}},
    "cylinder": {"type": "cylinder", "emitter": {"type": "area"}},
    "cube": {"type": "cube", "emitter": {"type": "area"}},
    "constant": {"type": "constant"},
    "sunsky": {"type": "sunsky"},
    "directional": {"type": "directional"},
    "envmap": {"type": "envmap"},
    "two": {"type": "rectangle", "emitter": {"type": "area"}},
}


@pytest.mark.parametrize("name", LAMPS)
def test_shared_emitters_are_what_sampling_would_find(renderer, name):
    """Taken over from another vertex, an emitter has the direction, density and weight that it has here."""
    import drjit as dr

    from data_gen.paths.lights import Lights, emission, replay_light, sample_light, shadowed, shared_emission
    from data_gen.paths.vertex import seen_from

    mi, lamp = renderer, dict(LAMPS[name])
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
    from data_gen.samplers import SAMPLERS

    scene = load(renderer, scene, (32, 32))
    integrator = SAMPLERS["gpt"].integrator(scene)
    integrator.reuse = True
    stacks = [integrator.render_film(scene, scene.sensors()[0], 0, 64).develop()]
    base = render(scene, spp=64)
    assert np.array_equal(base["dx"], stacks[0]["dx"])
    dark = base["direct"].sum(axis=-1) == 0
    # The median: means are those of a few fireflies.
    assert np.median(stacks[0]["primal_var"][dark] / base["primal_var"][dark]) < 0.65


def test_the_primal_of_base_and_offset_paths_does_not_depend_on_passes(renderer):
    """Neighbours' samples lie a block apart, not a pass."""
    scene = load(renderer, "diffuse", (16, 16))
    many, few = render(scene, spp=70, reuse=True), render(scene, spp=16, reuse=True)
    assert (
        np.abs(many["primal"] - render(scene, spp=70)["primal"]).mean() < np.abs(few["primal"] - many["primal"]).mean()
    )


def test_the_primal_of_base_and_offset_paths_of_a_single_pixel(renderer):
    """Without neighbours it is that of the base paths."""
    scene = load(renderer, "diffuse", (1, 1))
    base, reused = render(scene), render(scene, reuse=True)
    assert np.allclose(base["primal"], reused["primal"], rtol=1e-5)


def test_failed_shifts_are_counted_when_asked(renderer):
    scene = load(renderer, "glossy", (32, 32))
    plain, counted = render(scene), render(scene, diagnostics=True)
    assert FAILURES not in plain
    failures = counted[FAILURES]
    assert failures.shape == (32, 32) and failures.min() >= 0 and 0.01 < failures.mean() < 0.5 and failures.max() <= 1
    for name in plain:
        assert np.array_equal(plain[name], counted[name]), name
    # Mirrors sampled at joined vertices are what fails most: glossier scenes fail more often than matte ones.
    assert render(load(renderer, "diffuse", (32, 32)), diagnostics=True)[FAILURES].mean() < failures.mean()


def test_shift_modes_agree(renderer):
    """Both shifts of one scene have the same mean gradients, with nothing connectable at all."""
    scene = load(renderer, lambda: polished(0.2), (24, 24))

    def batches(shift):
        from data_gen.samplers import SAMPLERS

        integrator = SAMPLERS["gpt"].integrator(scene)
        integrator.shift, integrator.roughness_threshold = shift, 10.0
        return [integrator.render_film(scene, scene.sensors()[0], seed, 64).develop()["dx"] for seed in range(16)]

    result = z_test(np.stack(batches("replay")), np.stack(batches("half-vector")))
    assert result.passed, result
