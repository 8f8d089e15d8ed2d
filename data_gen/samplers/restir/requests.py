"""E of some of many requests: of as few as there are, in one kernel."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from data_gen.samplers.restir.evaluate import Shifted
from data_gen.samplers.restir.record import Record, gather

# From lanes and the number of the end, 0 or 1: which record, at what place on the film, and whether there is one
Request = Callable[["mi.UInt32", "mi.UInt32"], "tuple[mi.UInt32, mi.Point2f, mi.Bool]"]
_NONE = 0xFFFFFFFF


@dataclass
class Requests:
    """E of some of many ``lanes``, each at one place or, the second half, at two."""

    slot: mi.UInt32
    count: mi.UInt32
    shifted: Shifted

    def at(self, lane: mi.UInt32, active: bool | mi.Bool = True, end: int = 0) -> Shifted:
        """What is known of these lanes; 0 with a Jacobian of 1 where nothing was asked for."""
        slot = dr.gather(mi.UInt32, self.slot, dr.select(active, lane, 0))
        asked, slot = (slot != _NONE) & active, slot + (self.count if end else 0)
        f = dr.gather(mi.Spectrum, self.shifted.f, slot, asked)
        J, geometry = (dr.gather(mi.Float, v, slot, asked) for v in (self.shifted.J, self.shifted.geometry))
        return Shifted(f, dr.select(asked, J, 1), geometry)

    def part(self, lane: mi.UInt32, active: bool | mi.Bool = True, end: int = 0) -> mi.Spectrum:
        """f |J|."""
        shifted = self.at(lane, active, end)
        return shifted.f * shifted.J


def evaluate_some(
    evaluate: Callable[[Record, mi.Point2f, mi.Bool], Shifted],
    pool: Record,
    lanes: int,
    ends: int,
    active: mi.Bool,
    request: Request,
) -> Requests:
    """E, which is ``evaluate``, of the ``active`` ones of so many requests to records of the ``pool``."""
    slot = dr.full(mi.UInt32, _NONE, lanes)
    index = dr.compress(active)
    count = dr.width(index)
    if not count:
        none = dr.zeros(mi.Float, 1)
        return Requests(slot, mi.UInt32(0), Shifted(dr.zeros(mi.Spectrum, 1), none + 1, none))
    dr.scatter(slot, dr.arange(mi.UInt32, count), index)
    each = dr.opaque(mi.UInt32, count)
    number = dr.arange(mi.UInt32, count * ends)
    lane, end = dr.gather(mi.UInt32, index, number % each), number // each
    source, place, exists = request(lane, end)
    record = gather(pool, source, exists)
    shifted = evaluate(record, place, exists)
    dr.eval(slot, shifted)
    return Requests(slot, each, shifted)
