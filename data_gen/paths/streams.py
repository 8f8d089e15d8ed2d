"""Random numbers that belong to a sample of a pixel, or to a light path, and do not depend on the passes of a render.

There are two kinds of ``points``. "independent" points come from a random number generator for each sample. "sobol"
points, the default, come from Owen-scrambled Sobol sequences, with a new pair of dimensions for each pair of numbers.

- Each pair of dimensions uses the first two dimensions of Sobol's sequence, with a new scrambling of the order of the
  points and of both coordinates. [Burley 2020, "Practical Hash-based Owen Scrambling"]
- Pixels are numbered in Z order within tiles of 64x64, and the points of a pixel follow each other. Tiles are
  independent of each other. [Ahmed and Wonka 2020, "Screen-space blue-noise diffusion of Monte Carlo sampling error via
  hierarchical ordering of pixels"]
- Samples come in *rounds* that are independent of each other. The first round has the requested number of samples, or
  16 if that is not known. Each further round has as many samples as all rounds before it.
- Light paths that belong to no pixel are numbered in the order of their pass. Passes are independent of each other.
"""

from __future__ import annotations

from functools import cache

import drjit as dr
import mitsuba as mi
import numpy as np

# Samples of a pixel in the first round, if their total number is not known
ROUND = 16
# Largest number of samples per pixel in a round, as a power of two: 32 bits number all samples of a tile's pixels.
_LARGEST = 20
# Side of a tile of pixels, as a power of two
_TILE = 6


def first_round(points: str, samples: int | None) -> int:
    """Samples of a pixel in the first round, a power of two, or 0 for independent samples.

    ``points`` is "sobol" (the first round has all ``samples``, or 16 if that is None), "rounds" (always 16) or
    "independent".
    """
    if points == "independent":
        return 0
    if points == "rounds" or samples is None:
        return ROUND
    return 1 << min((samples - 1).bit_length(), _LARGEST)


def sample_streams(seed: int, pixel: mi.UInt32, sample: mi.UInt32, width: int = 0, net: int = 0) -> mi.Sampler:
    """A sampler whose lanes are the streams of sample ``sample`` of pixel ``pixel``.

    ``seed`` is an integer from 0. With a ``net`` above 0, the numbers are points in an image of this ``width``, and the
    first round has ``net`` samples of each pixel, a power of two. With ``net`` 0 they are independent. The numbers of
    Mitsuba's own sampler depend on the number of the lane in its pass, so the image would change with the size of
    passes.
    """
    if not net:
        return _independent(seed, pixel, sample)
    width, net = (dr.opaque(mi.UInt32, n) for n in (width, net))
    bits = dr.minimum(31 - dr.lzcnt(dr.maximum(sample, net)), _LARGEST)
    # All samples of the first round use the bits of the largest number in it.
    bits = dr.select(sample < net, 31 - dr.lzcnt(net), bits)
    first = dr.select(sample < net, 0, sample >> bits << bits)
    x, y = pixel % width, pixel // width
    within = (1 << _TILE) - 1
    number = _apart(x & within) | _apart(y & within) << 1
    key = mixed(first ^ _key(seed, 0))
    key = mixed(key ^ (x >> _TILE | y >> _TILE << 16))
    return _sobol_class(mi.variant())((number << bits | sample - first, key, dr.zeros(mi.UInt32, dr.width(key))))


def light_streams(seed: int, number: mi.UInt32, turn: int, independent: bool = False) -> mi.Sampler:
    """The streams of the light paths ``number`` in pass number ``turn``. They differ from all streams of pixels."""
    turn = dr.opaque(mi.UInt32, turn)
    if independent:
        return _independent(seed, number, turn, of_lights=True)
    key = mixed(turn ^ _key(seed, 1)) + dr.zeros(mi.UInt32, dr.width(number))
    return _sobol_class(mi.variant())((number, key, dr.zeros(mi.UInt32, dr.width(number))))


def _independent(seed: int, a: mi.UInt32, b: mi.UInt32, of_lights: bool = False) -> mi.Sampler:
    """Independent generators, one for each (a, b)."""
    entropy = [seed, 2] if of_lights else seed
    keys = (int(key) for key in np.random.SeedSequence(entropy).generate_state(2))
    # The pair is encrypted twice. If it were encrypted once, the streams of two seeds could differ only by a shift of
    # some pixels or samples.
    a, b = mi.sample_tea_32(a, b)
    a, b = mi.sample_tea_32(*(half ^ dr.opaque(mi.UInt32, key) for half, key in zip((a, b), keys, strict=True)))
    random = mi.PCG32()
    random.seed(mi.UInt64(a) | (mi.UInt64(b) << 32), mi.UInt64(b))
    return _stream_class(mi.variant())(random)


def _key(seed: int, what: int) -> mi.UInt32:
    """32 bits made of the seed, which differ for each kind of stream (``what``)."""
    return dr.opaque(mi.UInt32, int(np.random.SeedSequence([seed, 1, what]).generate_state(1)[0]))


@cache
def _stream_class(variant: str) -> type:
    """The class of samplers with independent numbers. Its base is a class of Mitsuba, and so belongs to a variant."""

    class Stream(mi.Sampler):
        """Independent random numbers. Cloning replays them. A stream can be recreated from ``state``."""

        def __init__(self, state):
            super().__init__(mi.Properties())
            self.random = mi.PCG32(state)

        @property
        def state(self):
            return self.random

        def next_1d(self, active=True):
            return self.random.next_float32(active)

        def next_2d(self, active=True):
            x = self.random.next_float32(active)
            return mi.Point2f(x, self.random.next_float32(active))

        def next_key(self):
            """32 random bits, from which a variable number of random numbers can be made."""
            return self.random.next_uint32()

        def skip(self, count):
            """Skips ``count`` numbers of each lane, UInt32."""
            self.random += mi.Int64(count)

        def clone(self):
            return Stream(self.random)

        def at(self, lanes):
            random = mi.PCG32()
            random.state = dr.gather(mi.UInt64, self.random.state, lanes)
            random.inc = dr.gather(mi.UInt64, self.random.inc, lanes)
            return Stream(random)

        def schedule_state(self):
            dr.schedule(self.random)

    return Stream


@cache
def _sobol_class(variant: str) -> type:
    class Points(mi.Sampler):
        """Point ``index`` of each dimension from ``dimension`` on, scrambled by ``key``. Cloning replays them.

        A pair of numbers advances by two dimensions, so that ``skip`` can count pairs and single numbers alike. Lanes
        that draw while others are inactive get ahead of them.
        """

        def __init__(self, state):
            super().__init__(mi.Properties())
            self.index, self.key, self.dimension = (mi.UInt32(each) for each in state)

        @property
        def state(self):
            return self.index, self.key, self.dimension

        def next_1d(self, active=True):
            bits = self._scramble()
            place = _owen(self.index, mixed(bits))
            self.dimension = dr.select(active, self.dimension + 1, self.dimension)
            return _unit(_reversed_owen(place, mixed(bits ^ 0x68BC21EB)))

        def next_2d(self, active=True):
            bits = self._scramble()
            place = _owen(self.index, mixed(bits))
            x = _reversed_owen(place, mixed(bits ^ 0x68BC21EB))
            y = _reversed_owen(_pascal(place), mixed(bits ^ 0x02E5BE93))
            self.dimension = dr.select(active, self.dimension + 2, self.dimension)
            return mi.Point2f(_unit(x), _unit(y))

        def next_key(self):
            bits = mixed(self._scramble() ^ mixed(self.index + 0x967A889B))
            self.dimension = self.dimension + 1
            return bits

        def skip(self, count):
            self.dimension = self.dimension + count

        def clone(self):
            return Points(self.state)

        def at(self, lanes):
            return Points([dr.gather(mi.UInt32, each, lanes) for each in self.state])

        def schedule_state(self):
            dr.schedule(self.state)

        def _scramble(self):
            return self.key ^ (self.dimension * 0x9E3779B1)

    return Points


def mixed(x: mi.UInt32) -> mi.UInt32:
    """A hash of 32 bits. [Wellons 2018, "Prospecting for hash functions", lowbias32]"""
    x = (x ^ (x >> 16)) * mi.UInt32(0x7FEB352D)
    x = (x ^ (x >> 15)) * mi.UInt32(0x846CA68B)
    return x ^ (x >> 16)


def _reversed_owen(x: mi.UInt32, seed: mi.UInt32) -> mi.UInt32:
    """Nested uniform scrambling of ``x``, given with reversed bits; the result has the usual order of bits.

    The lower bits of ``x`` decide whether a bit is flipped. [Laine and Karras 2011, "Stratified sampling for stochastic
    transparency"; constants of Vegdahl 2021, "Building a better LK hash"]
    """
    # Not in place, which would change the caller's array
    x = x ^ (x * 0x3D20ADEA)
    x = (x + seed) * ((seed >> 16) | 1)
    x = x ^ (x * 0x05526C56)
    x = x ^ (x * 0x53A22864)
    return dr.brev(x)


def _owen(x: mi.UInt32, seed: mi.UInt32) -> mi.UInt32:
    """Nested uniform scrambling of the integer ``x``. It maps each aligned block of 2^n integers to an aligned
    block."""
    return _reversed_owen(dr.brev(x), seed)


def _pascal(x: mi.UInt32) -> mi.UInt32:
    """Sobol's second dimension, with reversed bits: Pascal's triangle modulo 2, times the bits of ``x``."""
    for shift, kept in ((1, 0x55555555), (2, 0x33333333), (4, 0x0F0F0F0F), (8, 0x00FF00FF), (16, 0x0000FFFF)):
        x = x ^ ((x >> shift) & kept)
    return x


def _apart(x: mi.UInt32) -> mi.UInt32:
    """Spreads the bits of ``x``, up to 8, with a 0 between neighbours."""
    for shift, kept in ((4, 0x0F0F), (2, 0x3333), (1, 0x5555)):
        x = (x | x << shift) & kept
    return x


def _unit(bits: mi.UInt32) -> mi.Float:
    """``bits`` as a number in [0, 1)."""
    return mi.Float(bits >> 8) * 2.0**-24
