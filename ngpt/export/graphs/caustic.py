"""``ngpt.denoisers.caustic`` and ``diffusion`` as a graph: denoises the light that gradients exclude.

There are several distances, one after the other. At each distance, every pixel exchanges light with its four neighbours
in one half plane. Each exchange is added to one pixel and subtracted from the other, so no light is lost. Surfaces
beyond the border count as so far away that no light is exchanged with them.
"""

from collections.abc import Mapping

import numpy as np

from ngpt.denoisers.caustic import FARTHEST, LOUDEST
from ngpt.denoisers.diffusion import DISTANCES, NEIGHBOURS, SIGNIFICANT, SMALLEST
from ngpt.export.builder import Value, channels, choose, op, repeat
from ngpt.export.graphs.repair import finite

IMAGE = ("tiles", 3, "height", "width")
# The largest distance that light travels, in pixels.
REACH = sum(DISTANCES)
_FAR = 3e38


def spread(layers: Mapping[str, Value], depth: Value) -> Value:
    """The layer ``caustic`` of repaired ``layers``, spread over its neighbourhood; ``depth`` is the image's largest."""
    light = layers["caustic"]
    scale = op.ReduceMax(abs(light), keepdims=0)
    return choose(op.Greater(scale, 0.0), lambda: _spread(layers, depth, scale), lambda: op.Identity(light), IMAGE)


def _spread(layers: Mapping[str, Value], depth: Value, scale: Value) -> Value:
    light, variance = layers["caustic"] / scale, layers["caustic_var"] / scale / scale
    own = light * light
    known = op.And(finite(variance), op.GreaterOrEqual(variance, 0.0))
    # Where the variance is unknown, all light counts as noise.
    noise = op.ReduceMean(op.Where(known, op.Min(variance, LOUDEST), own), [1], keepdims=1)
    floor = op.ReduceMean(own, keepdims=0) * 1e-12 + 1e-37
    surfaces = _surfaces(layers, depth)
    size = op.Shape(light, start=2, end=4)

    def step(number: Value, state: Value) -> tuple[Value, bool]:
        distance = op.Gather(np.array(DISTANCES, np.int64), number, axis=0)
        return _exchanged(state, surfaces, distance, size, floor), True

    state = repeat(len(DISTANCES), step, op.Concat(light, noise, axis=1), ("tiles", 4, "height", "width"))
    return channels(state, 0, 3) * scale


def _exchanged(state: Value, surfaces: Value, distance: Value, size: Value, floor: Value) -> Value:
    """Light and its variance (N, 4, H, W) after exchanges with pixels at one distance."""
    light, noise = channels(state, 0, 3), channels(state, 3, 4)
    around = op.Mul(distance, [0, 1, 1, 1])
    states, far = op.Pad(state, around, 0.0, [2, 3]), op.Pad(surfaces, around, _FAR, [2, 3])
    # Channels: light added (3), sum of the shares given away, variance of the light received.
    sums = op.Concat(light, noise, noise, axis=1) * 0.0
    for down, right, weight in NEIGHBOURS:
        there, surface = (_moved(x, op.Mul(distance, [down, 1 + right]), size) for x in (states, far))
        change = channels(there, 0, 3) - light
        both, steps = channels(there, 3, 4) + noise, surface - surfaces
        beyond = op.Max(op.ReduceMean(change * change, [1], keepdims=1) - both, 0.0)
        apart = beyond / (both * SIGNIFICANT**2 + floor) + op.ReduceSum(steps * steps, [1], keepdims=1)
        share = (op.Exp(-op.Min(apart, SMALLEST)) - float(np.exp(-SMALLEST))) * weight
        share = op.Where(op.Less(apart, SMALLEST), share, 0.0)
        moves, square = share * change, share * share
        given = op.Pad(op.Concat(-moves, share, square * noise, axis=1), op.Mul(distance, [1, 1, 0, 1]), 0.0, [2, 3])
        back = _moved(given, op.Mul(distance, [1 - down, 1 - right]), size)
        sums = sums + op.Concat(moves, share, square * channels(there, 3, 4), axis=1) + back
    kept = op.Sub(1.0, channels(sums, 3, 4))
    return op.Concat(light + channels(sums, 0, 3), kept * kept * noise + channels(sums, 4, 5), axis=1)


def _moved(padded: Value, start: Value, size: Value) -> Value:
    """The part of ``size`` that begins at ``start``; both are (rows, columns)."""
    return op.Slice(padded, start, op.Add(start, size), [2, 3])


def _surfaces(layers: Mapping[str, Value], depth: Value) -> Value:
    """Albedo, normals and the logarithm of the depth, as far as the model reads them; a constant if it reads none."""
    planes = [layers[name] for name in ("albedo", "normal") if name in layers]
    if "depth" in layers:
        planes.append(op.Log(op.Max(layers["depth"], depth * FARTHEST + 1e-37)))
    return op.Concat(*planes, axis=1) if planes else channels(layers["caustic"], 0, 1) * 0.0
