"""Pairs of a point, or a ray, and a photon near it, in the order of the points: one lane each, however many they are.

Shifts run on the list of pairs, where all lanes work. Within the walk through the grid only one lane in five would have
a photon. The list is cut into pieces of a given length, and the sums over the pairs of a point are added up in their
order: the same pairs give the same bits.

A *thing* (a photon, a beam, a plane) is paired with what it is near to on a base path (a vertex, a piece of a ray), the
*receiver* A. The neighbour's path has the corresponding receiver B. A thing near to both is its own copy. If a thing is
near only to A, a copy is made near to B.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Protocol

import drjit as dr
import mitsuba as mi

from data_gen.paths.frozen import call
from data_gen.paths.light_ends import World
from data_gen.samplers.photons.map.grid import Grid
from ngpt_studies.photons.gradients.camera import Path


@dataclass
class Pairs:
    """A piece of the list of all pairs: ``point``, and ``place``, where the photon is in the list of the grid."""

    point: mi.UInt32
    place: mi.UInt32
    first: mi.UInt32  # of each point, where its pairs begin in this piece
    end: mi.UInt32

    def sums(self, values: list) -> list:
        """For each of ``values``, an array of colours, one for each pair: the sum over the pairs of each point."""
        zeros = [dr.zeros(type(value), dr.width(self.first)) for value in values]

        def add(i, sums):
            return i + 1, [total + dr.gather(type(v), v, i) for total, v in zip(sums, values, strict=True)]

        state = (mi.UInt32(self.first), zeros)
        return dr.while_loop(state, lambda i, sums: i < self.end, add, label="sums of pairs")[1]


class Receivers(Protocol):
    """Receivers that may have things near to them, one in each lane."""

    def each(self, grid: Grid | None, radius2: mi.Float | None, active: mi.Bool, visit, state: tuple) -> tuple:
        """``state`` after visits to all that may be near: see ``Grid.each``."""

    def __len__(self) -> int: ...


@dataclass
class Points:
    p: mi.Point3f

    def each(self, grid: Grid, radius2: mi.Float, active: mi.Bool, visit, state: tuple) -> tuple:
        return grid.each(self.p, radius2, active, visit, state)

    def __len__(self) -> int:
        return dr.width(self.p)


@dataclass
class Rays:
    ray: mi.Ray3f
    length: mi.Float

    def each(self, grid: Grid, radius2: mi.Float, active: mi.Bool, visit, state: tuple) -> tuple:
        return grid.along(self.ray, self.length, radius2, active, visit, state)

    def __len__(self) -> int:
        return dr.width(self.length)


def pieces(near, points: Receivers, active: mi.Bool, most: int, frozen: Callable = call) -> Iterator[Pairs]:
    """All pairs of ``active`` points and what is ``near`` to them (its grid, its radius), at most this number at a
    time.
    """
    around = near.grid, near.radius2
    count = frozen(counts, around, points, active)
    first = dr.prefix_sum(count)
    dr.eval(count, first, active)
    total = int(dr.sum(count)[0])
    for low in range(0, total, most):
        size = min(most, total - low)
        window = dr.opaque(mi.UInt32, low), dr.opaque(mi.UInt32, size)
        pairs = dr.empty(mi.UInt32, size), dr.empty(mi.UInt32, size)
        dr.make_opaque(pairs)
        pairs = frozen(piece, around, points, active, (first, count), window, pairs)
        dr.eval(pairs)
        yield pairs


def counts(around: tuple, points: Receivers, active) -> mi.UInt32:
    """Returns the number of pairs of each point. ``around`` is (grid, squared radius)."""

    def one_more(state, i, near):
        return (state[0] + dr.select(near, mi.UInt32(1), 0),)

    return points.each(*around, active, one_more, (dr.zeros(mi.UInt32, len(points)),))[0]


def piece(around: tuple, points: Receivers, active, places: tuple, window: tuple, pairs: tuple) -> Pairs:
    """The part of the list in the ``window`` (low, size), written into ``pairs``, two arrays of that size.

    ``places``: where in the list each point's pairs begin, and how many they are.
    """
    (first, count), (begin, length), (point, place) = places, window, pairs
    inside = active & (first < begin + length) & (first + count > begin)
    lane = dr.arange(mi.UInt32, len(points))

    def write(state, i, near):
        # Below ``begin`` the difference is larger than any length.
        at = state[0] - begin
        known = near & (at < length)
        dr.scatter(point, lane, at, known)
        dr.scatter(place, i, at, known)
        return (dr.select(near, state[0] + 1, state[0]),)

    points.each(*around, inside, write, (mi.UInt32(first),))
    last = dr.minimum(first + count, begin + length)
    start = dr.maximum(first, begin)
    return Pairs(point, place, *(dr.select(inside, x - begin, 0) for x in (start, last)))


class Near(Protocol):
    """The things of a photon map. All its arrays are evaluated."""

    grid: Grid | None  # in which things are found within ``radius2``; None where any may be near
    radius2: mi.Float | None

    def where(self, world: World, base: Path) -> tuple[Receivers, mi.Bool]:
        """Where base paths receive light, for the grid; and which of them do."""

    def receiver(self, world: World, paths: list, which: mi.UInt32 | None, index: mi.UInt32) -> Any:
        """Returns the receiver of each path ``index``, for the path of number ``which`` if there are several
        ``paths``.
        """

    def thing(self, place: mi.UInt32) -> Any:
        """Returns the thing at that place in the list of the grid. It has ``depth``, the edges of its light path."""

    def brought(self, thing: Any, A: Any, active: mi.Bool) -> tuple[mi.Spectrum, Any]:
        """Returns C, the light that it brings to the camera by A (0 if it is not near), and where they meet."""

    def shared(self, thing: Any, met: Any, B: Any, lit: mi.Bool) -> tuple[mi.Spectrum, mi.Bool]:
        """Returns the light that it brings by B as its own copy, and whether to look for a copy at another place.

        ``met`` is where thing and A meet, ``lit`` whether it brings anything there.
        """

    def copied(self, world: World, thing: Any, A: Any, B: Any) -> tuple[mi.Spectrum, mi.Float]:
        """Returns the light that its copy brings by B (0 if there is none), and r."""
