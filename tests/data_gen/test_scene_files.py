"""z-tests on whatever Mitsuba scenes are at hand: NGPT_SCENES=folder with */*.xml in it. Skipped without.

The budget is fixed: 20 stacks of 32 spp against 24 references of 192 spp at 32x24 pixels, with the sampler that `auto`
takes for the scene; over one pixel, and over eight. Weak where a scene's light is carried by a few bright paths. All
tests of all scenes together find something by chance in one run of a hundred. On two cores a scene takes 10 to 20
seconds.
"""

import os
from pathlib import Path

import pytest
from unbiased import DISTANCES, gradient_tests, render_ours, render_references

FOLDER = os.environ.get("NGPT_SCENES")
FILES = sorted(Path(FOLDER).glob("*/*.xml")) if FOLDER else []
LEVEL = 1 - 0.99 ** (1 / (3 * len(DISTANCES) * max(1, len(FILES))))


@pytest.mark.slow
@pytest.mark.skipif(not FILES, reason="NGPT_SCENES names no folder of scenes")
@pytest.mark.parametrize("path", FILES, ids=lambda path: f"{path.parent.name}-{path.stem}")
def test_unbiased(renderer, path):
    from data_gen.scenes.load import load_scene

    scene = load_scene(str(path), (32, 24))
    references = render_references(renderer, scene, spp=192)
    assert references.mean() > 0
    for pixels in DISTANCES:
        stacks = render_ours(scene, "auto", batches=20, spp=32, pixels=pixels)
        for name, result in gradient_tests(stacks, references, LEVEL, pixels):
            assert result.passed, f"{name} over {pixels} pixels: {result}"
