"""Sums of values that lanes put onto any pixel of the image: light tracing, connections to the camera, Markov chains.

Lanes meet at a pixel in no fixed order, and floating-point sums depend on the order. So the values are added as
integers, whose sums do not: the same values give the same bits, whatever the threads.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

# A pixel has one integer for each range of 16 binary exponents, from 2^-48 up to 2^64. A float32 of a range has at most
# 24 + 16 bits in its units, which leaves room for 2^23 of the largest.
BINS = 7
_LOWEST, _BITS = -48, 16
# Bytes of one pixel and channel.
SPLAT_BYTES = BINS * 8


class Splats:
    """For each pixel the exact sum of what is put on it.

    ``add`` may be called within symbolic loops. What is finer than 2^-71 is cut off; values of 2^64 or more, and those
    that are not finite, are lost and counted, as nothing else.
    """

    def __init__(self, pixels: int, channels: int):
        self.pixels = pixels
        # Pixel after pixel, within a pixel channel by channel, within a channel the ranges from the smallest up
        self.sums = [dr.zeros(dr.int64_array_t(mi.Float), pixels * BINS) for _ in range(channels)]
        self.lost = dr.zeros(mi.UInt32, pixels)

    def add(self, pixel: mi.UInt32, components: list, active) -> None:
        """Adds a value of a Float for each channel to the ``pixel`` of each lane that is ``active``."""
        Int64, Float64 = dr.int64_array_t(mi.Float), dr.float64_array_t(mi.Float)
        good = dr.all([dr.abs(component) < 2.0**64 for component in components])
        dr.scatter_add(self.lost, mi.UInt32(1), pixel, active & ~good)
        for sums, component in zip(self.sums, components, strict=True):
            exponent = mi.Int32((dr.reinterpret_array(mi.UInt32, mi.Float(component)) >> 23) & 255) - 127
            range_ = dr.maximum(exponent - _LOWEST, 0) // _BITS
            digits = Int64(Float64(component) / _unit(range_))
            dr.scatter_add(sums, digits, pixel * BINS + mi.UInt32(range_), active & good)

    def totals(self) -> list:
        """The sums as Float64, (pixels) a channel."""
        Int64, Float64 = dr.int64_array_t(mi.Float), dr.float64_array_t(mi.Float)
        pixel = dr.arange(mi.UInt32, self.pixels) * BINS
        totals = []
        for sums in self.sums:
            parts = [Float64(dr.gather(Int64, sums, pixel + i)) * _unit(mi.Int32(i)) for i in range(BINS)]
            # From the smallest up: little is rounded off before the last step.
            totals.append(sum(parts[1:], parts[0]))
        dr.eval(totals)
        return totals


def _unit(range_: mi.Int32):
    """What an integer of a range counts: the last digit of its smallest values, a power of two."""
    exponent = mi.UInt32(range_ * _BITS + (_LOWEST - 23 + 127))
    return dr.float64_array_t(mi.Float)(dr.reinterpret_array(mi.Float, exponent << 23))
