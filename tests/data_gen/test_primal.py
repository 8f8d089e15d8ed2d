"""The sampler without gradients: Mitsuba's own integrator, but where that one loses light."""

import numpy as np
import pytest
from data_gen_scenes import lamp_alone, leaf
from references import references
from unbiased import load, render_ours, right_integrator

from data_gen.scenes.load import reference_integrator
from ngpt.testing import z_test


def test_light_on_what_has_holes_is_not_lost(renderer):
    """Mitsuba's ``path`` gives it up when the path goes on through a hole and meets nothing; ``prb`` does not."""
    scene, right = load(renderer, leaf, (16, 16)), references(renderer, leaf, (32, 32))
    assert right_integrator(renderer, scene).class_name() != "PathIntegrator"
    # The day this fails, ``data_gen.samplers.common.radiance`` may go, and ``right_integrator`` with it.
    wrong = np.array(renderer.render(scene, integrator=renderer.load_dict({"type": "path", "max_depth": 4}), spp=256))
    assert wrong.mean() < 0.5 * right.mean()


@pytest.mark.parametrize("more", [{"sky": {"type": "constant", "radiance": 0.1}}, {"leaf": {"type": "sphere"}}])
def test_elsewhere_it_is_the_integrator_itself(renderer, more):
    """With an environment, and without holes."""
    from data_gen.samplers.common import loses_light

    scene = load(renderer, lambda: leaf() | more, (16, 16))
    assert right_integrator(renderer, scene).class_name() == "PathIntegrator"
    assert not loses_light(scene, reference_integrator(scene))


@pytest.mark.parametrize("sampler", ["primal", "gpt", pytest.param("bdpt", marks=pytest.mark.slow)])
def test_lamps_seen_directly_are_seen_by_four_rays_a_sample(renderer, sampler):
    """A lamp of radiance 2 over parts of pixels: one ray a sample would have variance m (2 - m) / spp."""
    spp = 16
    # Points of nets would take noise away whatever the number of rays.
    stacks = render_ours(load(renderer, lamp_alone, (16, 16)), sampler, batches=24, spp=spp, points="independent")
    direct = np.stack([stack["direct"][..., 0] for stack in stacks]).astype(np.float64)
    np.testing.assert_allclose([stack["primal"] for stack in stacks], [stack["direct"] for stack in stacks], atol=1e-6)
    m = direct.mean(axis=0)
    edges = (m > 0.2) & (m < 1.8)
    expected = m * (2 - m) / spp
    assert edges.sum() > 10
    # In quarters of a pixel on one edge: a fifth; independent rays would have a quarter.
    assert direct.var(axis=0, ddof=1)[edges].mean() < 0.25 * expected[edges].mean()
    # The mean is that of one ray a sample, whose noise is known.
    assert z_test(np.stack([stack["direct"] for stack in stacks]), references(renderer, lamp_alone, (16, 16))).passed
