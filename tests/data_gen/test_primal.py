"""The sampler without gradients: Mitsuba's own integrator, but where that one loses light."""

import numpy as np
import pytest
from unbiased import render_ours, render_references

from ngpt.testing import z_test

LEAF = {
    "type": "rectangle",
    "bsdf": {
        "type": "mask",
        "opacity": 0.3,
        "nested": {"type": "twosided", "nested": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.8}}},
    },
}


def leaf(mi, integrator, **more):
    """A thin leaf in front of nothing, lit by a lamp that the camera does not see."""
    turn = mi.ScalarTransform4f
    camera = {"type": "perspective", "fov": 40, "to_world": turn().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0])}
    lamp = {"type": "rectangle", "to_world": turn().look_at([0, 3, 3], [0, 0, 0], [1, 0, 0])}
    scene = {
        "type": "scene",
        "integrator": {"type": integrator, "max_depth": 4},
        "sensor": camera | {"film": {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}}},
        "lamp": lamp | {"emitter": {"type": "area", "radiance": 10.0}},
        "leaf": LEAF | {"to_world": turn().scale(2)},
    }
    return mi.load_dict(scene | more)


def test_light_on_what_has_holes_is_not_lost(renderer):
    """Mitsuba's ``path`` gives it up when the path goes on through a hole and meets nothing; ``prb`` does not."""
    scene = leaf(renderer, "path")
    right = render_references(renderer, leaf(renderer, "prb"))
    for sampler in ("primal", "gpt"):
        ours = np.stack([stack["primal"] for stack in render_ours(scene, sampler)])
        assert z_test(ours, right).passed, sampler
    # The day this fails, ``data_gen.samplers.primal.radiance`` may go.
    assert render_references(renderer, scene, batches=4).mean() < 0.5 * right.mean()


@pytest.mark.parametrize("more", [{"sky": {"type": "constant", "radiance": 0.1}}, {"leaf": {"type": "sphere"}}])
def test_elsewhere_it_is_the_integrator_itself(renderer, more):
    """With an environment, and without holes: the very same numbers as ``path`` gives."""
    from data_gen.samplers.primal import radiance
    from data_gen.scenes.load import reference_integrator

    scene = leaf(renderer, "path", **more)
    integrator = reference_integrator(scene)

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
        radiance(scene, Own())(None, None, None)
