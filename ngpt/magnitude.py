"""Scales light of any exposure so that single precision holds its squares, and scales results back.

Methods square light and weigh by variances in single precision, which ends at 2^±127. So a stack whose typical light is
beyond 2^±``ORDINARY`` is multiplied by a power of two before a method sees it, and the result is multiplied back. Both
are exact. Any other stack stays as it is, bit for bit.

Variances may have left the range of single precision before: light of 1e-30 has variances of 1e-60. ``GradientStack``
keeps double precision if it is given double precision. In files, and in arrays of single precision, such variances are
0 or infinite. Infinite variances count as unknown, as everywhere. Variances of 0 count as unknown where the light is so
dim that its square could underflow to 0.
"""

import math
from dataclasses import replace

import numpy as np

from ngpt.layers import LAYERS, RGB
from ngpt.stack import GradientStack

# The powers of two of typical light that methods are made for: a millionth to a million.
ORDINARY = 20
# The largest light has at most this number of binary digits before the point: its square is a float.
_LARGEST = 62
# For typical light below 2^-_DIM, variances of 0 say nothing: a millionth of its square is below 2^-148.
_DIM = 64
# The number of values sampled for the typical light. Their distance is no multiple of 3, so all colours occur.
_LOOKED_AT = 1 << 16

# Sums of squares of light beyond this leave single precision.
WIDE = 2.0**60

LIGHT = tuple(name for name, layer in LAYERS.items() if layer.channels == RGB and name != "albedo")
VARIANCES = tuple(name for name in LIGHT if name.endswith("_var"))


def magnitude(stack: GradientStack) -> int:
    """The power of two of the typical light of a stack; 0 where that is ordinary, and where there is no light.

    The typical light is the median of the primal's finite values other than 0. The result is raised if the squares of
    the largest values would otherwise not be finite.
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
    """The limit above which light counts as an outlier. It is infinity for ordinary images. If some light is above
    ``WIDE``, as in single fireflies, it is 2^``ORDINARY`` times the typical light, but at most ``WIDE``."""
    if np.abs(image).max(initial=0) <= WIDE:
        return math.inf
    return min(max(_median(image.reshape(-1)), 2.0**-_LARGEST) * 2.0**ORDINARY, WIDE)


def _median(values: np.ndarray) -> float:
    """The median of the absolute values that are finite and not 0; 0 if there are none."""
    sizes = np.abs(values[np.isfinite(values) & (values != 0)])
    # In double precision: the mean of two in the middle may be beyond the largest of single precision.
    return float(np.median(sizes.astype(np.float64))) if sizes.size else 0.0


def scaled(stack: GradientStack, power: int) -> GradientStack:
    """The stack with 2^-power times its light, all layers in single precision; itself where nothing changes."""
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
    """2^power times the light, of its type; infinite where that cannot hold it."""
    with np.errstate(over="ignore", under="ignore"):
        return np.ldexp(light, power) if power else light
