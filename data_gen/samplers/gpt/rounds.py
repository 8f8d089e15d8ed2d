"""Passes of samples whose paths may end in a cache of light (``data_gen.tails``).

Samples are taken in rounds. Between two rounds, other paths feed the cache: they add records of the light that they
find.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from data_gen.film import GradientFilm
from data_gen.passes import Rounds, SamplePass, recording
from data_gen.paths.camera import CameraSamples
from data_gen.paths.frozen import Frozen
from data_gen.samplers.gpt.plan import Plan
from data_gen.samplers.gpt.tails import feed
from data_gen.tails import cache as tails
from data_gen.tails import feeding
from data_gen.tails.cache import Cache, Known, joined
from data_gen.tails.schedule import end_of_round, fineness, first_sample
from data_gen.tails.table import CellGrid, CellPlace
from ngpt.shared import CUT, TAILS

# The least number of paths that feed the cache before its first round
FEWEST = 1 << 13

# Gives paths that feed the cache their own random numbers ("TAILS" in ASCII)
_SEED = 0x5441494C53
# The most paths that feed the cache at once. Then the cache checks again whether there is room for new cells.
_AT_ONCE = 1 << 18
# The paths that feed the cache before its first round come in two parts. Paths of the second part may end in cells that
# the first part has filled. This is the share of the first part.
_FIRST_PART = 1 / 4
# If fewer than this share of the first paths pass a vertex where paths may end, the cache is turned off, since it would
# cost more than it gains. Measured shares: .74 to 1 in rooms, .04 to .39 outdoors and in product shots.
_PAYS = 0.5

Take = Callable[[Known | None, CameraSamples, GradientFilm], None]


def sharing(view, plan: Plan, frozen: Frozen, take: Take) -> SamplePass:
    """Returns a pass that calls ``take``. Its paths share a cache if the ``plan`` says so."""
    return SharedTails(view, plan, frozen, take) if plan.matt else partial(take, None)


class SharedTails(Rounds):
    """A ``data_gen.passes.SamplePass`` whose paths may end in a cache. The cache changes only between rounds.

    ``take`` puts samples into a film. Its first argument is what the cache knows, or None without a cache. ``view`` is
    the integrator. ``cache`` is None before the first round, and if the cache is turned off. ``off`` says why the cache
    is turned off; "" if it is not.
    """

    def __init__(self, view, plan: Plan, frozen: Frozen, take: Take):
        self.frozen, self.take = frozen, take
        # ``paths`` is not a method of this object, because ``frozen`` keeps the functions that it calls: a method would
        # refer back to this object, and form a cycle.
        self.plan, self.paths = plan, partial(paths, view, plan)
        self.cache: Cache | None = None
        self.off, self.fed, self.pixels, self.until, self.share = "", 0, 1, 0, feeding.BEGIN

    def __call__(self, camera: CameraSamples, film: GradientFilm) -> None:
        self.take(self.cache.known if self.cache else None, camera, film)

    @property
    def shares(self) -> bool:
        return self.cache is not None

    @property
    def said(self) -> dict[str, Any]:
        if self.cache is None:
            return {TAILS: f"off: {self.off or 'there are few paths'}"}
        return {TAILS: "on", CUT: self.cache.cut / max(self.cache.light, 1)}

    def end_of_round(self, sample: int) -> int | None:
        return None if self.off else self.until

    def begin(self, sensor: mi.Sensor, seed: int, sample: int, film: GradientFilm) -> None:
        """Feeds the cache for all rounds that have begun by this ``sample``, one after the other."""
        seed = seed if self.seed is None else self.seed
        if sample == 0:
            self.pixels = int(dr.prod(mi.ScalarVector2u(sensor.film().crop_size())))
            self.off = "" if self.plan.matt.any else "no material has a diffuse part"
            self.cache, self.fed, self.until, self.share = None, 0, first_sample(self.pixels), feeding.BEGIN
        while not self.off and sample >= self.until:
            before, self.until = self.until, end_of_round(self.until, self.pixels)
            self.share = feeding.share(film, self.fed / self.pixels) or self.share
            more = round(self.share * (self.until - before) * self.pixels)
            self.next_round(sensor, seed, max(self.fed + more, FEWEST), fineness(self.until * self.pixels))

    def next_round(self, sensor: mi.Sensor, seed: int, wanted: int, size: float) -> None:
        """Feeds the cache until ``wanted`` paths in all have fed it. ``size`` is the fineness of its cells."""
        parts = [wanted]
        if self.cache is None:
            parts = [round(_FIRST_PART * wanted), wanted]
            # If there is a layer ``caustic``, the cache keeps its light apart, as a second sort of light.
            self.cache = Cache(size, 2 if self.plan.caustic else 1, grid(sensor, seed))
        for part in parts:
            self.cache.fade()
            while self.fed < part:
                first = self.fed == 0
                with recording():
                    able = self.feed(sensor, seed, min(part - self.fed, _AT_ONCE))
                if first and able < _PAYS:
                    self.off, self.cache = f"only {able:.0%} of the paths pass a vertex where they may end", None
                    return
                self.cache.settle(size)

    def feed(self, sensor: mi.Sensor, seed: int, n: int) -> float:
        """Lets ``n`` paths feed the cache. Returns the share of them that pass a vertex where paths may end."""
        # The paths are spread over the image row by row, since neighbouring rays trace faster.
        number = np.arange(n, dtype=np.int64)
        some, first = number * self.pixels // n, self.fed + number % -(-n // self.pixels)
        camera = CameraSamples(sensor, seed ^ _SEED, 1, mi.UInt32(first), 1, mi.UInt32(some))
        half = mi.UInt32(number % tails.HALVES)
        count, records = self.frozen(self.paths, self.cache.known, camera.look((0, 0)), half)
        self.fed += n
        lanes = [dr.compress(count > i) for i in range(len(records))]
        there = [(which, record) for which, record in zip(lanes, records, strict=True) if dr.width(which)]
        if there:
            # One call adds all records: separate kernels for first, second and third records would take longer to
            # launch than to run.
            fields = zip(*([dr.gather(type(v), v, which) for v in record] for which, record in there), strict=True)
            x, y, z, code, level, halves, *values = map(joined, fields)
            self.cache.add(CellPlace(mi.Point3f(x, y, z), code, level), halves, values)
        return dr.width(lanes[0]) / n


def paths(view, plan: Plan, known: Known, camera: CameraSamples, half: mi.UInt32) -> tuple[mi.UInt32, list[list]]:
    """Returns the number of records of each path, and the records as lists of fields: the place, the half of the cache,
    and the RGB of each sort of light.
    """
    ray, importance, _ = camera.rays()
    within = plan.space.around(camera.sensor)
    count, records = feed(view, plan, known, camera.random.clone(), (ray, importance, within), half)
    colours = ([each for E in r.E for each in mi.Color3f(E)] for r in records)
    return count, [
        [*r.place.p, r.place.code, r.place.level, half, *its] for r, its in zip(records, colours, strict=True)
    ]


def grid(sensor: mi.Sensor, seed: int) -> CellGrid:
    """Returns the grid of cells around a camera. The grid is shifted differently for each seed, so that no wall lies on
    the border of cells for all seeds.
    """
    origin = np.array(sensor.world_transform().translation(), np.float64).ravel()
    return CellGrid.at(origin, np.random.default_rng([seed, _SEED]).random(3))
