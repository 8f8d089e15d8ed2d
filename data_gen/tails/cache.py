"""The cache: for each cell the sum of the light that paths have found there, divided by the reflectance.

Sums are integers, so that they do not depend on the order of additions. What paths read, ``Known``, is made of them
between two rounds: within a round nothing changes. Cells are cubes in space, apart by their size and by the side and
direction of the surface. A cell is small against the *spread* of a path at the vertex where the path looks it up: the
width of the bundle of paths that arrive there, over which the light of the cell is blurred. Smooth events add to it,

    spread = Σ t / sqrt(p |cos θ|),

for steps of length t whose direction has density p and meets the surface at θ [the same area: Bekaert et al. 2003,
"Custom path-space filtering"; Müller et al. 2021, "Real-time neural radiance caching for path tracing"].
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

# Paths that feed the cache, for each sample of the image
SHARE = 1 / 8
# Such paths of the first round at least, however small the image is; and paths of a render for which that is little
FEWEST = 1 << 13
LEAST_PATHS = 8 * FEWEST
# MiB that the cache takes, and of those a render may use, what makes this little
MIB, LEAST_MIB = 160, 512
# Samples of the first round; each further one has as many as there are before it.
FIRST = 8
# The fineness of cells: how many times smaller they are than the spread of a path. It grows slowly with the samples, so
# that bias vanishes with noise.
FINENESS, _RATE = 16.0, 1 / 6
# A path may end where its spread has reached this share of its way to the first rough surface.
NEAR = 1 / 8


def enough(pixels: int, spp: int | None) -> bool:
    """Whether a render of so many pixels has paths enough for a cache; without ``spp``, by the first round."""
    return pixels * (spp or FIRST) >= LEAST_PATHS


def end_of_round(sample: int) -> int:
    """The number of the first sample that is in a later round than ``sample``."""
    return FIRST if sample < FIRST else 1 << sample.bit_length()


def fineness(sample: int) -> float:
    """The fineness of cells in the round that this ``sample`` is in."""
    return FINENESS * max(1.0, end_of_round(sample) / 128) ** _RATE


# Directions along an axis of the octahedral map, where the fineness is the least
_DIRECTIONS = 8
# A corner of cells of all sizes, as each lies within one of twice the side: not at a round coordinate, where walls are.
_CORNER = 0.3713


@dataclass
class Place:
    """A vertex as the cache knows it."""

    p: mi.Point3f
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


def place_of(
    x: mi.SurfaceInteraction3f, spread: mi.Float, fineness: mi.Float, kind: mi.UInt32 | int, gloss: mi.Bool
) -> Place:
    """Where vertex ``x`` lies among the cells that are ``fineness`` times smaller than the ``spread``.

    ``kind`` tells vertices apart that have no light in common. Where ``gloss`` counts, light is another one in each
    direction, and cells are apart by that.
    """
    level = mi.Int32(dr.floor(dr.log2(dr.maximum(spread / fineness, 1e-20))))
    normal = octahedral(mi.Normal3f(dr.mulsign(x.sh_frame.n, x.wi.z)), fineness)
    view = dr.select(gloss, mixed(octahedral(x.to_world(x.wi), fineness) + 1), 0)
    return Place(mi.Point3f(x.p), (normal + (mi.UInt32(kind) << 16)) ^ view, level)


def octahedral(n: mi.Vector3f, fineness: mi.Float) -> mi.UInt32:
    """The number of a direction's cell on the sphere. [Meyer et al. 2010, "On floating-point normal vectors"]"""
    side = _DIRECTIONS * dr.exp2(dr.floor(dr.log2(fineness / FINENESS)))
    s = dr.rcp(dr.abs(n.x) + dr.abs(n.y) + dr.abs(n.z))
    u, v = n.x * s, n.y * s
    folded = n.z < 0
    u, v = dr.select(folded, (1 - dr.abs(v)) * dr.sign(u), u), dr.select(folded, (1 - dr.abs(u)) * dr.sign(v), v)
    # Shifted a little, so that axes lie within cells and not between them.
    i, j = (mi.UInt32(dr.clip((w + 1) * 0.5 * side + 0.02, 0, side - 1)) for w in (u, v))
    return i + mi.UInt32(side) * j


def coarser(place: Place) -> Place:
    """The place of the same vertex among cells of twice the side."""
    return Place(place.p, place.code, place.level + 1)


def key(place: Place) -> tuple[mi.UInt32, mi.UInt32]:
    """Where in a table the cell may be looked for, and what it is known by there, which is never 0."""
    q = (place.p + _CORNER) * dr.exp2(mi.Float(-place.level))
    x, y, z = (mi.UInt32(mi.Int32(dr.floor(q[i]))) for i in range(3))
    code = place.code + (mi.UInt32(place.level) << 24)
    h = mixed(x + mixed(y + mixed(z + mixed(code + 0x1234567))))
    return h, mixed(h ^ (x * 0x9E3779B1 + y * 0x85EBCA6B + z * 0xC2B2AE35 + code * 0x27D4EB2F)) | 1


_LOG = logging.getLogger(f"ngpt.{__name__}")

# Cells that there is room for, and the share of them that may be taken
CELLS, _FULL = 1 << 20, 0.7
# Places beside each other in the table, in which a cell may be
_PLACES = 32
# Sizes of cells that a record goes into, each of twice the side of the one before
LEVELS = 2
# A cell is trusted once it has so many records, whatever they hold: see ``Cache``.
LEAST = 16
# A record may be so many times as bright as the mean of all so far, or have such a part of their light. What is
# brighter is cut: one path would make a spot that no denoiser removes.
MOST, PARTS = 3000, 200
# The light of the brightest record of the first round, and the brightest light that can be represented, in units of
# sums, both as powers of two
_BITS, _MOST_BITS = 30, 40


@dataclass
class Known:
    """What paths may read by cell: light over reflectance of each sort, RGB, and 1 where it is trusted, 0 where not."""

    keys: mi.UInt32
    values: list[mi.Float]
    fineness: mi.Float

    def look(self, place: Place, active: mi.Bool) -> tuple[list[mi.Color3f], mi.Bool]:
        """The light of each sort at a place, and whether it is trusted.

        The smallest trusted cell around the place has it.
        """
        values = self._of(place, active)
        for _ in range(LEVELS - 1):
            place, more = coarser(place), active & (values[0].w == 0)
            values = [dr.select(more, new, old) for new, old in zip(self._of(place, more), values, strict=True)]
        return [mi.Color3f(v.x, v.y, v.z) for v in values], active & (values[0].w > 0)

    def _of(self, place: Place, active: mi.Bool) -> list[mi.Vector4f]:
        slot, found = in_table(self.keys, *key(place), active)
        return [dr.gather(mi.Vector4f, each, slot, found) for each in self.values]


class Cache:
    """Growing sums by cell of so many ``sorts`` of light, and what is known of them.

    The number of a cell's records decides whether the cell is trusted, not the light in them. Where light is rare, a
    cell that has found some looks uncertain, and a cell that has missed it looks certain. Trusting only the certain
    cells would lose light: see docs/samplers/tails.md.
    """

    def __init__(self, fineness: float, sorts: int = 1):
        self.keys, self.count = dr.zeros(mi.UInt32, CELLS), dr.zeros(mi.UInt32, CELLS)
        self.sums = [dr.zeros(mi.Int64, CELLS) for _ in range(3 * sorts)]
        self.unit, self.full, self.fineness = 0.0, False, fineness
        # For all records so far: their number, and the sum of the light of the brightest colour of each, in units
        self.records = self.light = 0
        blank = [dr.zeros(mi.Float, 4 * CELLS) for _ in range(sorts)]
        self.known = Known(self.keys, blank, dr.opaque(mi.Float, fineness))
        dr.make_opaque(self.keys, self.count, self.sums, self.known.values)

    def add(self, place: Place, values: list[mi.Float]) -> None:
        """Adds records to their cells and to those around: ``values`` are RGB of each sort of light."""
        least, largest = (reduce(extreme, values) for extreme in (dr.minimum, dr.maximum))
        good = dr.isfinite(sum(values)) & (least >= 0)
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
        most = max(MOST, self.records / PARTS) * self.light / max(self.records, 1)
        scale = scale * dr.minimum(1, dr.opaque(mi.Float, most) / dr.maximum(brightest, 1))
        counts = [mi.Int64(dr.minimum(value * scale, 2.0**_MOST_BITS) + 0.5) for value in values]
        places = [place]
        for _ in range(LEVELS - 1):
            places.append(coarser(places[-1]))
        # All levels at once: fewer kernels
        h, name = (joined(parts) for parts in zip(*map(key, places), strict=True))
        record = dr.arange(mi.UInt32, dr.width(h)) % dr.opaque(mi.UInt32, dr.width(good))
        dr.eval(h, name, good, counts)
        slot, placed = in_table(self.keys, h, name, dr.gather(mi.Bool, good, record), fill=not self.full)
        dr.eval(slot, placed, self.keys)
        direct = {"mode": dr.ReduceMode.Direct}
        for each, count in zip(self.sums, counts, strict=True):
            dr.scatter_add(each, dr.gather(mi.Int64, count, record), slot, placed, **direct)
        dr.scatter_add(self.count, mi.UInt32(1), slot, placed, **direct)
        dr.eval(self.keys, self.count, self.sums)

    def settle(self, fineness: float) -> None:
        """Rebuilds what is known from all records so far; from here on cells have this ``fineness``."""
        self.fineness = fineness
        cells = int(dr.count(self.keys != 0)[0])
        if cells > _FULL * CELLS and not self.full:
            self.full = True
            what = "light that comes to other places is found by single paths; --unbiased does without the cache"
            _LOG.warning("the cache of tails is full (%d cells): %s", cells, what)
        each = dr.opaque(mi.Float, self.unit) / dr.maximum(self.count, 1)
        trusted = dr.select(self.count >= LEAST, mi.Float(1), 0)
        # Old values go first, to make room for the new ones.
        self.known.values.clear()
        values = [dr.zeros(mi.Float, 4 * CELLS) for _ in range(len(self.sums) // 3)]
        for sort, flat in enumerate(values):
            light = [each * mi.Float(of_cell) for of_cell in self.sums[3 * sort : 3 * sort + 3]]
            dr.scatter(flat, mi.Vector4f(*light, trusted), dr.arange(mi.UInt32, CELLS))
        self.known = Known(mi.UInt32(self.keys), values, dr.opaque(mi.Float, fineness))
        dr.eval(self.known.keys, values)


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
