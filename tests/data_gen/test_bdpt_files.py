"""bdpt against Mitsuba's ``path``, and gbdpt's gradients against differences of bdpt, on whatever scenes are at hand:
NGPT_SCENES=folder with */*.xml in it.

Weak where few bright paths carry the light: there ``path`` is the noisier of the two.
"""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from unbiased import FAR, REFERENCES, gradient_tests, render_ours, render_references

from ngpt.testing import z_test

FOLDER = os.environ.get("NGPT_SCENES")
FILES = sorted(Path(FOLDER).glob("*/*.xml")) if FOLDER else []


every_file = pytest.mark.parametrize("path", FILES, ids=lambda path: f"{path.parent.name}-{path.stem}")
LEVEL = 1 - 0.99 ** (1 / max(len(FILES), 1))


def scene_for(sampler, path):
    from data_gen.samplers import SAMPLERS
    from data_gen.scenes.facts import scene_facts
    from data_gen.scenes.load import load_scene

    scene = load_scene(str(path), (32, 24))
    if reason := SAMPLERS[sampler].refuses(scene_facts(scene)):
        pytest.skip(reason)
    return scene


@pytest.mark.slow
@pytest.mark.skipif(not FILES, reason="NGPT_SCENES names no folder of scenes")
@every_file
def test_bdpt_is_unbiased(renderer, path):
    scene = scene_for("bdpt", path)
    ours = np.stack([stack["primal"] for stack in render_ours(scene, "bdpt", batches=16, spp=16)])
    references = render_references(renderer, scene, spp=192)
    result = z_test(ours, references, level=LEVEL)
    assert result.passed, str(result)


@pytest.mark.slow
@pytest.mark.skipif(not FILES, reason="NGPT_SCENES names no folder of scenes")
@every_file
def test_gradients_of_gbdpt_are_unbiased(renderer, monkeypatch, path):
    from data_gen.samplers import SAMPLERS

    # One pass for a stack: with many materials most of the time goes by with recording kernels.
    for name in ("bdpt", "gbdpt"):
        monkeypatch.setitem(SAMPLERS, name, replace(SAMPLERS[name], batch=32))
    scene = scene_for("gbdpt", path)
    references = np.stack([s["primal"] for s in render_ours(scene, "bdpt", batches=16, spp=32, seed=REFERENCES)])
    stacks = render_ours(scene, "gbdpt", batches=16, spp=16, pixels=FAR)
    for name, result in gradient_tests(stacks, references, level=LEVEL / 3, pixels=FAR):
        assert result.passed, f"{name}: {result}"
