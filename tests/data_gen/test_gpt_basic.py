"""The gradient-domain path tracer is unbiased: z-tests against converged renders of Mitsuba's own integrators.

The budget is fixed: 16 stacks of 64 spp against 24 references of 256 spp at 32x32 pixels, a level of 1 % for a scene as
a whole. The slow versions take 16 times the samples at 64x64.
"""

import numpy as np
import pytest
from data_gen_scenes import fog, glass, hidden_lamp, within_fog
from unbiased import gradient_tests, load, render_ours, render_references


def render_both(mi, scene, batches=16, spp=64, reference_batches=24, reference_spp=256):
    """Independent stacks of our sampler (dictionaries of layers) and references (batches, H, W, 3) of Mitsuba's."""
    return render_ours(scene, "gpt-basic", batches, spp), render_references(mi, scene, reference_batches, reference_spp)


@pytest.mark.parametrize("scene", [pytest.param(glass, marks=pytest.mark.slow), within_fog])
def test_unbiased(renderer, scene):
    stacks, references = render_both(renderer, load(renderer, scene, (32, 32)))
    assert references.mean() > 0.01  # black images agree all too well
    for name, result in gradient_tests(stacks, references):
        assert result.passed, f"{name}: {result}"


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["diffuse", "glossy", "environment", "lens", glass, fog, within_fog, hidden_lamp])
def test_unbiased_with_a_large_budget(renderer, scene):
    scene = load(renderer, scene, (64, 64))
    stacks, references = render_both(renderer, scene, spp=256, reference_batches=32, reference_spp=1024)
    for name, result in gradient_tests(stacks, references):
        assert result.passed, f"{name}: {result}"


@pytest.mark.slow
def test_the_z_test_would_see_a_wrong_gradient(renderer):
    stacks, references = render_both(renderer, load(renderer, "diffuse", (32, 32)))

    def verdicts(change):
        changed = [stack | {name: change(stack[name]) for name in ("dx", "dy")} for stack in stacks]
        return [result.passed for name, result in gradient_tests(changed, references) if name != "primal"]

    assert verdicts(lambda gradient: gradient) == [True, True]
    assert verdicts(lambda gradient: -gradient) == [False, False]
    assert verdicts(lambda gradient: 0.8 * gradient) == [False, False]
    assert verdicts(lambda gradient: np.roll(gradient, 1, axis=(0, 1))) == [False, False]


def test_gradients_have_less_variance_than_differences_of_pixels(renderer):
    from data_gen.render import render_stack

    stack = render_stack(load(renderer, "diffuse", (96, 96)), 16, sampler="gpt-basic")
    lit = stack["direct"].sum(axis=-1) == 0  # pixels at the lamp have the variance of its edge in the primal
    independent = (stack["primal_var"][:, 1:] + stack["primal_var"][:, :-1])[lit[:, 1:] & lit[:, :-1]]
    correlated = stack["dx_var"][:, :-1][lit[:, 1:] & lit[:, :-1]]
    assert correlated.mean() < 0.3 * independent.mean()


@pytest.mark.slow
def test_variances_predict_the_spread(renderer):
    from data_gen.render import render_stack

    scene = load(renderer, "environment", (24, 24))
    stacks = [render_stack(scene, 64, seed, "gpt-basic") for seed in range(64)]
    for name in ("primal", "dx", "dy"):
        spread = np.stack([stack[name] for stack in stacks]).var(axis=0, ddof=1).sum()
        predicted = np.stack([stack[f"{name}_var"] for stack in stacks]).mean(axis=0).sum()
        assert predicted == pytest.approx(spread, rel=0.25), name


def test_works_as_a_mitsuba_integrator(renderer):
    scene = load(renderer, "diffuse", (20, 10))
    integrator = renderer.load_dict({"type": "gpt_basic", "nested": {"type": "path", "max_depth": 3}})
    image = renderer.render(scene, integrator=integrator, spp=4)
    names = integrator.aov_names()
    assert image.shape == (10, 20, len(names))
    assert names[:3] == ["primal.R", "primal.G", "primal.B"] and {"dx.B", "normal.Z", "depth.Z"} < set(names)
    assert not np.array(image)[:, -1, names.index("dx.R")].any()
