"""Scales very bright or dark light so that single precision can hold its squares, and scales results back.

Methods square light and divide by variances in single precision, which ends at 2^±127. So a stack whose typical light
is beyond 2^±``ORDINARY`` is multiplied by a power of two before a method reads it, and the result is divided by the
same power. Both operations are exact. Other stacks are not changed.

Light of 1e-30 has variances near 1e-60, and light of 1e30 has variances near 1e60. Single precision cannot hold either.
``GradientStack`` keeps such variances if they are passed in double precision. In files, and in arrays of single
precision, these variances are 0 or infinite. Infinite variances count as unknown. A variance of 0 also counts as
unknown if the light is so dark that its square may underflow.
"""

import math
from dataclasses import replace

import numpy as np

from ngpt.layers import LAYERS, RGB
from ngpt.stack import GradientStack

# Methods are made for typical light from 2^-ORDINARY to 2^ORDINARY: a millionth to a million.
ORDINARY = 20
# Dark light is scaled up to at most 2^_LARGEST, so that float32 can hold its square.
_LARGEST = 62
# Variances of light below 2^-_DIM may underflow to 0: a millionth of the square of such light is below 2^-148.
_DIM = 64
# About this many values are sampled for the typical light. Their distance is not a multiple of 3, so that all colours
# occur.
_LOOKED_AT = 1 << 16

# Sums of squares of light above this may leave single precision.
WIDE = 2.0**60

LIGHT = tuple(name for name, layer in LAYERS.items() if layer.channels == RGB and name != "albedo")
VARIANCES = tuple(name for name in LIGHT if name.endswith("_var"))


def magnitude(stack: GradientStack) -> int:
    """The exponent of the power of two by which to divide a stack's light; 0 for ordinary light, and for no light.

    It is the exponent of the typical light, which is the median of the primal's finite values other than 0, without
    their signs. For dark stacks, it is larger if the squares of the largest values would otherwise not be finite.
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

    If no light is above ``WIDE``, the limit is infinite. If some light is (single fireflies may be), the limit is
    2^``ORDINARY`` times the typical light, but at most ``WIDE``.
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
    """Returns the stack with its light multiplied by 2^-power, and with all layers in single precision."""
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
    """Returns the light multiplied by 2^power, in the same type; infinite where this type cannot hold the product."""
    with np.errstate(over="ignore", under="ignore"):
        return np.ldexp(light, power) if power else light
