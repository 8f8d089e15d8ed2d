"""The sampler without gradients: Mitsuba's own integrator, but where that one loses light."""

import numpy as np
import pytest
from data_gen_scenes import leaf
from unbiased import load, render_ours, render_references, right_integrator

from ngpt.testing import z_test


def test_light_on_what_has_holes_is_not_lost(renderer):
    """Mitsuba's ``path`` gives it up when the path goes on through a hole and meets nothing; ``prb`` does not."""
    scene = load(renderer, leaf, (16, 16))
    right = render_references(renderer, scene)
    assert right_integrator(renderer, scene).class_name() != "PathIntegrator"
    for sampler in ("primal", "gpt", "gpt-basic"):
        ours = np.stack([stack["primal"] for stack in render_ours(scene, sampler)])
        assert z_test(ours, right).passed, sampler
    # The day this fails, ``data_gen.samplers.common.radiance`` may go, and ``right_integrator`` with it.
    wrong = np.array(renderer.render(scene, integrator=renderer.load_dict({"type": "path", "max_depth": 4}), spp=256))
    assert wrong.mean() < 0.5 * right.mean()


@pytest.mark.parametrize("more", [{"sky": {"type": "constant", "radiance": 0.1}}, {"leaf": {"type": "sphere"}}])
def test_elsewhere_it_is_the_integrator_itself(renderer, more):
    """With an environment, and without holes: the very same numbers as ``path`` gives."""
    from data_gen.samplers.common import radiance
    from data_gen.scenes.load import reference_integrator

    scene = load(renderer, lambda: leaf() | more, (16, 16))
    integrator = reference_integrator(scene)
    assert right_integrator(renderer, scene).class_name() == "PathIntegrator"

    class Called(Exception):
        pass

    class Own:
        hide_emitters = False

        def __str__(self):
            return str(integrator)

        def class_name(self):
            return "PathIntegrator"

        def sample(self, *_):
            raise Called

    with pytest.raises(Called):
        radiance(scene, Own())(None, None, None, True)
