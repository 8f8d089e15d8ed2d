"""bdpt against Mitsuba's ``path`` on whatever scenes are at hand: NGPT_SCENES=folder with */*.xml in it.

Weak where few bright paths carry the light: there ``path`` is the noisier of the two.
"""

import os
from pathlib import Path

import numpy as np
import pytest
from unbiased import render_ours, render_references

from ngpt.testing import z_test

FOLDER = os.environ.get("NGPT_SCENES")
FILES = sorted(Path(FOLDER).glob("*/*.xml")) if FOLDER else []


@pytest.mark.slow
@pytest.mark.skipif(not FILES, reason="NGPT_SCENES names no folder of scenes")
@pytest.mark.parametrize("path", FILES, ids=lambda path: f"{path.parent.name}-{path.stem}")
def test_bdpt_is_unbiased(renderer, path):
    from data_gen.samplers import SAMPLERS
    from data_gen.scenes.facts import scene_facts
    from data_gen.scenes.load import load_scene

    scene = load_scene(str(path), (32, 24))
    if reason := SAMPLERS["bdpt"].refuses(scene_facts(scene)):
        pytest.skip(reason)
    ours = np.stack([stack["primal"] for stack in render_ours(scene, "bdpt", batches=16, spp=16)])
    references = render_references(renderer, scene, spp=192)
    result = z_test(ours, references, level=1 - 0.99 ** (1 / len(FILES)))
    assert result.passed, str(result)
