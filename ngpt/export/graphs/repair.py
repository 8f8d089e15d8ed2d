"""``ngpt.repair`` as a graph: subtracts direct emission, replaces non-finite pixels, marks untrusted differences."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ngpt.export.builder import END, FLOAT, Value, choose, op
from ngpt.repair import BLOCK

_IMAGE = ("tiles", 3, "height", "width")
_UNKNOWN = np.float32(np.nan)
# Blocks of 8^5 = 32768 pixels cover any image that a file may hold.
_LEVELS = 5


@dataclass(frozen=True)
class RepairedInputs:
    """The inputs of the rest of a graph; (N, C, H, W).

    ``layers``   all layers by name, without direct emission, finite, 0 where they cannot be trusted. Variances are NaN
                 where unknown. "primal" excludes "caustic" if the network reads gradients
    ``direct``   the direct emission, finite, which is added to the result again
    ``trusted``  for dx and dy, if there are any: (N, 1, H, W), true where they can be trusted
    """

    layers: dict[str, Value]
    direct: Value
    trusted: dict[str, Value]


def finite(x: Value) -> Value:
    """Where values are finite. For other values, x - x is not 0."""
    return op.Equal(x - x, 0.0)


def clean(x: Value) -> Value:
    """The values, with 0 where they are not finite."""
    return op.Where(finite(x), x, 0.0)


def repaired(raw: Mapping[str, Value], gradients: bool) -> RepairedInputs:
    """The ``raw`` layers of a renderer, with ``primal`` and ``direct``, repaired as ``ngpt.repair`` does.

    ``gradients``  whether the network reads gradients. If so, its light excludes ``caustic``
    """
    light = raw["primal"] - raw["direct"]
    rest = light - raw["caustic"] if "caustic" in raw else light
    good = _everywhere(finite(rest), 1)
    whole = op.Greater(op.ReduceMin(op.Cast(good, to=FLOAT), keepdims=0), 0.5)

    def filled(image: Value) -> Value:
        return choose(whole, lambda: op.Identity(image), lambda: _filled(image, good), _IMAGE)

    direct = op.Where(good, raw["direct"], 0.0)
    layers = {name: clean(layer) for name, layer in raw.items() if name != "direct" and not name.endswith("_var")}
    layers["primal"] = filled(rest if gradients else light)
    if gradients and "caustic" in raw:
        layers["caustic"] = filled(raw["caustic"])
    # Where the camera sees an emitter, the primal's variance includes the direct emission.
    known = {"primal_var": op.And(good, _everywhere(op.Equal(direct, 0.0), 1))}
    trusted = {}
    for name, axis in (("dx", 3), ("dy", 2)):
        if name in raw:
            following = op.Pad(op.Slice(op.Cast(good, to=FLOAT), [1], [END], [axis]), [0, 1], 1.0, [axis])
            both = op.And(good, op.Greater(following, 0.5))
            trusted[name] = known[f"{name}_var"] = op.And(both, _everywhere(finite(raw[name]), 1))
            layers[name] = op.Where(trusted[name], layers[name], 0.0)
    if "caustic_var" in raw:
        known["caustic_var"] = good
    for name, flags in known.items():
        if name in raw:
            variance = _of_all_light(raw) if name == "primal_var" and not gradients else raw[name]
            layers[name] = op.Where(flags, variance, _UNKNOWN)
    return RepairedInputs(layers, direct, trusted)


def _of_all_light(raw: Mapping[str, Value]) -> Value:
    """The variance of primal plus ``caustic``, NaN where unknown."""
    if "caustic" not in raw:
        return raw["primal_var"]
    variance, further = raw["primal_var"], raw["caustic_var"]
    dark = _everywhere(op.Equal(raw["caustic"], 0.0), 1)
    known = op.And(finite(further), op.GreaterOrEqual(op.Min(variance, further), 0.0))
    return op.Where(known, variance + further, op.Where(dark, variance, _UNKNOWN))


def _everywhere(flags: Value, axis: int) -> Value:
    """Where ``flags`` are true all along an axis."""
    return op.Greater(op.ReduceMin(op.Cast(flags, to=FLOAT), [axis], keepdims=1), 0.5)


def _filled(light: Value, good: Value) -> Value:
    """The image, with the replacements of ``ngpt.repair`` for pixels that are not ``good``."""
    sums = op.Concat(op.Where(good, light, 0.0), op.Cast(good, to=FLOAT), axis=1)
    near = op.AveragePool(sums, kernel_shape=[3, 3], pads=[1, 1, 1, 1], count_include_pad=1)
    levels = [sums, near]
    pooled = sums
    for _ in range(_LEVELS):
        missing = op.Mod(-op.Shape(pooled, start=2, end=4), [BLOCK, BLOCK])
        pooled = op.Pad(pooled, op.Concat([0, 0], missing, axis=0), 0.0, [2, 3])
        pooled = op.AveragePool(pooled, kernel_shape=[BLOCK, BLOCK], strides=[BLOCK, BLOCK])
        levels.append(pooled)
    result = _mean(levels[-1], 0.0)
    for finer in reversed(levels[2:-1]):
        result = _mean(finer, _spread(result, finer))
    return _mean(sums, _mean(near, _spread(result, sums)))


def _mean(sums: Value, otherwise: Value | float) -> Value:
    """Means of RGB from sums of RGB and a count, (N, 4, H, W); ``otherwise`` where the count is 0."""
    total, count = op.Slice(sums, [0], [3], [1]), op.Slice(sums, [3], [4], [1])
    there = op.Greater(count, 0.0)
    return op.Where(there, total / op.Where(there, count, 1.0), otherwise)


def _spread(blocks: Value, like: Value) -> Value:
    """The value of each block, at all of its pixels."""
    rows, columns = (op.Range(0, op.Squeeze(op.Shape(like, start=a, end=a + 1)), 1) / BLOCK for a in (2, 3))
    return op.Gather(op.Gather(blocks, rows, axis=2), columns, axis=3)
