"""Measures the overlap that the tiles of a network need.

``Reconstructor.radius`` is the distance up to which a pixel can influence another pixel. For networks with kernels or
sweeps at several resolutions, this radius can be twice the distance up to which the influence matters: light from the
greatest distance passes through every convolution, every coarse pixel and every sweep, each time with a small weight.
Tiles that overlap by the whole radius need four times the memory. So the distance that matters is measured, on examples
with stronger noise than images have.
"""

import numpy as np
import torch
from torch import Tensor

from ngpt.network import features, padding
from ngpt.network.model import Reconstructor

# Pixels outside of the overlap change an image by less than this share of its value, a tenth of the tolerance for
# tiles.
TOLERANCE = 1e-6
# The number of examples, and the side of the square in the middle of an example that is compared.
EXAMPLES, MIDDLE = 3, 64
# BESIDE pixels are added to the distance that the examples need, because images differ from the examples. Nothing is
# measured for networks with a radius up to NEAR.
BESIDE, NEAR = 24, 48


def reach(model: Reconstructor) -> int:
    """The overlap in pixels, a multiple of the alignment: ``radius`` rounded up, or less if that is enough.

    An overlap is enough for the examples if no pixel of their results differs by more than ``TOLERANCE`` from the
    result with the whole radius. ``BESIDE`` is added to the least overlap that is enough for them.
    """
    step = model.alignment
    whole = -(-model.radius // step)
    if whole * step <= NEAR:
        return whole * step
    least = max(_least(model, whole, seed) for seed in range(EXAMPLES))
    return min(least + -(-BESIDE // step), whole) * step


@torch.inference_mode()
def _least(model: Reconstructor, whole: int, seed: int) -> int:
    """The overlap that one example needs, in units of the alignment."""
    step = model.alignment
    middle = -(-MIDDLE // step) * step
    scaled, _ = features.normalised(_example(model, middle + 2 * whole * step, seed))

    def predicted(around: int) -> Tensor:
        away = (whole - around) * step
        window = slice(away, away + middle + 2 * around * step)
        part = {name: layer[..., window, window] for name, layer in scaled.items()}
        side = window.stop - window.start
        pads = padding.pads(side, side, step)
        prediction = padding.crop(model.predict(padding.pad(features.completed(part, model.config.inputs), pads)), pads)
        return prediction[..., around * step :, around * step :][..., :middle, :middle]

    expected = predicted(whole)
    low, high = 0, whole
    while low < high:
        tried = (low + high) // 2
        if torch.abs(predicted(tried) - expected).max() <= TOLERANCE * (1 + expected.abs().max()):
            high = tried
        else:
            low = tried + 1
    return high


def _example(model: Reconstructor, side: int, seed: int) -> dict[str, Tensor]:
    """Layers (1, C, side, side): rectangles of all brightnesses with noise, 100 times stronger in 1 % of the pixels."""
    rng = np.random.default_rng(seed)
    image = np.ones((3, side, side))
    for _ in range(side):
        (y, x), (height, width) = rng.integers(side, size=2), rng.integers(4, 48, size=2)
        image[:, y : y + height, x : x + width] = np.exp(rng.normal(0, 2)) * rng.uniform(0.2, 1, (3, 1, 1))

    def noise() -> np.ndarray:
        return rng.gamma(0.3, 1 / 0.3, image.shape) * np.where(rng.random((1, side, side)) < 0.01, 100, 1)

    layers: dict[str, np.ndarray] = {}
    for name in model.config.layers:
        if name in ("dx", "dy"):
            axis = 2 if name == "dx" else 1
            end = image.take([-1], axis)
            layers[name] = np.diff(image, axis=axis, append=end) + rng.normal(0, 0.3, image.shape) * image * noise()
        elif name.endswith("_se"):
            layers[name] = image * noise()
        elif name in features.RADIANCE:
            layers[name] = image * noise() if name == "primal" else image * rng.gamma(4, 0.25, image.shape)
        else:
            layers[name] = rng.random((features.CHANNELS[name], side, side))
    return {name: torch.from_numpy(layer[None].astype(np.float32)) for name, layer in layers.items()}
