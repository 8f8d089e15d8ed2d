"""Shared tails beside whole paths: images of both, and the bias of one against the other.

Images by whole paths are rendered once, and kept as means over blocks.
"""

import mitsuba as mi
import numpy as np
from references import REFERENCES
from rendered_once import rendered_once
from unbiased import load, stacks_of

SIZE = (32, 24)
BLOCK = 4


def images(scene, tails, spp, seeds):
    """Independent images, (seeds, H, W, 3) float64."""
    stacks = stacks_of(scene, "primal", len(seeds), spp, seeds[0], tails=tails, with_features=False)
    assert all(("tails=shared" in s.attributes["ngpt:samplerOptions"]) == (tails == "shared") for s in stacks)
    return np.stack([s["primal"] for s in stacks]).astype(np.float64)


def blocks(image):
    """Means over blocks, (..., H / 4, W / 4, 3), of images (..., H, W, 3)."""
    *more, height, width, _ = image.shape
    return image.reshape(*more, height // BLOCK, BLOCK, width // BLOCK, BLOCK, 3).mean(axis=(-4, -2))


def whole_paths(description, size=SIZE, spp=1536):
    """Blocks of four independent images by whole paths, (4, H / 4, W / 4, 3)."""

    def render():
        return blocks(images(load(mi, description, size), "paths", spp, range(REFERENCES, REFERENCES + 4)))

    return rendered_once(description, size, "whole paths", render)


class Bias:
    """The errors of blocks of ``shared`` images relative to the light of whole paths, both (images, H, W, 3).

    A product of differences of independent images has no noise of its own in its mean. So the mean ``square`` of the
    bias is found even where the bias is far below the noise.

    ``each``   (H, W, 3), with its standard error ``noise``
    ``total``  the error of the image's mean, RGB, relative to the mean light, with its standard error ``doubt``

    Errors are relative to the light of a block plus ``dark`` times the mean light.
    """

    def __init__(self, shared, whole, dark=0.02):
        light = whole.mean(axis=0)
        unit = light + dark * light.mean()
        both = shared, whole
        self.each = (shared.mean(axis=0) - light) / unit
        self.noise = np.sqrt(sum(x.var(axis=0, ddof=1) / len(x) for x in both)) / unit
        self.total = (shared.mean(axis=(0, 1, 2)) - light.mean(axis=(0, 1))) / light.mean()
        means = [x.mean(axis=(1, 2)) for x in both]
        self.doubt = np.sqrt(sum(x.var(axis=0, ddof=1) / len(x) for x in means)) / light.mean()
        halves = [(shared[i::2].mean(axis=0) - whole[i::2].mean(axis=0)) / unit for i in range(2)]
        squares = halves[0] * halves[1]
        self.square, self.doubt_of_square = squares.mean(), squares.std() / np.sqrt(squares.size)
