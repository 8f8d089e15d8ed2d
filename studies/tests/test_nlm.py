"""Non-local means: noise goes, edges and textures stay, and what it lacks it says."""

import numpy as np
import pytest
from textured_room import keeps_texture, textured_room

from ngpt.errors import NgptError
from ngpt.methods import reconstruct
from ngpt.stack import GradientStack
from ngpt_studies import nlm

installed = pytest.mark.skipif(bool(nlm.missing()), reason=nlm.missing())


@installed
def test_noise_falls_and_texture_stays(rng):
    keeps_texture("nlm", *textured_room(rng))


@installed
def test_nlm_takes_steps_of_4_standard_deviations_for_noise_and_of_16_for_edges():
    def kept(step):
        image = np.ones((24, 24, 3))
        image[:, 12:] += 0.1 * step
        features = {"albedo": 0 * image, "normal": 0 * image, "depth": image[..., :1]}
        stack = GradientStack.from_arrays(primal=image, primal_var=np.full_like(image, 0.1**2), **features)
        result = reconstruct(stack, "nlm").image
        return np.mean(result[:, 12] - result[:, 11]) / (0.1 * step)

    assert kept(4) < 0.25 and kept(16) > 0.9


def test_an_absent_package_is_named_with_what_installs_it(rng, monkeypatch):
    monkeypatch.setattr(nlm, "find_spec", lambda name: None)
    with pytest.raises(NgptError, match=r"method 'nlm'.*not installed: .*pip install -e \S+\[peers\]"):
        reconstruct(textured_room(rng)[0], "nlm")
