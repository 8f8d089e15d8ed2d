"""Samplers on eight scenes of odd things: their means, and what their gradients are worth there.

All that are neither studies nor biased. The means of the primal and of differences over 1 and over 8 pixels are those
of Mitsuba's own integrator. Each p-value is held against a level for all scenes, samplers, layers and blocks together.
What a sampler leaves to others it refuses by name.
"""

import time
from collections import Counter

import numpy as np
import pytest
from references import references
from reliability import record
from stress_scenes import SCENES
from unbiased import DISTANCES, failed_shifts, gradient_tests, light_of_gradients, load, render_ours

from data_gen.samplers import SAMPLERS
from ngpt.errors import NgptError

SIZE, SEEDS = (24, 16), 8
NAMES = [name for name, entry in SAMPLERS.items() if entry.standing != "study" and not entry.biased]
# Of all tests together, each of which corrects for its blocks: the primal, and two layers over two distances
TESTS = sum(1 + 2 * len(DISTANCES) * SAMPLERS[name].gradients for name in NAMES) * len(SCENES)
LEVEL = 1 - (1 - 0.01) ** (1 / TESTS)
# The variance of differences of independent pixels over that of dx and dy, the sum over the image. Pixels are wide
# here, and a few of them have most of the noise.
FLOOR = 1.2
# The share of shifts that may fail, of samplers that count them
FAILURES = 0.4


def judged(mi, scene, name):
    """What is wrong in that scene; the largest z and where; and the worth of the gradients, or None."""
    theirs, failures, largest, worth = references(mi, scene, SIZE), [], (0.0, ""), None
    gradients, loaded = SAMPLERS[name].gradients, load(mi, scene, SIZE)
    # Few samples where a pass has few: those take long to start.
    spp = 16 if SAMPLERS[name].batch else 128
    for pixels in DISTANCES[: 1 + gradients]:
        stacks = render_ours(loaded, name, SEEDS, spp, pixels)
        for layer, result in gradient_tests(stacks, theirs, level=LEVEL, pixels=pixels):
            if pixels == 1 or layer != "primal":
                where = layer if layer == "primal" else f"{layer} over {pixels}"
                largest = max(largest, (float(np.abs(result.z).max()), where))
                failures += [] if result.passed else [f"{where}: {result}"]
        if pixels == 1 and gradients:
            worth, failed = gain(stacks), failed_shifts(loaded, name)
            failures += [f"gradients gain {worth:.2f}"] if worth < FLOOR else []
            failures += [f"{failed:.0%} of the shifts fail"] if failed > FAILURES else []
    return "; ".join(failures), largest, worth


def gain(stacks):
    """The variance over seeds of differences of independent pixels, over that of dx and dy."""
    light = np.var([light_of_gradients(stack) for stack in stacks], axis=0, ddof=1)
    pixels = (light[:, 1:] + light[:, :-1]).sum() + (light[1:] + light[:-1]).sum()
    return pixels / sum(np.var([stack[layer] for stack in stacks], axis=0, ddof=1).sum() for layer in ("dx", "dy"))


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("name", NAMES)
def test_stress_scenes(renderer, name):
    clock, found, wrong, outcomes = time.monotonic(), {}, [], Counter()
    for scene in SCENES:
        try:
            failure, (z, where), worth = judged(renderer, scene, name)
        except NgptError as refusal:
            assert name in str(refusal), refusal
            outcomes["refused by name"] += 1
            continue
        if failure:
            wrong.append(f"{scene.__name__}: {failure}")
        outcomes["the means of Mitsuba"] += 1
        found[scene.__name__] = f"{z:.1f} {where}" + ("" if worth is None else f", gain {worth:.2g}")
        print(name, scene.__name__, found[scene.__name__], failure, flush=True)
    assert not wrong, "\n".join(wrong)
    seconds = round(time.monotonic() - clock)
    record(f"Stress scenes by {name}: largest z", len(SCENES), outcomes, worst=found, seconds=seconds)
