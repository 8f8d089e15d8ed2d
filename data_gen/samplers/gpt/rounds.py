"""Passes whose paths end in a cache, which is fed between rounds of samples."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np

from data_gen.film import GradientFilm
from data_gen.passes import SamplePass, recording
from data_gen.paths.camera import CameraSamples
from data_gen.paths.frozen import Frozen
from data_gen.samplers.gpt.plan import Plan
from data_gen.samplers.gpt.tails import feed
from data_gen.tails import cache as tails
from data_gen.tails.cache import Cache, Known, Place, joined

# Paths that feed the cache have random numbers of their own: "TAILS".
_SEED = 0x5441494C53
# Paths that feed the cache together, so that there is room for their new cells
_AT_ONCE = 1 << 18
# The first round comes in two parts, since paths of the second may end in what paths of the first have found.
_FIRST_PART = 1 / 4
# Where fewer of the first paths come by a place to end than this share of them, none end: it would cost more than it
# gains.
_PAYS = 0.25

Take = Callable[[Known | None, CameraSamples, GradientFilm], None]


def sharing(view, plan: Plan, frozen: Frozen, take: Take) -> SamplePass:
    """The pass that ``take`` makes: of paths that share a cache where the ``plan`` says so, else of whole paths."""
    return SharedTails(view, plan, frozen, take) if plan.matt else partial(take, None)


class SharedTails:
    """A ``data_gen.passes.SamplePass`` whose paths may end in a cache. The cache changes only between rounds.

    ``take`` puts samples into a film, and is given what is known, or None where all paths go on by themselves. ``view``
    is the integrator. ``cache`` is None before the first pass, and where it does not pay.
    """

    def __init__(self, view, plan: Plan, frozen: Frozen, take: Take):
        self.frozen, self.take = frozen, take
        # No method of this object, which has ``frozen``: there must be no circle.
        self.plan, self.paths = plan, partial(paths, view, plan)
        self.cache: Cache | None = None
        self.fed = 0

    def __call__(self, camera: CameraSamples, film: GradientFilm) -> None:
        self.take(self.cache and self.cache.known, camera, film)

    @property
    def shares(self) -> bool:
        return self.cache is not None

    def end_of_round(self, sample: int) -> int | None:
        return tails.end_of_round(sample) if self.cache else None

    def begin(self, sensor: mi.Sensor, seed: int, sample: int, spp: int | None) -> None:
        """Feeds the cache if this ``sample`` begins a round."""
        if sample == 0:
            # The light of the layer ``caustic`` is kept apart, where there is such a layer.
            empty = Cache(tails.fineness(0), 2 if self.plan.caustic else 1) if self.plan.matt.any else None
            self.cache, self.fed = empty, 0
        if self.cache is None:
            return
        pixels = int(dr.prod(mi.ScalarVector2u(sensor.film().crop_size())))
        end = tails.end_of_round(sample) if spp is None else min(tails.end_of_round(sample), spp)
        wanted = max(round(tails.SHARE * end * pixels), tails.FEWEST)
        fineness = tails.fineness(sample)
        for part in (round(_FIRST_PART * wanted), wanted) if sample == 0 else (wanted,):
            while self.fed < part:
                first = self.fed == 0
                with recording():
                    able = self.feed(sensor, seed, pixels, min(part - self.fed, _AT_ONCE))
                if first and able < _PAYS:
                    self.cache = None
                    return
                self.cache.settle(fineness)
        if fineness != self.cache.fineness:
            self.cache.settle(fineness)

    def feed(self, sensor: mi.Sensor, seed: int, pixels: int, n: int) -> float:
        """Has so many paths feed the cache; returns the share of them that come by a place to end."""
        # Spread over the image, row by row: rays side by side are quick.
        number = np.arange(n, dtype=np.int64)
        some, first = number * pixels // n, self.fed + number % -(-n // pixels)
        camera = CameraSamples(sensor, seed ^ _SEED, 1, mi.UInt32(first), 1, mi.UInt32(some))
        count, records = self.frozen(self.paths, self.cache.known, camera.look((0, 0)))
        self.fed += n
        lanes = [dr.compress(count > i) for i in range(len(records))]
        there = [(which, record) for which, record in zip(lanes, records, strict=True) if dr.width(which)]
        if there:
            # One by one, the kernels that add them would take longer to begin than to run.
            fields = zip(*([dr.gather(type(v), v, which) for v in record] for which, record in there), strict=True)
            x, y, z, code, level, *values = map(joined, fields)
            self.cache.add(Place(mi.Point3f(x, y, z), code, level), values)
        return dr.width(lanes[0]) / n


def paths(view, plan: Plan, known: Known, camera: CameraSamples) -> tuple[mi.UInt32, list[list]]:
    """How many records each path has, and these: place, and light of each sort over reflectance, RGB."""
    ray, importance, _ = camera.rays()
    count, records = feed(view, plan, known, camera.random.clone(), (ray, importance))
    colours = ((each for L in r.L for each in mi.Color3f(L) / r.ρ) for r in records)
    return count, [[*r.place.p, r.place.code, r.place.level, *its] for r, its in zip(records, colours, strict=True)]
