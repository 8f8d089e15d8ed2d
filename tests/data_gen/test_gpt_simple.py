"""The teaching twin of ``gpt`` is right for what it renders, and refuses the rest.

The laws that all samplers share are in ``test_samplers``. The budget of z-tests is fixed: 16 stacks of 64 spp against
24 references of 128 spp at 32x32 pixels, a level of 1 % for a scene as a whole.
"""

from functools import partial

import numpy as np
import pytest
from data_gen_scenes import fog, furnace, hidden_lamp, polished
from unbiased import gradient_tests, load, render_ours, render_references

from data_gen.samplers import find
from ngpt.errors import NgptError
from ngpt.testing import z_test


def courtyard():
    """Things that scatter widely, in as many ways as can be, under a sky, a bulb, a lamp and a point light.

    One wall is black in red and green, so that paths go on there which carry nothing for some or all of five.
    """
    from data_gen.scenes.builtin import _box, _camera, _diffuse, _light, _rgb, _room, _sphere, _transform, _wall

    tiles = {"type": "checkerboard", "to_uv": _transform().scale([3, 3, 1])}
    satin = {"type": "roughplastic", "diffuse_reflectance": tiles, "alpha": 0.2}
    black = {"type": "diffuse", "reflectance": tiles | {"color0": _rgb(0, 0, 0), "color1": _rgb(0, 0, 0.8)}}
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 7, "rr_depth": 5},
        "sensor": _camera([0, 1.25, 3.9], [0, 1.0, 0], 50)
        | {"type": "thinlens", "aperture_radius": 0.04, "focus_distance": 4.0},
        **{name: wall for name, wall in _room(1.5, satin).items() if name != "ceiling"},
        "sky": {"type": "constant", "radiance": _rgb(0.3, 0.4, 0.5)},
        "lamp": _light([0.3, 2.3, 0], [0, -1, 0], (1.0, 1.0), (3, 3, 2.5)),
        "bulb": _sphere([-1.1, 1.9, -0.6], 0.15, _diffuse(0, 0, 0))
        | {"emitter": {"type": "area", "radiance": _rgb(6, 4, 2)}},
        "point": {"type": "point", "position": [0.8, 2.0, 1.6], "intensity": _rgb(1.5, 1.5, 1.8)},
        "brushed": _sphere([-0.9, 0.5, -0.2], 0.5, {"type": "roughconductor", "material": "Cu", "alpha": 0.3}),
        "frosted": _sphere([0.1, 0.4, 0.4], 0.4, {"type": "roughdielectric", "alpha": 0.3}),
        "box": _box([0.95, 0.5, -0.4], [0.6, 1.0, 0.6], 25, {"type": "twosided", "nested": _diffuse(0.3, 0.5, 0.4)}),
        "panel": _wall([-0.3, 1.5, -0.6], [0.2, 0, 1], (0.9, 0.7), black),
    }


@pytest.fixture(scope="module")
def stacks(renderer):
    """Layers of 16 stacks of the courtyard."""
    return render_ours(load(renderer, courtyard, (32, 32)), "gpt-simple")


@pytest.fixture(scope="module")
def references(renderer):
    return render_references(renderer, load(renderer, courtyard, (32, 32)), spp=128)


def test_unbiased(stacks, references):
    assert references.mean() > 0.01  # black images agree all too well
    for name, result in gradient_tests(stacks, references):
        assert result.passed, f"{name}: {result}"


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["diffuse", "lens", courtyard])
def test_unbiased_with_a_large_budget(renderer, scene):
    scene = load(renderer, scene, (64, 64))
    references = render_references(renderer, scene, batches=32, spp=1024)
    for name, result in gradient_tests(render_ours(scene, "gpt-simple", spp=512), references):
        assert result.passed, f"{name}: {result}"


def limited(max_depth):
    def scene():
        description = courtyard()
        description["integrator"]["max_depth"] = max_depth
        return description

    return scene


@pytest.mark.parametrize("max_depth", [2, 3])
def test_unbiased_where_paths_end_at_a_step_that_is_written_out(renderer, max_depth):
    scene = load(renderer, limited(max_depth), (16, 16))
    references = render_references(renderer, scene, batches=16, spp=256)
    for name, result in gradient_tests(render_ours(scene, "gpt-simple", batches=10), references):
        assert result.passed, f"{name}: {result}"


def test_depth_limits(renderer):
    from data_gen.render import render_stack

    for max_depth in (0, 1):
        stack = render_stack(load(renderer, limited(max_depth), (16, 16)), 16, sampler="gpt-simple")
        assert stack["primal"].any() == stack["direct"].any() == (max_depth == 1)
        assert not stack["dx"].any() and not stack["dy"].any()


def test_furnace(renderer):
    """Up to forty vertices in a closed ball, where roulette ends most paths: radiance is 1 everywhere."""
    stacks = render_ours(load(renderer, furnace, (16, 16)), "gpt-simple")
    # Mitsuba's own integrators are 0.08 % too bright there, too, which quiet samples show.
    assert abs(np.mean([stack["primal"] for stack in stacks]) - 1) < 2e-3
    for name in ("dx", "dy"):
        ours = np.stack([stack[name] for stack in stacks])
        result = z_test(ours, np.zeros_like(ours))
        assert result.passed, f"{name}: {result}"


def test_agrees_with_the_full_integrator(renderer, stacks):
    from data_gen.render import render_stack

    scene = load(renderer, courtyard, (32, 32))
    full = [render_stack(scene, 64, 100 + seed, "gpt").layers for seed in range(16)]
    for name in ("primal", "direct", "dx", "dy", "albedo", "normal"):
        result = z_test(*(np.stack([stack[name] for stack in both]) for both in (stacks, full)))
        assert result.passed, f"{name}: {result}"
    # The same shift with the same weights is as noisy, but for roulette and the outliers of so few samples.
    for name in ("dx_var", "dy_var"):
        ours, theirs = (np.mean([stack[name] for stack in both]) for both in (stacks, full))
        assert ours == pytest.approx(theirs, rel=0.25), name


@pytest.mark.slow
@pytest.mark.parametrize(
    ("function", "mutant"),
    [
        ("reconnection_jacobian", lambda mi, *geometry: mi.Float(1)),
        ("gradient_weight", lambda mi, r, good: mi.Float(1)),
    ],
    ids=["no Jacobian", "w is 1/2"],
)
def test_mutants_fail_the_z_test(renderer, references, function, mutant, monkeypatch):
    from data_gen.samplers.teaching import gpt_simple

    monkeypatch.setattr(gpt_simple, function, partial(mutant, renderer))
    stacks = render_ours(load(renderer, courtyard, (32, 32)), "gpt-simple")
    passed = {name: result.passed for name, result in gradient_tests(stacks, references)}
    assert passed["primal"] and not (passed["dx"] or passed["dy"])


def test_random_replay_of_it_is_random_replay(renderer):
    """As a plugin that samples radiance, in place of Mitsuba's ``path``."""
    scene = load(renderer, courtyard, (12, 12))
    nested = {"type": "gpt_simple", "max_depth": 7, "rr_depth": 5}
    replay = renderer.load_dict({"type": "gpt_basic", "nested": nested})
    ours = np.array(renderer.render(scene, integrator=replay, spp=256))
    assert ours[..., replay.aov_names().index("dx.R")].any()
    assert ours[..., :3].mean() == pytest.approx(np.array(renderer.render(scene, spp=1024)).mean(), rel=0.05)


class Pairs:
    """The first two steps of base paths, shifted to a neighbouring pixel; and the same offset paths shifted back."""

    def __init__(self, mi, scene):
        import drjit as dr

        from data_gen.paths.camera import CameraSamples
        from data_gen.samplers.teaching.gpt_simple import base_step, start, step_apart, step_joined

        self.mi, self.scene = mi, scene
        camera = CameraSamples(scene.sensors()[0], 5, 64)
        (ray, _, _), (other, _, inside) = camera.rays(), camera.rays((1, 0))
        one, random = mi.Spectrum(1), camera.random
        x = scene.ray_intersect(mi.Ray3f(ray))
        first = base_step(scene, random, x, one, x.is_valid() & inside)
        apart = start(scene, x.is_valid() & inside, other, one)
        joined = step_apart(scene, first, apart)
        second = base_step(scene, random, first.x1, first.β1, first.x1.is_valid())
        self.there = step_joined(second, joined)

        to = dr.select(first.x1.is_valid(), dr.normalize(first.x1.p - apart.y.p), x.to_world(first.wo))
        back = self.step(apart.y, one, first, apart.y.to_local(to), joined.y)
        joined_back = step_apart(scene, back, start(scene, apart.r > 0, ray, one))
        again = self.step(joined.y, back.β1, second, second.wo, second.x1)
        self.back, self.both = step_joined(again, joined_back), again.goes_on
        self.tried, self.r, self.r_back = first.goes_on & (apart.r > 0), joined.r, joined_back.r
        dr.eval(self.there, self.back, self.tried, self.r, self.r_back)

    def step(self, x, β, other, wo, x1):
        """A step as if base path sampling had gone along ``wo`` to ``x1``; the emitter's numbers are of ``other``."""
        import drjit as dr

        from data_gen.paths.lights import emission, sample_light
        from data_gen.paths.shift import mis_weight
        from data_gen.paths.vertex import evaluate
        from data_gen.samplers.teaching.gpt_simple import Step, reflected

        light = sample_light(self.scene, x, other.u_light, x.is_valid())
        f, p = evaluate(x.bsdf(), x, wo)
        goes_on = other.goes_on & (p > 0)
        β1 = dr.select(goes_on, β * f / p, 0)
        Le, p_light = emission(self.scene, x1, x, goes_on, goes_on)
        L_light, L_bsdf = reflected(light, x), Le * mis_weight(p, p_light)
        kind = other.smooth, other.hole
        return Step(x, β, other.u_light, light, L_light, wo, p, goes_on, β1, x1, Le, p_light, L_bsdf, *kind, other.hit)


@pytest.fixture(scope="module")
def pairs(renderer):
    return Pairs(renderer, load(renderer, courtyard, (32, 32)))


def test_a_pair_says_the_same_from_either_side(pairs):
    """Sampled from the other side the same two paths have 1 / r, so that w and w' add up to 1, and -Δ and -a."""
    shifted = np.array(pairs.tried & (pairs.r > 0))
    r, r_back = np.array(pairs.r)[shifted], np.array(pairs.r_back)[shifted]
    assert (r_back > 0).mean() > 0.999
    # Mitsuba's rays start a little off the surface, which shows where angles are flat or vertices close.
    assert (np.abs(r * r_back - 1) < 0.05).mean() > 0.98
    both = shifted & np.array(pairs.both)
    for there, back in zip(pairs.there, pairs.back, strict=True):
        there, back = np.array(there)[:, both], np.array(back)[:, both]
        off = np.abs(there + back) > 0.05 * np.abs(there) + 1e-3 * np.abs(there).mean()
        assert off.mean() < 0.02


def test_most_shifts_succeed(pairs):
    assert (np.array(pairs.r) > 0).sum() > 0.8 * np.array(pairs.tried).sum()  # measured: 0.88


def test_gradients_have_less_variance_than_differences_of_pixels(renderer):
    from data_gen.render import render_stack

    stack = render_stack(load(renderer, "diffuse", (48, 48)), 64, sampler="gpt-simple")
    # Pixels at lamps have the variance of the lamp's edge in the primal, but not in the gradients.
    unlit = stack["direct"].sum(axis=-1) == 0
    here = unlit[:, 1:] & unlit[:, :-1]
    independent = (stack["primal_var"][:, 1:] + stack["primal_var"][:, :-1])[here].mean()
    assert independent > 5 * stack["dx_var"][:, :-1][here].mean()  # measured: 11


@pytest.mark.parametrize(
    ("scene", "reason"),
    [
        (lambda: polished(0.01), r"floor.bsdf \(RoughConductor\).*use --sampler gpt"),
        ("environment", r"ball.bsdf \(SmoothPlastic\); use --sampler gpt"),
        ("glossy", r"glass.bsdf \(SmoothDielectric\), lacquer.bsdf .*, mirror.bsdf .*; use --sampler gpt"),
        (fog, "'gpt-simple' knows only 'path'; use --sampler gpt, or gpt-basic"),
        (hidden_lamp, "hides emitters; use --sampler gpt"),
    ],
)
def test_refuses_what_it_cannot_render(renderer, scene, reason):
    from data_gen.render import render_stack

    with pytest.raises(NgptError, match=f"sampler 'gpt-simple' cannot render this scene: .*{reason}"):
        render_stack(load(renderer, scene, (8, 8)), 1, sampler="gpt-simple")


def test_takes_what_is_rough_enough(renderer):
    assert callable(find("gpt-simple").made(load(renderer, lambda: polished(0.06), (8, 8))))
