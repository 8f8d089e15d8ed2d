"""Samplers on eight scenes of odd things: their means are Mitsuba's, and gradients are worth something there.

All samplers that are neither studies nor biased. Each p-value is held against a level for all tests together.
"""

import numpy as np
import pytest
from references import references
from stress_scenes import SCENES
from unbiased import DISTANCES, assert_unbiased, failed_shifts, light_of_gradients, load, render_ours

from data_gen.samplers import SAMPLERS
from ngpt.errors import NgptError

SIZE, SEEDS = (24, 16), 8
NAMES = [name for name, entry in SAMPLERS.items() if entry.standing != "study" and not entry.biased]
# Of all tests together, each of which corrects for its blocks: the primal, and two layers over two distances
TESTS = sum(1 + 2 * len(DISTANCES) * SAMPLERS[name].gradients for name in NAMES) * len(SCENES)
LEVEL = 1 - (1 - 0.01) ** (1 / TESTS)


def gain(stacks):
    """The variance over seeds of differences of independent pixels, over that of dx and dy."""
    light = np.var([light_of_gradients(stack) for stack in stacks], axis=0, ddof=1)
    pixels = (light[:, 1:] + light[:, :-1]).sum() + (light[1:] + light[:-1]).sum()
    return pixels / sum(np.var([stack[layer] for stack in stacks], axis=0, ddof=1).sum() for layer in ("dx", "dy"))


@pytest.mark.slow
@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("name", NAMES)
def test_stress_scenes(renderer, name, scene):
    entry, loaded = SAMPLERS[name], load(renderer, scene, SIZE)
    # Few samples where a pass has few: those take long to start.
    spp = 16 if entry.batch else 128
    for pixels in DISTANCES[: 1 + entry.gradients]:
        try:
            stacks = render_ours(loaded, name, SEEDS, spp, pixels)
        except NgptError as refusal:
            assert f"sampler '{name}' cannot render this scene" in str(refusal)
            return
        assert_unbiased(stacks, references(renderer, scene, SIZE), LEVEL, pixels)
        if pixels == 1 and entry.gradients:
            # Pixels are wide here, and a few of them have most of the noise.
            assert gain(stacks) > 1.2 and failed_shifts(loaded, name) < 0.4
