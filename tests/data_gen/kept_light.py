"""Whether paths that share tails keep the light of a scene, against whole paths."""

import numpy as np
from unbiased import REFERENCES

from data_gen.render import render_stack


def keeps_its_light(scene, deviations=0):
    """In the mean and in blocks of 4x4 pixels, of 256 samples and four seeds; the image has 32x24 pixels.

    The bias of blocks may exceed its bound by ``deviations`` standard errors: none in rooms, but media are noisier.
    """
    found = {}
    for tails, first in (("shared", 0), ("paths", REFERENCES)):
        how = {"tails": tails, "with_features": False}
        stacks = [render_stack(scene, 256, first + seed, "primal", unbiased=True, **how) for seed in range(4)]
        found[tails] = np.array([stack["primal"] for stack in stacks], np.float64)
    assert stacks[0].attributes.get("ngpt:tails") is None
    shared, whole = (image.reshape(4, 6, 4, 8, 4, 3).mean(axis=(2, 4)) for image in found.values())
    doubt = [np.sqrt(each.mean(axis=(1, 2)).var(axis=0, ddof=1) / 4) for each in (shared, whole)]
    error = shared.mean(axis=(0, 1, 2)) - whole.mean(axis=(0, 1, 2))
    assert (np.abs(error) < 4 * np.hypot(*doubt) + 2e-3 * whole.mean()).all()
    # Products of independent differences have the square of the bias as their mean. What they vary by is noise.
    halves = [shared[i::2].mean(axis=0) - whole[i::2].mean(axis=0) for i in range(2)]
    unit = whole.mean(axis=0) + 0.02 * whole.mean()
    squares = halves[0] * halves[1] / unit**2
    assert squares.mean() < 0.01**2 + deviations * squares.std() / np.sqrt(squares.size)
