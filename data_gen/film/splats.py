"""Sums of values that lanes put onto any pixel of the image: light tracing, connections to the camera, Markov chains.

Lanes meet at a pixel in no fixed order, and floating-point sums depend on the order. So the values are added as
integers, whose sums do not: the same values give the same bits, whatever the threads.
"""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi


def splat_sums(pixels: int, index: mi.UInt32, components: list, active) -> tuple[list, mi.UInt32]:
    """For each pixel the sum of the values that were put on it, (pixels) Float64 a component, and how many were lost.

    ``index``       the pixel of each lane, row by row
    ``components``  Float arrays, one a channel; a lane with one that is not finite counts as lost, as nothing else
    ``active``      which lanes exist

    The sum is exact but for its last step. A value of float32 is cut into two integers, one in units that make room for
    all lanes in 63 bits, one in units as much finer: 82 bits and more, from the largest value of the pass down.
    """
    Int64, Float64 = dr.int64_array_t(mi.Float), dr.float64_array_t(mi.Float)
    finite = dr.all([dr.isfinite(component) for component in components])
    good = active & finite
    lost = dr.zeros(mi.UInt32, pixels)
    dr.scatter_add(lost, mi.UInt32(1), index, active & ~finite)
    size = mi.Float(0)
    for component in components:
        size = dr.maximum(size, dr.abs(component))
    dr.eval(components, index, good, lost)
    largest = float(dr.max(dr.select(good, size, 0))[0])
    if largest == 0:
        return [dr.zeros(Float64, pixels) for _ in components], lost
    lanes = max(dr.width(index), *(dr.width(component) for component in components))
    room = 62 - math.ceil(math.log2(max(lanes, 2)))
    # Opaque: literals would be compiled into the kernel, a new one for every pass.
    coarse, fine = (dr.opaque(Float64, 2.0 ** (math.frexp(largest)[1] - n * room)) for n in (1, 2))
    sums = []
    for component in components:
        value = dr.select(good, Float64(component), 0)
        high = Int64(value / coarse)
        low = Int64((value - Float64(high) * coarse) / fine)
        total = [dr.zeros(Int64, pixels) for _ in range(2)]
        for part, digits in zip(total, (high, low), strict=True):
            dr.scatter_add(part, digits, index, good)
        sums.append(Float64(total[0]) * coarse + Float64(total[1]) * fine)
    dr.eval(sums)
    return sums, lost
