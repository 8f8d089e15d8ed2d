"""Running mean and variance of many lanes at once.

Welford 1962, "Note on a method for calculating corrected sums of squares and products", in double precision. Plain sums
of squares would lose all digits where the variance is small compared with the mean.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, is_dataclass

import drjit as dr
import mitsuba as mi


@dataclass
class Moments:
    """Running statistics of one value, for all strands. Counts are UInt32; lists hold a Float64 for each channel."""

    count: mi.UInt32  # sum of the weights of the samples
    lost: mi.UInt32  # samples left out because they were not finite
    mean: list
    m2: list  # weighted sum of squared deviations from the mean; empty if no variance is wanted
    # A list of one ``Earlier``; empty if it is not wanted
    earlier: list


@dataclass
class Earlier:
    """Two sets of earlier samples of a strand. Let P be the largest power of two up to the number of the strand's last
    sample. The sets are the samples with numbers below P, and those with numbers below P / 2.

    ``counts`` and ``means`` have one entry for each set: the number of samples, UInt32, and a list of a Float32 for
    each channel, whose rounding is far below the noise. ``bits`` is the number of bits in the number of the last
    sample.
    """

    bits: mi.UInt32
    counts: list
    means: list


def no_moments(width: int, channels: int, variance: bool, halves: bool = False) -> Moments:
    """Empty statistics for ``width`` strands; with ``halves``, they include ``Earlier`` samples."""
    Float64, Float32 = dr.float64_array_t(mi.Float), dr.float32_array_t(mi.Float)
    mean, m2 = ([dr.zeros(Float64, width) for _ in range(channels)] for _ in range(2))
    count, lost, bits, *counts = (dr.zeros(mi.UInt32, width) for _ in range(5))
    means = [[dr.zeros(Float32, width) for _ in range(channels)] for _ in range(2)]
    return Moments(count, lost, mean, m2 if variance else [], [Earlier(bits, counts, means)] if halves else [])


def one_more(old: Moments, x: list, exists, number: mi.UInt32, weight: mi.UInt32 | int = 1) -> Moments:
    """The statistics after one more sample ``x`` of each strand, where it ``exists``. ``number`` is the number of that
    sample in its pixel. A sample that is not finite counts as lost. ``weight`` is the number of samples that ``x`` is
    the mean of."""
    Float64 = dr.float64_array_t(mi.Float)
    finite = dr.all([dr.isfinite(component) for component in x])
    good = exists & finite
    count = dr.select(good, old.count + weight, old.count)
    lost = dr.select(exists & ~finite, old.lost + 1, old.lost)
    share = Float64(weight) / Float64(dr.maximum(count, weight))
    deviations = [dr.select(good, Float64(c) - m, 0) for c, m in zip(x, old.mean, strict=True)]
    mean = [dr.fma(d, share, m) for d, m in zip(deviations, old.mean, strict=True)]
    # weight (x - old mean)(x - new mean), where x - new mean = (x - old mean)(1 - share).
    m2 = [dr.fma(Float64(weight) * d * d, 1 - share, m) for d, m in zip(deviations, old.m2, strict=False)]
    return Moments(count, lost, mean, m2, [_one_later(each, old, number) for each in old.earlier])


def _one_later(earlier: Earlier, old: Moments, number: mi.UInt32) -> Earlier:
    """Updates ``earlier`` for the sample ``number``; ``old`` are the statistics of the samples before it."""
    Float32 = dr.float32_array_t(mi.Float)
    bits = 32 - dr.lzcnt(number)
    begins = bits != earlier.bits
    # If the number of bits grows by more than one, the strand has no sample from P / 2 up to P. Then all its earlier
    # samples are below P / 2, too.
    follows = bits == earlier.bits + 1
    last, half = earlier.counts
    counts = [dr.select(begins, old.count, last), dr.select(begins, dr.select(follows, last, old.count), half)]
    means: list[list] = [[], []]
    for mean, last_mean, half_mean in zip(old.mean, *earlier.means, strict=True):
        now = Float32(mean)
        means[0].append(dr.select(begins, now, last_mean))
        means[1].append(dr.select(begins, dr.select(follows, last_mean, now), half_mean))
    return Earlier(bits, counts, means)


@dataclass
class Strands:
    """The lanes of each strand: ``block`` lanes from ``first`` on, and again each ``stride`` later, up to ``end``.

    ``number`` is the number of the first sample in its pixel. It grows by ``further`` from one block to the next.
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
    return _each(moments, lambda value: dr.gather(type(value), value, place))


def put_back(moments: Moments, some: Moments, place: mi.UInt32) -> Moments:
    """``moments`` with the statistics of ``some`` strands, each at its own ``place``."""

    def scatter(value, part):
        dr.scatter(value, part, place)
        dr.eval(value)
        return value

    return _each(moments, scatter, some)


def _each(moments: Moments, f: Callable, *others: Moments) -> Moments:
    """Applies ``f`` to each array of ``moments`` and the same array of the ``others``; returns new statistics."""

    def of(value, *more):
        if isinstance(value, list):
            return [of(*parts) for parts in zip(value, *more, strict=True)]
        if is_dataclass(value):
            return type(value)(
                *(of(*(getattr(each, field.name) for each in (value, *more))) for field in fields(value))
            )
        return f(value, *more)

    return of(moments, *others)
