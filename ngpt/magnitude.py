"""Scales very bright or dark light so that single precision can hold its squares, and scales results back.

Methods square light and divide by variances in single precision, which ends at 2^±127. So a stack whose typical light
is beyond 2^±``ORDINARY`` is multiplied by a power of two before a method reads it, and the result is divided by it.
Both are exact. All other stacks are not changed.

Light of 1e-30 has variances of 1e-60, which single precision cannot hold. ``GradientStack`` keeps variances in double
precision if they are passed so. In files and in arrays of single precision, they are 0 or infinite. Infinite variances
count as unknown, and so do variances of 0 of light that is so dark that its square may underflow.
"""

import math
from dataclasses import replace

import numpy as np

from ngpt.layers import LAYERS, RGB
from ngpt.stack import GradientStack

# Methods are made for typical light from 2^-ORDINARY to 2^ORDINARY: a millionth to a million.
ORDINARY = 20
# The largest power of two of scaled light, whose square float32 can hold
_LARGEST = 62
# Below 2^-_DIM, variances of light may be 0 by underflow: a millionth of its square is below 2^-148.
_DIM = 64
# The number of values sampled for the typical light. Their distance is not a multiple of 3, so that all colours occur.
_LOOKED_AT = 1 << 16

# Light above which sums of squares may leave single precision
WIDE = 2.0**60

LIGHT = tuple(name for name, layer in LAYERS.items() if layer.channels == RGB and name != "albedo")
VARIANCES = tuple(name for name in LIGHT if name.endswith("_var"))


def magnitude(stack: GradientStack) -> int:
    """The power of two by which the light of a stack is to be divided; 0 for ordinary light, and if there is no light.

    It is the power of two of the typical light: the median of the primal's finite values other than 0. It is larger if
    the squares of the largest values would otherwise not be finite.
    """
    primal = stack["primal"]
    flat = primal.reshape(-1)
    step = max(flat.size // _LOOKED_AT, 1)
    typical = _median(flat[:: step + (step % 3 == 0)])
    typical = typical or _median(flat)
    if not typical:
        return 0
    power = math.frexp(typical)[1] - 1
    if power < -ORDINARY:
        layers = (stack[name] for name in ("primal", "dx", "dy") if name in stack)
        largest = max(float(np.abs(layer[np.isfinite(layer)]).max(initial=0)) for layer in layers)
        power = max(power, math.frexp(largest)[1] - _LARGEST)
    return power if abs(power) > ORDINARY else 0


def bound(image: np.ndarray) -> float:
    """The limit above which light counts as an outlier.

    It is infinite unless some light is above ``WIDE``, as single fireflies may be. Then it is 2^``ORDINARY`` times the
    typical light, but at most ``WIDE``.
    """
    if np.abs(image).max(initial=0) <= WIDE:
        return math.inf
    return min(max(_median(image.reshape(-1)), 2.0**-_LARGEST) * 2.0**ORDINARY, WIDE)


def _median(values: np.ndarray) -> float:
    """The median of the absolute values that are finite and not 0; 0 if there are none."""
    sizes = np.abs(values[np.isfinite(values) & (values != 0)])
    # The mean of the two middle values may exceed single precision.
    return float(np.median(sizes.astype(np.float64))) if sizes.size else 0.0


def scaled(stack: GradientStack, power: int) -> GradientStack:
    """The stack with 2^-power times its light, all layers in single precision."""
    changed = {}
    for name in stack.names:
        layer = stack[name]
        if name in VARIANCES and (power or layer.dtype != np.float32):
            with np.errstate(over="ignore", under="ignore"):
                variance = np.ldexp(layer, -2 * power).astype(np.float32)
            lost = power < -_DIM and layer.dtype == np.float32
            changed[name] = np.where(layer == 0, np.float32(np.nan), variance) if lost else variance
        elif name in LIGHT and power:
            changed[name] = enlarged(layer, -power)
    if not changed:
        return stack
    fine = stack.fine | ({"primal": enlarged(stack.fine["primal"], -power)} if stack.fine and power else {})
    return replace(stack.replace(**changed), fine=fine)


def enlarged(light: np.ndarray, power: int) -> np.ndarray:
    """2^power times the light, of the same type; infinite where this type cannot hold it."""
    with np.errstate(over="ignore", under="ignore"):
        return np.ldexp(light, power) if power else light
