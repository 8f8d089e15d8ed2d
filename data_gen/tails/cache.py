"""The cache: for each cell the mean of the light that arrives at its surfaces: the irradiance over π.

Cells are cubes, apart by their size and by the side and direction of the surface. A cell is small against the *spread*
of a path at the vertex where the path looks it up: the width of the bundle of paths that arrive there, over which the
light of the cell is blurred. Smooth events add to it,

    spread = Σ t / sqrt(p |cos θ|),

for steps of length t whose direction has density p and meets the surface at θ [the same area: Bekaert et al. 2003,
"Custom path-space filtering"; Müller et al. 2021, "Real-time neural radiance caching for path tracing"].

There are two *halves* of all records, which come from different paths and never read each other. Paths of the image
read the mean of both. Half of the difference between the two is a sample of the error of that mean: both halves have
the same distribution, so its variance is that of the mean, and so are its covariances between cells, and between all
sums of what is read. So a render knows the noise that its pixels share, however far a record's light has spread.

Sums are integers, so that they do not depend on the order of additions. What paths read, ``Known``, is made of them
between two rounds: within a round nothing changes.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import reduce
from typing import Any

import drjit as dr
import mitsuba as mi

from data_gen.paths.streams import mixed
from data_gen.tails.schedule import FINENESS

# MiB that the cache takes, and of those a render may use, what makes this little
MIB, LEAST_MIB = 256, 640
# A path may end where its spread has reached this share of its way to the first rough surface.
NEAR = 1 / 8
HALVES = 2


# Directions along an axis of the octahedral map
_DIRECTIONS = 8


@dataclass
class Place:
    """A vertex as the cache knows it."""

    p: mi.Point3f  # from the corner of the grid
    code: mi.UInt32  # direction of the normal on the side that is seen, and what else tells cells apart
    level: mi.Int32  # cells have the side 2^level


@dataclass
class Trail:
    """How far a path has come: the length of its way to the first rough surface, and its spread from there on."""

    reach: mi.Float
    spread: mi.Float

    @classmethod
    def to(cls, x: mi.SurfaceInteraction3f) -> Trail:
        """The trail of a path at its first vertex."""
        return cls(mi.Float(x.t), dr.zeros(mi.Float, dr.width(x.t)))

    def on(self, x: mi.SurfaceInteraction3f, smooth: mi.Bool, p: mi.Float, active: mi.Bool) -> Trail:
        """At the next vertex ``x``, if there is one, behind an event of density ``p`` that was ``smooth``, or not."""
        there = active & x.is_valid()
        wider = x.t * dr.rsqrt(dr.maximum(p * dr.abs(x.wi.z), 1e-6))
        further = there & ~smooth & (self.spread == 0)
        return Trail(self.reach + dr.select(further, x.t, 0), self.spread + dr.select(there & smooth, wider, 0))


def octahedral(n: mi.Vector3f) -> mi.UInt32:
    """The number of a direction's cell on the sphere. [Meyer et al. 2010, "On floating-point normal vectors"]"""
    s = dr.rcp(dr.abs(n.x) + dr.abs(n.y) + dr.abs(n.z))
    u, v = n.x * s, n.y * s
    folded = n.z < 0
    u, v = dr.select(folded, (1 - dr.abs(v)) * dr.sign(u), u), dr.select(folded, (1 - dr.abs(u)) * dr.sign(v), v)
    # Shifted a little, so that axes lie within cells and not between them.
    i, j = (mi.UInt32(dr.clip((w + 1) * 0.5 * _DIRECTIONS + 0.02, 0, _DIRECTIONS - 1)) for w in (u, v))
    return i + _DIRECTIONS * j


def key(place: Place) -> tuple[mi.UInt32, mi.UInt32, list[mi.Bool]]:
    """Where in a table the cell may be looked for, what it is known by there, which is never 0, and in which half of
    the cell the place is along each axis: whether the upper one."""
    q = place.p * dr.exp2(mi.Float(-place.level))
    corner = [dr.floor(q[i]) for i in range(3)]
    x, y, z = (mi.UInt32(mi.Int32(c)) for c in corner)
    code = place.code + (mi.UInt32(place.level) << 24)
    h = mixed(x + mixed(y + mixed(z + mixed(code + 0x1234567))))
    name = mixed(h ^ (x * 0x9E3779B1 + y * 0x85EBCA6B + z * 0xC2B2AE35 + code * 0x27D4EB2F)) | 1
    return h, name, [q[i] - corner[i] >= 0.5 for i in range(3)]


_LOG = logging.getLogger(f"ngpt.{__name__}")

# Cells that there is room for, and the share of them that may be taken
CELLS, _FULL = 1 << 20, 0.7
# Places beside each other in the table, in which a cell may be
_PLACES = 32
# A cell is trusted once either half has so many records in it, whatever they hold: see ``Cache``. Few are enough, since
# there are about as many paths that read a cell as there are records in it.
LEAST = 2
# A cell is torn where the light in its two parts along an axis differs by more than this share of their sum, at the
# coarsest fineness, and by so many standard errors.
TORN, _CERTAIN, _ENOUGH = 0.2, 1.5, 8
# The unit in which the light of a record counts for that: 1 is all that a record can have, whatever its light.
_PARTS = 4095
# A record may be so many times as bright as the mean of all so far, or have such a part of their light. What is
# brighter is cut: one path would make a spot that no denoiser removes.
MOST, PARTS = 3000, 200
# The light of the brightest record of the first round, and the brightest light that can be represented, in units of
# sums, both as powers of two
_BITS, _MOST_BITS = 30, 40


@dataclass
class Known:
    """What paths may read by cell: the mean of each sort of light, RGB, and 1 where it is trusted, 0 where not; and
    half of the difference between the two halves of the records, with 0 as the fourth number."""

    keys: mi.UInt32
    means: list[mi.Float]
    differences: list[mi.Float]
    fineness: mi.Float
    corner: mi.Point3f

    def place_of(self, x: mi.SurfaceInteraction3f, spread: mi.Float, kind: mi.UInt32 | int) -> Place:
        """Where vertex ``x`` lies among the cells that are ``fineness`` times smaller than the ``spread``.

        ``kind`` tells vertices apart that have no light in common.
        """
        level = mi.Int32(dr.floor(dr.log2(dr.maximum(spread / self.fineness, 1e-20))))
        normal = octahedral(mi.Normal3f(dr.mulsign(x.sh_frame.n, x.wi.z)))
        return Place(mi.Point3f(x.p) - self.corner, normal + (mi.UInt32(kind) << 16), level)

    def look(self, place: Place, active: mi.Bool) -> tuple[list[mi.Color3f], list[mi.Color3f], mi.Bool]:
        """The light of each sort at a place, half of the difference between both halves, and whether it is trusted."""
        h, name, _ = key(place)
        slot, found = in_table(self.keys, h, name, active)
        means, differences = (
            [dr.gather(mi.Vector4f, each, slot, found) for each in flat] for flat in (self.means, self.differences)
        )
        means_rgb, differences_rgb = ([mi.Color3f(v.x, v.y, v.z) for v in each] for each in (means, differences))
        return means_rgb, differences_rgb, found & (means[0].w > 0)


class Cache:
    """Growing sums by cell of so many ``sorts`` of light, and what is known of them.

    The number of a cell's records decides whether the cell is trusted, not the light in them. Where light is rare, a
    cell that has found some looks uncertain, and a cell that has missed it looks certain. Trusting only the certain
    cells would lose light: see docs/samplers/tails.md. A *torn* cell is not trusted either: one whose two parts along
    an axis have other light, as where a wall goes through it. Paths go on from there by themselves.

    ``corner`` is the corner of the grid: a point beyond which the scene lies.
    """

    def __init__(self, fineness: float, sorts: int = 1, corner: tuple[float, float, float] = (0.0, 0.0, 0.0)):
        self.keys = dr.zeros(mi.UInt32, CELLS)
        # By half and cell
        self.count = dr.zeros(mi.UInt32, HALVES * CELLS)
        self.sums = [dr.zeros(mi.Int64, HALVES * CELLS) for _ in range(3 * sorts)]
        # By cell, of all records and of those in the upper part along each axis: how many, and their light in _PARTS
        self.parts = [[dr.zeros(mi.UInt32, CELLS) for _ in range(4)] for _ in range(2)]
        self.unit, self.full, self.fineness = 0.0, False, fineness
        # For all records so far: their number, the sum of the light of the brightest colour of each, in units, and how
        # much of it was cut
        self.records = self.light = self.cut = 0
        means, differences = ([dr.zeros(mi.Float, 4 * CELLS) for _ in range(sorts)] for _ in range(2))
        at = mi.Point3f(*(dr.opaque(mi.Float, x) for x in corner))
        self.known = Known(self.keys, means, differences, dr.opaque(mi.Float, fineness), at)
        dr.make_opaque(self.keys, self.count, self.sums, self.parts, means, differences)

    def add(self, place: Place, half: mi.UInt32, values: list[mi.Float]) -> None:
        """Adds records to their cells: ``values`` are RGB of each sort of light, also below 0; ``half`` is 0 or 1."""
        largest = reduce(dr.maximum, map(dr.abs, values))
        good = dr.isfinite(sum(values))
        if not self.unit:
            first = dr.max(dr.select(good, largest, 0))[0]
            if first > 0:
                # No less than what has an inverse among floats
                self.unit = 2.0 ** max(math.ceil(math.log2(first)) - _BITS, -126)
        # Opaque: it would be compiled into the kernel, a new one for every scene.
        scale = dr.opaque(mi.Float, 1 / self.unit if self.unit else 0)
        brightest = dr.select(good, dr.minimum(largest * scale, 2.0**_MOST_BITS), 0)
        self.records += int(dr.count(good)[0])
        self.light += int(dr.sum(mi.Int64(brightest + 0.5))[0])
        mean = self.light / max(self.records, 1)
        most = dr.opaque(mi.Float, max(MOST, self.records / PARTS) * mean)
        self.cut += int(dr.sum(mi.Int64(dr.maximum(brightest - most, 0)))[0])
        scale = scale * dr.minimum(1, most / dr.maximum(brightest, 1))
        limit = 2.0**_MOST_BITS
        counts = [mi.Int64(dr.round(dr.clip(value * scale, -limit, limit))) for value in values]
        h, name, upper = key(place)
        dr.eval(h, name, good, counts, upper)
        slot, placed = in_table(self.keys, h, name, good, fill=not self.full)
        dr.eval(slot, placed, self.keys)
        direct = {"mode": dr.ReduceMode.Direct}
        of_half = slot + half * CELLS
        for each, count in zip(self.sums, counts, strict=True):
            dr.scatter_add(each, count, of_half, placed, **direct)
        dr.scatter_add(self.count, mi.UInt32(1), of_half, placed, **direct)
        # Relative to the cell's light, or to all light where that is not known: a bright record counts little more.
        here = dr.gather(mi.Vector4f, self.known.means[0], slot, placed)
        usual = dr.select(here.w > 0, dr.maximum(here.x, dr.maximum(here.y, here.z)) / self._unit_or_1(), mean)
        part = mi.UInt32(_PARTS * brightest / dr.maximum(brightest + dr.maximum(usual, 0), 1e-20))
        for i, within in enumerate((True, *upper)):
            for each, value in zip(self.parts, (mi.UInt32(1), part), strict=True):
                dr.scatter_add(each[i], value, slot, placed & within, **direct)
        dr.eval(self.keys, self.count, self.sums, self.parts)

    def _unit_or_1(self) -> mi.Float:
        return dr.opaque(mi.Float, self.unit or 1.0)

    def settle(self, fineness: float) -> None:
        """Rebuilds what is known from all records so far; from here on cells have this ``fineness``."""
        self.fineness = fineness
        cells = int(dr.count(self.keys != 0)[0])
        if cells > _FULL * CELLS and not self.full:
            self.full = True
            what = "light that comes to other places is found by single paths; --unbiased does without the cache"
            _LOG.warning("the cache of tails is full (%d cells): %s", cells, what)
        cell, unit = dr.arange(mi.UInt32, CELLS), self._unit_or_1()
        counts = [dr.gather(mi.UInt32, self.count, cell + half * CELLS) for half in range(HALVES)]
        trusted = (counts[0] >= LEAST) & (counts[1] >= LEAST) & ~self.torn(fineness)
        # Old values go first, to make room for the new ones.
        self.known.means.clear()
        self.known.differences.clear()
        means, differences = ([dr.zeros(mi.Float, 4 * CELLS) for _ in range(len(self.sums) // 3)] for _ in range(2))
        for sort in range(len(means)):
            sums = self.sums[3 * sort : 3 * sort + 3]
            a, b = (
                [
                    mi.Float(dr.gather(mi.Int64, each, cell + half * CELLS)) * unit / dr.maximum(counts[half], 1)
                    for each in sums
                ]
                for half in range(HALVES)
            )
            mean = [0.5 * (x + y) for x, y in zip(a, b, strict=True)]
            difference = [0.5 * (x - y) for x, y in zip(a, b, strict=True)]
            dr.scatter(means[sort], mi.Vector4f(*mean, dr.select(trusted, mi.Float(1), 0)), cell)
            dr.scatter(differences[sort], mi.Vector4f(*difference, 0), cell)
        corner = self.known.corner
        self.known = Known(mi.UInt32(self.keys), means, differences, dr.opaque(mi.Float, fineness), corner)
        dr.eval(self.known.keys, means, differences)

    def torn(self, fineness: float) -> mi.Bool:
        """Which cells have other light in one part than in the other. Finer cells are judged more strictly, as their
        light may differ less: so the light that passes through walls vanishes with the size of cells."""
        torn = mi.Bool(False)
        (n, *n_upper), (light, *light_upper) = ([mi.Float(each) for each in part] for part in self.parts)
        most = dr.opaque(mi.Float, TORN * FINENESS / fineness)
        for n1, light1 in zip(n_upper, light_upper, strict=True):
            n0, both = n - n1, (n1 >= _ENOUGH) & (n - n1 >= _ENOUGH)
            mean1, mean0 = (dr.select(both, a / b / _PARTS, 0) for a, b in ((light1, n1), (light - light1, n0)))
            # What lies in [0, 1] has no more variance than that of such a mean where it is 0 or 1.
            variance = mean1 * (1 - mean1) / n1 + mean0 * (1 - mean0) / n0
            difference = dr.abs(mean1 - mean0)
            torn |= both & (difference > most * (mean1 + mean0)) & (difference > _CERTAIN * dr.sqrt(variance))
        return torn


def in_table(
    keys: mi.UInt32, h: mi.UInt32, name: mi.UInt32, active: mi.Bool, *, fill: bool = False
) -> tuple[mi.UInt32, mi.Bool]:
    """The places of cells in a table, and which are there; ``fill``: cells that are not there are made.

    All places from ``h`` on up to the first empty one are searched.
    """
    last, lanes = dr.width(keys) - 1, dr.width(h)

    def body(i, open, slot, found):
        at = (h + i) & last
        if fill:
            there, made = dr.scatter_cas(keys, mi.UInt32(0), name, at, open)
            hit, empty = open & (made | (there == name)), mi.Bool(False)
        else:
            there = dr.gather(mi.UInt32, keys, at, open)
            hit, empty = open & (there == name), there == 0
        return i + 1, open & ~hit & ~empty & (i < _PLACES - 1), dr.select(hit, at, slot), found | hit

    state = (mi.UInt32(0), mi.Bool(active), mi.UInt32(0), dr.full(mi.Bool, False, lanes))
    how = {"label": "find cells", "mode": "symbolic"}
    _, _, slot, found = dr.while_loop(state, lambda i, open, slot, found: open, body, **how)
    return slot, found


def joined(parts: Iterable[Any]) -> Any:
    """Arrays one behind the other. ``dr.concat`` compiles their widths into its kernels, which are others each time."""
    parts = list(parts)
    whole, begin = dr.empty(type(parts[0]), sum(map(dr.width, parts))), 0
    for part in parts:
        dr.scatter(whole, part, dr.arange(mi.UInt32, dr.width(part)) + dr.opaque(mi.UInt32, begin))
        begin += dr.width(part)
    return whole
