"""A look at a scene says whether features pay: not where a lens blurs what they would show."""

from dataclasses import replace

import numpy as np
import pytest
from unbiased import load

pytest.importorskip("mitsuba")

import data_gen
import data_gen.choosing.plans
from data_gen.begun import rest_of
from data_gen.choosing.look import features_pay, noise_of_features
from data_gen.request import RenderRequest
from data_gen.scenes.builtin import SCENES
from ngpt.io.exr import write


def through(mi, aperture, flat=False):
    scene = SCENES["lens"]()
    scene["sensor"]["aperture_radius"] = aperture
    return load(mi, scene, (48, 32))


def test_the_wider_the_lens_the_less_features_pay(renderer):
    noise = [noise_of_features(through(renderer, aperture)) for aperture in (1e-4, 0.02, 0.07, 0.3)]
    assert noise == sorted(noise) and noise[0] < 1e-3 and noise[-1] > 0.05
    assert features_pay(through(renderer, 1e-4)) and not features_pay(through(renderer, 0.3))
    assert features_pay(load(renderer, "diffuse", (48, 32)))


@pytest.mark.skipif(bool(data_gen.choosing.plans.METHODS["oidn"].missing()), reason="OIDN")
def test_images_of_a_wide_lens_are_made_without_features(renderer, tmp_path):
    """Stacks keep them, for whatever is made of them; and what was begun goes on as it was."""
    scene = through(renderer, 0.3)
    image, plan = data_gen.render_scene(scene, 2, needs_features=False)
    assert "albedo" not in image and plan.options == {"features": False} and "the lens blurs" in plan.reason
    stack, plan = data_gen.render_scene(scene, 2)
    assert "albedo" in stack and not plan.options and plan.method == "oidn"
    assert "albedo" in data_gen.render_scene(through(renderer, 1e-4), 2, needs_features=False).stack
    assert "albedo" in data_gen.render_scene(scene, 2, needs_features=False, gradients=True).stack
    # Only a scene with a name is known again.
    image.attributes |= RenderRequest("lens", 2).header()
    write(tmp_path / "begun.exr", image)
    left = rest_of(RenderRequest("lens", 4), tmp_path / "begun.exr", image.attributes)
    assert left.sampler == "primal" and left.options["features"] is False
    rest = data_gen.render_scene(replace(left, scene=scene)).stack
    assert rest.names == image.names and not np.array_equal(rest["primal"], image["primal"])
