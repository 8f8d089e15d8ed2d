"""The teaching twin of ``gpt`` as a plugin. That it is right in what it renders is a law."""

import numpy as np
import pytest
from data_gen_scenes import courtyard, polished
from unbiased import load

from data_gen.samplers import find


def test_random_replay_of_it_is_random_replay(renderer):
    """As a plugin that samples radiance, in place of Mitsuba's ``path``."""
    scene = load(renderer, courtyard, (12, 12))
    nested = {"type": "gpt_simple", "max_depth": 7, "rr_depth": 5}
    replay = renderer.load_dict({"type": "gpt_basic", "nested": nested})
    ours = np.array(renderer.render(scene, integrator=replay, spp=256))
    assert ours[..., replay.aov_names().index("dx.R")].any()
    assert ours[..., :3].mean() == pytest.approx(np.array(renderer.render(scene, spp=1024)).mean(), rel=0.05)


def test_takes_what_is_rough_enough(renderer):
    assert callable(find("gpt-simple").made(load(renderer, lambda: polished(0.06), (8, 8))))
