"""Sums of values that lanes add to any pixel: for light tracing, connections to the camera and Markov chains.

Lanes reach a pixel in no fixed order, and floating-point sums depend on the order. Sums of integers do not, so the
values are added as integers: the same values give the same bits, whatever the threads.
"""

from __future__ import annotations

from typing import Self

import drjit as dr
import mitsuba as mi

# A pixel has one integer for each range of 16 binary exponents, from 2^-48 up to 2^64. In the unit of its range, a
# float32 has at most 24 + 16 bits. So an integer has room for 2^23 of the largest values.
BINS = 7
_LOWEST, _BITS = -48, 16
# Bytes of one pixel and channel.
SPLAT_BYTES = BINS * 8


class Splats:
    """The exact sum of the values that each pixel receives.

    ``add`` may be called within symbolic loops. Digits below 2^-71 are cut off. Values of 2^64 or more, and values that
    are not finite, are dropped and counted.
    """

    def __init__(self, pixels: int, channels: int):
        self.pixels = pixels
        self.channels = channels
        # Ordered by pixel, then by range from the smallest up, then by channel. So the channels of a range are adjacent
        # in memory, because memory access takes most of the time of a splat.
        self.sums = dr.zeros(dr.int64_array_t(mi.Float), pixels * BINS * channels)
        self.lost = dr.zeros(mi.UInt32, pixels)

    @classmethod
    def on(cls, pixels: int, channels: int, sums: tuple) -> Self:
        """Splats on the arrays (``sums``, ``lost``) of other splats, which are changed in place."""
        splats = cls.__new__(cls)
        splats.pixels, splats.channels, (splats.sums, splats.lost) = pixels, channels, sums
        return splats

    def zeros(self) -> tuple:
        """Sums that are zero, for ``on``."""
        sums = dr.zeros(type(self.sums), dr.width(self.sums)), dr.zeros(mi.UInt32, self.pixels)
        dr.make_opaque(sums)
        return sums

    def take(self, sums: tuple) -> None:
        """Adds the ``sums`` of other splats."""
        self.sums, self.lost = self.sums + sums[0], self.lost + sums[1]
        dr.eval(self.sums, self.lost)

    def add(self, pixel: mi.UInt32, components: list, active) -> None:
        """Adds the value of each ``active`` lane to its ``pixel``; ``components`` has a Float for each channel."""
        Int64, Float64 = dr.int64_array_t(mi.Float), dr.float64_array_t(mi.Float)
        good = dr.all([dr.abs(component) < 2.0**64 for component in components])
        dr.scatter_add(self.lost, mi.UInt32(1), pixel, active & ~good)
        for channel, component in enumerate(components):
            exponent = mi.Int32((dr.reinterpret_array(mi.UInt32, mi.Float(component)) >> 23) & 255) - 127
            range_ = dr.maximum(exponent - _LOWEST, 0) // _BITS
            digits = Int64(Float64(component) / _unit(range_))
            place = (pixel * BINS + mi.UInt32(range_)) * self.channels + channel
            # Neighbouring lanes rarely add to the same pixel: looking for such lanes costs more than it saves.
            dr.scatter_add(self.sums, digits, place, active & good, mode=dr.ReduceMode.Direct)

    def totals(self) -> list:
        """The sums: for each channel a Float64 (pixels)."""
        Int64, Float64 = dr.int64_array_t(mi.Float), dr.float64_array_t(mi.Float)
        pixel = dr.arange(mi.UInt32, self.pixels) * BINS
        totals = []
        for channel in range(self.channels):
            places = ((pixel + i) * self.channels + channel for i in range(BINS))
            parts = [Float64(dr.gather(Int64, self.sums, p)) * _unit(mi.Int32(i)) for i, p in enumerate(places)]
            # From the smallest up: little is rounded off before the last step.
            totals.append(sum(parts[1:], parts[0]))
        dr.eval(totals)
        return totals


def _unit(range_: mi.Int32):
    """The unit of a range's integers: the last digit of its smallest values, a power of two."""
    exponent = mi.UInt32(range_ * _BITS + (_LOWEST - 23 + 127))
    return dr.float64_array_t(mi.Float)(dr.reinterpret_array(mi.Float, exponent << 23))
