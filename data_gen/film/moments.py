"""Running mean and variance of many lanes at once.

Welford 1962, "Note on a method for calculating corrected sums of squares and products", in double precision: sums of
squares would lose all digits where the variance is small beside the mean.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi


@dataclass
class Moments:
    """Running statistics of one value, for all strands: counts UInt32, a Float64 for each channel of the others."""

    count: mi.UInt32  # samples that count
    lost: mi.UInt32  # samples left out because they were not finite
    mean: list
    m2: list  # sum of squared deviations from the mean; empty where nobody asks for a variance
    # Of samples before the last one whose number is a power of two (see ``data_gen.film.claims``): how many, their
    # mean, which is empty where nobody asks for it, and how many bits the number of the last sample has
    earlier: mi.UInt32
    before: list
    bits: mi.UInt32


def no_moments(width: int, channels: int, variance: bool, halves: bool = False) -> Moments:
    """The statistics of no sample, for ``width`` strands; with ``halves``, also of those ``before``."""
    Float64 = dr.float64_array_t(mi.Float)
    mean, m2, before = ([dr.zeros(Float64, width) for _ in range(channels)] for _ in range(3))
    count, lost, earlier, bits = (dr.zeros(mi.UInt32, width) for _ in range(4))
    return Moments(count, lost, mean, m2 if variance else [], earlier, before if halves else [], bits)


def one_more(old: Moments, x: list, exists, number: mi.UInt32) -> Moments:
    """The statistics with one more sample ``x``, which has this ``number``, for each strand where it ``exists``; one
    that is not finite is lost."""
    Float64 = dr.float64_array_t(mi.Float)
    finite = dr.all([dr.isfinite(component) for component in x])
    good = exists & finite
    count = dr.select(good, old.count + 1, old.count)
    lost = dr.select(exists & ~finite, old.lost + 1, old.lost)
    share = 1 / Float64(dr.maximum(count, 1))
    deviations = [dr.select(good, Float64(c) - m, 0) for c, m in zip(x, old.mean, strict=True)]
    mean = [dr.fma(d, share, m) for d, m in zip(deviations, old.mean, strict=True)]
    # (x - old mean)(x - new mean), where x - new mean = (x - old mean)(1 - share).
    m2 = [dr.fma(d * d, 1 - share, m) for d, m in zip(deviations, old.m2, strict=False)]
    if not old.before:
        return Moments(count, lost, mean, m2, old.earlier, [], old.bits)
    bits = 32 - dr.lzcnt(number)
    begins = bits != old.bits
    earlier = dr.select(begins, old.count, old.earlier)
    before = [dr.select(begins, m, b) for m, b in zip(old.mean, old.before, strict=True)]
    return Moments(count, lost, mean, m2, earlier, before, bits)


@dataclass
class Strands:
    """Which samples each strand takes: ``block`` from ``first`` on, again ``stride`` later, all before ``end``.

    The first has a ``number`` in its pixel, and the first of its next block one that is ``further`` on.
    """

    first: mi.UInt32
    end: mi.UInt32
    block: mi.UInt32
    stride: mi.UInt32
    number: mi.UInt32
    further: mi.UInt32


def accumulate(moments: Moments, components: list, active, strands: Strands) -> Moments:
    """Adds samples to each strand's moments."""
    first, end, block, stride = strands.first, strands.end, strands.block, strands.stride

    def add(i: mi.UInt32, n: mi.UInt32, number: mi.UInt32, old: Moments):
        x = [dr.gather(mi.Float, component, i) for component in components]
        exists = mi.Bool(True) if active is True else dr.gather(mi.Bool, active, i)
        last = n + 1 == block
        # Not in place: that would move `first` too.
        next_number = number + dr.select(last, strands.further - block + 1, 1)
        new = one_more(old, x, exists, number)
        return i + dr.select(last, stride - block + 1, 1), dr.select(last, 0, n + 1), next_number, new

    state = (first, mi.UInt32(0), mi.UInt32(strands.number), moments)
    return dr.while_loop(state, lambda i, *_: i < end, add, label="film")[3]


def taken(moments: Moments, place: mi.UInt32) -> Moments:
    """The statistics of the strands at each ``place``."""

    def gather(values: list) -> list:
        return [dr.gather(type(value), value, place) for value in values]

    counts = gather([moments.count, moments.lost, moments.earlier, moments.bits])
    return _of(counts, gather(moments.mean), gather(moments.m2), gather(moments.before))


def put_back(moments: Moments, some: Moments, place: mi.UInt32) -> Moments:
    """``moments`` with the statistics of ``some`` strands, each at its own ``place``."""

    def scatter(values: list, new: list) -> list:
        for value, part in zip(values, new, strict=True):
            dr.scatter(value, part, place)
        dr.eval(values)
        return values

    counts = scatter(
        [moments.count, moments.lost, moments.earlier, moments.bits], [some.count, some.lost, some.earlier, some.bits]
    )
    return _of(
        counts, scatter(moments.mean, some.mean), scatter(moments.m2, some.m2), scatter(moments.before, some.before)
    )


def _of(counts: list, mean: list, m2: list, before: list) -> Moments:
    count, lost, earlier, bits = counts
    return Moments(count, lost, mean, m2, earlier, before, bits)
