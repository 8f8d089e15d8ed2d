"""Random numbers that belong to a sample of a pixel, whatever pass renders it."""

from __future__ import annotations

from functools import cache

import drjit as dr
import mitsuba as mi
import numpy as np


def sample_streams(seed: int, pixel: mi.UInt32, sample: mi.UInt32) -> mi.Sampler:
    """A sampler whose lanes are the independent streams of sample ``sample`` of pixel ``pixel``.

    ``seed`` is any integer from 0. Mitsuba's own sampler numbers the lanes of a pass instead, so its numbers change
    with the size of passes, and with them the image.
    """
    keys = (int(key) for key in np.random.SeedSequence(seed).generate_state(2))
    # Enciphered twice, so that the streams of two seeds are not those of one, shifted by some pixels or samples.
    a, b = mi.sample_tea_32(pixel, sample)
    a, b = mi.sample_tea_32(*(half ^ dr.opaque(mi.UInt32, key) for half, key in zip((a, b), keys, strict=True)))
    random = mi.PCG32()
    random.seed(mi.UInt64(a) | (mi.UInt64(b) << 32), mi.UInt64(b))
    return _stream_class(mi.variant())(random)


@cache
def _stream_class(variant: str) -> type:
    """The sampler's class; Mitsuba's own classes, and so those derived from them, belong to a variant."""

    class Stream(mi.Sampler):
        """Independent random numbers. Cloning replays them."""

        def __init__(self, random):
            super().__init__(mi.Properties())
            self.random = mi.PCG32(random)

        def next_1d(self, active=True):
            return self.random.next_float32(active)

        def next_2d(self, active=True):
            x = self.random.next_float32(active)
            return mi.Point2f(x, self.random.next_float32(active))

        def next_key(self):
            """Any 32 bits, from which more random numbers are made than would be drawn whether used or not."""
            return self.random.next_uint32()

        def skip(self, count):
            """Leaves out so many numbers of each lane, UInt32."""
            self.random += mi.Int64(count)

        def clone(self):
            return Stream(self.random)

        def at(self, lanes):
            """The streams of these lanes alone."""
            random = mi.PCG32()
            random.state = dr.gather(mi.UInt64, self.random.state, lanes)
            random.inc = dr.gather(mi.UInt64, self.random.inc, lanes)
            return Stream(random)

        def schedule_state(self):
            dr.schedule(self.random)

    return Stream
