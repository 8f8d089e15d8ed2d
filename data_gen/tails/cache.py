"""The cache of light in which paths may end early. For each cell it stores the mean light that arrives there.

On surfaces the mean light is the irradiance over π, in media it is the mean radiance over all directions.

Cells are cubes. Cells of different size are separate, and so are cells for different directions of the surface normal.
The *spread* of a path at a vertex is the width of the bundle of similar paths that arrive there. A path reads cells
that are small compared to its spread. Each *smooth* event, which is a scattering event that is not specular (no Dirac
delta), adds to the spread:

    spread = Σ t / sqrt(p |cos θ|).

The sum is over the steps of the path that follow a smooth event. Here t is the length of the step, p is the density of
its direction, and θ is the angle at which it meets the next surface. (The squared spread is the area of the bundle's
footprint [Bekaert et al. 2003, "Custom path-space filtering"; Müller et al. 2021, "Real-time neural radiance caching
for path tracing"].)

Special paths feed the cache: they add *records*, samples of the light at a vertex, to its cells. Each record belongs to
one of two *halves*, which come from different paths. Paths that feed a half never read light of the other half. Paths
of the image read the mean of both halves. Half of the difference between the halves is a sample of the error of that
mean: both halves have the same distribution, so this sample has the same variance as the mean. The same holds for
covariances between cells, and for all sums of values that paths read. So a render can estimate the noise that its
pixels have in common, even where one record contributes to many pixels through other cells.

Sums are integers, so they do not depend on the order of additions. The image is rendered in rounds. Paths feed the
cache only between two rounds. ``Known``, which paths read, is recomputed from the sums then, and does not change during
a round.
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
from data_gen.tails.table import INSIDE, CellGrid, CellPlace, in_table, key, octahedral

# The size of the cache, and the least memory limit with which a render uses a cache; both in MiB
MIB, LEAST_MIB = 320, 640
# A path may end where its spread exceeds this fraction of the path's length up to its first smooth event.
NEAR = 1 / 8
HALVES = 2


@dataclass
class Trail:
    """How far a path has come: ``reach`` is its length up to the first smooth event, and ``spread`` its spread."""

    reach: mi.Float
    spread: mi.Float

    @classmethod
    def to(cls, first: mi.Float) -> Trail:
        """The trail of a path at its first vertex, at distance ``first`` from the camera."""
        return cls(mi.Float(first), dr.zeros(mi.Float, dr.width(first)))

    def on(self, x: mi.SurfaceInteraction3f, inside: mi.Bool, smooth: mi.Bool, p: mi.Float, active: mi.Bool) -> Trail:
        """The trail at the next vertex ``x``, after an event with density ``p``.

        ``smooth`` says whether the event was not specular. The trail does not change if there is no next vertex. At a
        vertex ``inside`` a medium the cosine is 1.
        """
        there = active & x.is_valid()
        cosine = dr.select(inside, 1, dr.abs(x.wi.z))
        wider = x.t * dr.rsqrt(dr.maximum(p * cosine, 1e-6))
        further = there & ~smooth & (self.spread == 0)
        return Trail(self.reach + dr.select(further, x.t, 0), self.spread + dr.select(there & smooth, wider, 0))


_LOG = logging.getLogger(f"ngpt.{__name__}")

# The number of slots in the table of cells, and the share of the slots that may be used
CELLS, _FULL = 1 << 20, 0.5
# A cell is trusted once each half has this number of records in it, whatever their values: see ``Cache``. A small
# number is enough: a cell with few records is also read by few paths, so its noise affects only a small part of the
# image.
LEAST = 4
# Paths that feed the cache may end only in cells with LEAST_TO_FEED records in each half. Even in these cells, a path
# goes on with probability RENEW, and adds another record. Without this, cells that many paths read would never get more
# records, and would keep the noise of the first records.
LEAST_TO_FEED, RENEW = 16, 0.25
# Paths do not end in a *torn* cell, whose parts receive different light. A cell is torn if, along some axis, both
# halves of its volume have _ENOUGH records, and their light differs by more than TORN times its sum and by more than
# _CERTAIN standard errors. TORN is for the initial cell size; the threshold shrinks as cells get finer.
TORN, _CERTAIN, _ENOUGH = 0.2, 2.5, 3
# For this test, the light of each record is mapped to [0, 1] and stored as an integer in units of 1 / _PARTS.
_PARTS = 4095
# The weight of a new record, as an integer that can be halved several times: see ``fade``
_WHOLE = 256
# The light of a record is limited to MOST times the mean light of all records so far, or to 1 / PARTS of the sum of
# their light if that is more. Without this limit, a single bright path would leave a spot that no denoiser removes.
MOST, PARTS = 3000, 200
# Sums are integers in a unit of light. The unit is chosen so that the brightest of the first records has about 2^_BITS
# units. No record has more than 2^_MOST_BITS units.
_BITS, _MOST_BITS = 24, 40


@dataclass
class Known:
    """The light that paths read. ``means`` and ``differences`` have one array for each sort of light (see ``Cache``).

    An array holds four numbers for each cell:

    ``means``        the mean of the two halves, RGB; then the number of records in the half that has fewer records
    ``differences``  half of the difference between the two halves, RGB; then the sum of 1 if the first half's records
                     say that the cell is torn, and 2 if the second half's records say so
    """

    keys: mi.UInt32
    means: list[mi.Float]
    differences: list[mi.Float]
    fineness: mi.Float
    grid: CellGrid

    def place_of(
        self, x: mi.SurfaceInteraction3f, inside: mi.Bool, spread: mi.Float, kind: mi.UInt32 | int
    ) -> CellPlace:
        """The place of vertex ``x`` among the cells whose edge is at most ``spread`` / ``fineness``.

        Vertices ``inside`` media share no cells with vertices on surfaces. Vertices of different ``kind`` share no
        cells with each other.
        """
        level = mi.Int32(dr.floor(dr.log2(dr.maximum(spread / self.fineness, 1e-20))))
        normal = dr.select(inside, mi.UInt32(INSIDE), octahedral(mi.Normal3f(dr.mulsign(x.sh_frame.n, x.wi.z))))
        return CellPlace(self.grid.place_of(x.p, level), normal + (mi.UInt32(kind) << 16), level)

    def look(
        self, place: CellPlace, least: int, active: mi.Bool, half: mi.UInt32 | None = None
    ) -> tuple[list[mi.Color3f], list[mi.Color3f], mi.Bool]:
        """The light of each sort at a place, a sample of its error, and whether the light is known.

        The light is known if each half has ``least`` records in the cell, and the cell is not torn. Paths that feed a
        ``half`` read the light of that half. All other paths (None) read the mean of both halves.

        The records of one half decide only whether the light of the *other* half may be read. If a half judged itself,
        finding rare light in one part of a cell would make it call the cell torn. The light would then be discarded
        just where it was found, which is a bias. If only half A calls a cell torn, half A's light may still be read,
        because half B allows it; half B's light may not. A path of the image then reads A's light in half of the cases,
        chosen by a hash of the position, and in the other half continues without ending.
        """
        h, name, _ = key(place)
        slot, found = in_table(self.keys, h, name, active)
        means, differences = (
            [dr.gather(mi.Vector4f, each, slot, found) for each in flat] for flat in (self.means, self.differences)
        )
        torn = mi.UInt32(differences[0].w)
        known = found & (means[0].w >= least) & (torn < 3)
        mean, error = ([mi.Color3f(v.x, v.y, v.z) for v in each] for each in (means, differences))
        if half is None:
            # If one half calls the cell torn, the path ends in half of the cases: a hash of the position decides.
            known &= (torn == 0) | (mixed(dr.reinterpret_array(mi.UInt32, place.p.x)) & 1 == 0)
            which = torn
        else:
            # The other half decides whether the cell is torn.
            known &= (torn >> (1 - half)) & 1 == 0
            which = half + 1
        sign = dr.select(which == 0, mi.Float(0), dr.select(which == 1, 1, -1))
        light = [m + sign * e for m, e in zip(mean, error, strict=True)]
        return light, [dr.select(which == 0, e, 0) for e in error], known


class Cache:
    """For each cell, the sums of light of each sort. ``known`` holds the means, which paths may read.

    ``sorts`` is the number of sorts: two if the light of the layer ``caustic`` is stored separately, and otherwise one.

    Whether a cell is trusted depends on the number of its records, and not on their light. Where light is rare, a cell
    that has found some of the light looks uncertain, and a cell that has missed the light looks certain. Trusting only
    the certain cells would lose light: see docs/samplers/tails.md. A *torn* cell is not trusted either: its two parts
    along an axis receive different light, for example because a wall goes through the cell. Paths do not end in torn
    cells.
    """

    def __init__(self, fineness: float, sorts: int = 1, grid: CellGrid | None = None):
        self.keys = dr.zeros(mi.UInt32, CELLS)
        # For each half and cell: the sum of the weights of its records, and the weighted sums of their light
        self.weight = dr.zeros(mi.UInt32, HALVES * CELLS)
        self.sums = [dr.zeros(mi.Int64, HALVES * CELLS) for _ in range(3 * sorts)]
        # For each half and cell: the number of records, the sum of their light, and the sum of its squares, both in
        # units of 1 / _PARTS. Each list holds the values for all records, and for the records in the upper part of the
        # cell along x, y and z.
        self.parts = [[dr.zeros(mi.UInt32, HALVES * CELLS) for _ in range(4)] for _ in range(3)]
        self.unit, self.full = 0.0, False
        # For all records so far: their number, the sum of their light (the largest channel of each record, in units),
        # and how much of this light was cut off
        self.records = self.light = self.cut = 0
        means, differences = ([dr.zeros(mi.Float, 4 * CELLS) for _ in range(sorts)] for _ in range(2))
        grid = grid or CellGrid.at()
        self.known = Known(self.keys, means, differences, dr.opaque(mi.Float, fineness), grid)
        dr.make_opaque(self.keys, self.weight, self.sums, self.parts, means, differences)

    def add(self, place: CellPlace, half: mi.UInt32, values: list[mi.Float]) -> None:
        """Adds records to their cells.

        ``values`` are R, G and B of each sort of light, and may be below 0. ``half`` is 0 or 1.
        """
        largest = reduce(dr.maximum, map(dr.abs, values))
        good = dr.isfinite(sum(values))
        if not self.unit:
            first = dr.max(dr.select(good, largest, 0))[0]
            if first > 0:
                # The exponent is at least -126, because a smaller number may have no inverse in float32.
                self.unit = 2.0 ** max(math.ceil(math.log2(first)) - _BITS, -126)
        # The number is opaque: as a literal it would be compiled into the kernel, so every scene would need a new one.
        scale = dr.opaque(mi.Float, 1 / self.unit if self.unit else 0)
        brightest = dr.select(good, dr.minimum(largest * scale, 2.0**_MOST_BITS), 0)
        self.records += int(dr.count(good)[0])
        self.light += int(dr.sum(mi.Int64(brightest + 0.5))[0])
        mean = dr.opaque(mi.Float, self.light / max(self.records, 1))
        most = mean * dr.opaque(mi.Float, max(MOST, self.records / PARTS))
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
        dr.scatter_add(self.weight, mi.UInt32(_WHOLE), of_half, placed, **direct)
        # ``part`` is the light of a record divided by the sum of this light and the usual light: the light of its cell,
        # or the mean of all records if the light of the cell is not known. ``part`` is below 1, so a very bright record
        # counts little more than a bright one.
        here = [dr.gather(mi.Vector4f, each, slot, placed) for each in self.known.means]
        brightest_here = sum(dr.maximum(v.x, dr.maximum(v.y, v.z)) for v in here) / self._unit_or_1()
        usual = dr.maximum(dr.select(here[0].w > 0, brightest_here, mean), 1e-20)
        part = brightest / (brightest + usual)
        statistics = (mi.UInt32(1), mi.UInt32(_PARTS * part + 0.5), mi.UInt32(_PARTS * dr.square(part) + 0.5))
        for i, within in enumerate((True, *upper)):
            for each, value in zip(self.parts, statistics, strict=True):
                dr.scatter_add(each[i], value, of_half, placed & within, **direct)
        dr.eval(self.keys, self.weight, self.sums, self.parts)

    def fade(self) -> None:
        """Halves the weight of all records so far.

        It is called before further paths feed the cache. These paths may end in cells filled by the old records, so new
        records repeat the noise of the cells that their paths read. Let g be the share of the new records' light that
        comes from these cells, and let the number of records double in each round. With equal weights, a round would
        multiply the noise of the old records by (1 + g) / 2. Where light is rare, g is large, and this factor is above
        sqrt(1/2), the factor for independent records. With half the weight the factor is (1 + 2 g) / 3, which is
        smaller. In exchange, the records' independent noise is 13 % higher than with equal weights. No weight is halved
        to less than that of ``LEAST`` records, so that old records are not forgotten.
        """
        much = self.weight >= 2 * LEAST * _WHOLE
        self.sums = [dr.select(much, each >> 1, each) for each in self.sums]
        self.weight = dr.select(much, self.weight >> 1, self.weight)
        dr.eval(self.sums, self.weight)

    def _unit_or_1(self) -> mi.Float:
        return dr.opaque(mi.Float, self.unit or 1.0)

    def settle(self, fineness: float) -> None:
        """Computes ``known`` from all records so far. From now on cells have this ``fineness``."""
        cells = int(dr.count(self.keys != 0)[0])
        if cells > _FULL * CELLS and not self.full:
            self.full = True
            what = "where it has no cell, paths go to their end, which takes longer; --unbiased turns the cache off"
            _LOG.warning("the light cache is full (%d cells): %s", cells, what)
        cell, unit = dr.arange(mi.UInt32, CELLS), self._unit_or_1()
        counts, weights = (
            [dr.gather(mi.UInt32, each, cell + half * CELLS) for half in range(HALVES)]
            for each in (self.parts[0][0], self.weight)
        )
        records, torn = mi.Float(dr.minimum(*counts)), self.torn(fineness)
        weights = [dr.maximum(mi.Float(each) / _WHOLE, 1) for each in weights]
        torn = dr.select(dr.gather(mi.Bool, torn, cell), mi.Float(1), 0) + dr.select(
            dr.gather(mi.Bool, torn, cell + CELLS), mi.Float(2), 0
        )
        # This frees the memory of the old values before the new values are made.
        self.known.means.clear()
        self.known.differences.clear()
        means, differences = ([dr.zeros(mi.Float, 4 * CELLS) for _ in range(len(self.sums) // 3)] for _ in range(2))
        for sort in range(len(means)):
            sums = self.sums[3 * sort : 3 * sort + 3]
            a, b = (
                [mi.Float(dr.gather(mi.Int64, each, cell + half * CELLS)) * unit / weights[half] for each in sums]
                for half in range(HALVES)
            )
            mean = [0.5 * (x + y) for x, y in zip(a, b, strict=True)]
            difference = [0.5 * (x - y) for x, y in zip(a, b, strict=True)]
            dr.scatter(means[sort], mi.Vector4f(*mean, records), cell)
            dr.scatter(differences[sort], mi.Vector4f(*difference, torn), cell)
        fineness = dr.opaque(mi.Float, fineness)
        self.known = Known(mi.UInt32(self.keys), means, differences, fineness, self.known.grid)
        dr.eval(self.known.keys, means, differences)

    def torn(self, fineness: float) -> mi.Bool:
        """For each half and cell: whether the half has found different light in two parts of the cell along an axis.

        The threshold falls as cells get finer. So the light that leaks through walls goes to zero as cells shrink.
        """
        torn = mi.Bool(False)
        whole, *uppers = ([mi.Float(each[i]) for each in self.parts] for i in range(4))
        most = dr.opaque(mi.Float, TORN * FINENESS / fineness)
        for upper in uppers:
            lower = [a - b for a, b in zip(whole, upper, strict=True)]
            (mean1, variance1), (mean0, variance0) = (_mean_and_variance(*part) for part in (upper, lower))
            difference = dr.abs(mean1 - mean0)
            certain = difference > _CERTAIN * dr.sqrt(variance1 + variance0)
            enough = dr.minimum(upper[0], lower[0]) >= _ENOUGH
            torn |= enough & certain & (difference > most * (mean1 + mean0))
        return torn


def _mean_and_variance(n: mi.Float, light: mi.Float, squares: mi.Float) -> tuple[mi.Float, mi.Float]:
    """The mean of n values and the variance of that mean.

    They are computed from the sums of the values and of their squares, both in units of 1 / _PARTS.
    """
    mean = light / dr.maximum(_PARTS * n, 1)
    # The variance of the values is at least that of rounding.
    spread = dr.maximum(squares / dr.maximum(_PARTS * n, 1) - dr.square(mean), 1 / _PARTS)
    return mean, spread / dr.maximum(n - 1, 1)


def joined(parts: Iterable[Any]) -> Any:
    """Concatenates arrays. ``dr.concat`` would compile the widths of the arrays into a new kernel each time."""
    parts = list(parts)
    whole, begin = dr.empty(type(parts[0]), sum(map(dr.width, parts))), 0
    for part in parts:
        dr.scatter(whole, part, dr.arange(mi.UInt32, dr.width(part)) + dr.opaque(mi.UInt32, begin))
        begin += dr.width(part)
    return whole
