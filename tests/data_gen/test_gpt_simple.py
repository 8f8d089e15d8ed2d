"""The teaching twin of ``gpt`` is right for what it renders, refuses the rest, and is noisy no more than its model.

The budget is fixed: 16 stacks of 64 spp against 24 references of 128 spp at 32x32 pixels, a level of 1 % for a scene as
a whole.
"""

from functools import cache, partial

import numpy as np
import pytest
from data_gen_scenes import fog, furnace, hidden_lamp, polished
from unbiased import gradient_tests, load, render_ours, render_references

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
        "integrator": {"type": "path", "max_depth": 7, "rr_depth": 3},
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


SCENES = ["diffuse", "lens", courtyard]


@pytest.fixture(scope="module")
def stacks(renderer):
    """Stacks of a scene, (name or function) -> layers of each, rendered once."""
    return cache(lambda scene: render_ours(load(renderer, scene, (32, 32)), "gpt-simple"))


@pytest.fixture(scope="module")
def references(renderer):
    return cache(lambda scene: render_references(renderer, load(renderer, scene, (32, 32)), spp=128))


def verdicts(stacks, references):
    return {name: result.passed for name, result in gradient_tests(stacks, references)}


@pytest.mark.parametrize("scene", SCENES)
def test_unbiased(stacks, references, scene):
    assert references(scene).mean() > 0.01  # black images agree all too well
    for name, result in gradient_tests(stacks(scene), references(scene)):
        assert result.passed, f"{name}: {result}"


@pytest.mark.slow
@pytest.mark.parametrize("scene", SCENES)
def test_unbiased_with_a_large_budget(renderer, scene):
    scene = load(renderer, scene, (64, 64))
    references = render_references(renderer, scene, batches=32, spp=1024)
    for name, result in gradient_tests(render_ours(scene, "gpt-simple", spp=512), references):
        assert result.passed, f"{name}: {result}"


@pytest.mark.parametrize("max_depth", [0, 1, 2, 3, 4])
def test_unbiased_at_each_of_the_steps_that_are_written_out(renderer, max_depth):
    def scene():
        description = courtyard()
        description["integrator"]["max_depth"] = max_depth
        return description

    scene = load(renderer, scene, (16, 16))
    ours = render_ours(scene, "gpt-simple", spp=32)
    assert np.any(ours[0]["dx"]) == (max_depth > 1) and np.any(ours[0]["primal"]) == (max_depth > 0)
    for name, result in gradient_tests(ours, render_references(renderer, scene, batches=16, spp=128)):
        assert result.passed, f"{name}: {result}"


def test_furnace(renderer):
    """Up to forty vertices in a closed ball, where roulette ends most paths: radiance is 1 everywhere."""
    stacks = render_ours(load(renderer, furnace, (16, 16)), "gpt-simple")
    for name, expected in (("primal", 1.0), ("dx", 0.0), ("dy", 0.0)):
        ours = np.stack([stack[name] for stack in stacks])
        result = z_test(ours, np.full_like(ours, expected))
        assert result.passed, f"{name}: {result}"


def test_agrees_with_the_full_integrator(renderer, stacks):
    from data_gen.render import render_stack

    scene = load(renderer, courtyard, (32, 32))
    ours, theirs = stacks(courtyard), [render_stack(scene, 64, 100 + seed, "gpt").layers for seed in range(16)]
    for name in ("primal", "direct", "dx", "dy", "albedo", "normal"):
        result = z_test(*(np.stack([stack[name] for stack in both]) for both in (ours, theirs)))
        assert result.passed, f"{name}: {result}"
    # The same shift with the same weights: no noisier, and no less noisy.
    for name in ("primal_var", "dx_var", "dy_var"):
        one, other = (np.mean([stack[name] for stack in both]) for both in (ours, theirs))
        assert one == pytest.approx(other, rel=0.1), name


@pytest.mark.parametrize(
    ("function", "mutant"),
    [
        ("reconnection_jacobian", lambda mi, dr, *geometry: mi.Float(1)),
        ("gradient_weight", lambda mi, dr, r, good: mi.Float(1)),
        ("seen_from", lambda mi, dr, si, direction: si),
    ],
    ids=["no Jacobian", "w is 1/2", "the joined vertex is seen from the base path's"],
)
def test_mutants_fail_the_z_test(renderer, references, function, mutant, monkeypatch):
    import drjit as dr

    from data_gen.samplers import gpt_simple

    monkeypatch.setattr(gpt_simple, function, partial(mutant, renderer, dr))
    scene = "diffuse" if function != "seen_from" else courtyard
    passed = verdicts(render_ours(load(renderer, scene, (32, 32)), "gpt-simple"), references(scene))
    print(passed)
    assert passed["primal"] and not (passed["dx"] and passed["dy"])


class Pairs:
    """The first two steps of base paths, shifted to a neighbouring pixel; and the same offset paths shifted back."""

    def __init__(self, mi, scene):
        import drjit as dr

        from data_gen.paths.camera import CameraSamples
        from data_gen.samplers.gpt_simple import base_step, start, step_apart, step_joined

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
        self.back, self.again = step_joined(again, joined_back), again.goes_on
        self.tried, self.r, self.r_back = first.goes_on & (apart.r > 0), joined.r, joined_back.r
        dr.eval(self.there, self.back, self.tried, self.r, self.r_back)

    def step(self, x, β, other, wo, x1):
        """A step as if base path sampling had gone along ``wo`` to ``x1``; the emitter's numbers are of ``other``."""
        import drjit as dr

        from data_gen.paths.lights import emission, sample_light
        from data_gen.paths.shift import mis_weight
        from data_gen.paths.vertex import evaluate
        from data_gen.samplers.gpt_simple import Step, reflected

        light = sample_light(self.scene, x, other.u_light, x.is_valid())
        f, p = evaluate(x.bsdf(), x, wo)
        goes_on = other.goes_on & (p > 0)
        Le, p_light = emission(self.scene, x1, x, goes_on, goes_on)
        return Step(
            x, β, other.u_light, light, reflected(light, x), wo, p, goes_on, dr.select(goes_on, β * f / p, 0), x1, Le, p_light,
            Le * mis_weight(p, p_light),
        )  # fmt: skip


def test_a_pair_says_the_same_from_either_side(renderer):
    """Sampled from the other side, the same two paths have 1 / r, weights that add up to 1, and -Δ and -a."""
    import drjit as dr

    pairs = Pairs(renderer, load(renderer, courtyard, (32, 32)))
    good = np.array(pairs.tried & (pairs.r > 0))
    print(good.mean(), np.array(pairs.tried).mean())
    r, r_back = np.array(pairs.r)[good], np.array(pairs.r_back)[good]
    print("r", np.quantile(np.abs(r*r_back-1), [.5,.99,.999,.9999,1]))
    for one, other in zip(pairs.there, pairs.back):
        one, other = np.array(one)[:, good], np.array(other)[:, good]
        print(np.quantile(np.abs(one + other)/(1e-3+np.abs(one)), [.5,.9,.99,.999,.9999,1]))


def test_most_shifts_succeed(renderer):
    for scene in SCENES:
        pairs = Pairs(renderer, load(renderer, scene, (32, 32)))
        print(scene, (np.array(pairs.r)>0).sum() / np.array(pairs.tried).sum())


def test_gradients_have_less_variance_than_differences_of_pixels(stacks):
    for scene in SCENES:
        direct = np.mean([s["direct"] for s in stacks(scene)], axis=0).sum(axis=-1)
        dark = direct == 0
        primal, dx, dy = (np.mean([s[f"{n}_var"] for s in stacks(scene)], axis=0) for n in ("primal","dx","dy"))
        pair = dark[:, 1:] & dark[:, :-1]
        print(scene, ((primal[:, 1:] + primal[:, :-1])[pair]).mean() / dx[:, :-1][pair].mean())
        pair = dark[1:] & dark[:-1]
        print(scene, ((primal[1:] + primal[:-1])[pair]).mean() / dy[:-1][pair].mean())


@pytest.mark.parametrize("scene", ["glossy", "environment", fog, hidden_lamp, lambda: polished(0.01), lambda: polished(0.3)])
def test_refuses(renderer, scene):
    from data_gen.render import render_stack
    try:
        render_stack(load(renderer, scene, (8, 8)), 1, sampler="gpt-simple")
    except NgptError as e:
        print(e)
