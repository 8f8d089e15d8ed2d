"""Each reservoir keeps one of the paths that it is offered. Also: differences of the paths kept by pixels."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ngpt_studies.restir.evaluate import Requests
from ngpt_studies.restir.layout import STEPS, Layout, step
from ngpt_studies.restir.record import gather
from ngpt_studies.restir.reservoir import CORNERS, Reservoir, choose, difference, part, weigh, weight_of
from ngpt_studies.restir.walk import Candidate


@dataclass
class Evaluated:
    """All values of E that a frame needs; None where they are not needed."""

    partners: Requests | None = None
    here: Requests | None = None
    elsewhere: Requests | None = None
    there: Requests | None = None


@dataclass
class _Offer:
    """A path for a reservoir: value, resampling weight and side; the lane of its record; its new place and geometry."""

    value: mi.Spectrum
    weight: mi.Float
    side: mi.UInt32
    source: mi.UInt32
    place: mi.Point2f
    geometry: mi.Float


@dataclass
class Merging:
    """The offers to the reservoirs of a frame, and the choice among them."""

    at: Layout
    ends: int  # number of pixels that a value depends on
    found: Candidate  # of this frame
    kept: Reservoir | None  # of the frame before, carried into this frame's scene
    e: Evaluated

    def merged(self, u: mi.Float) -> Reservoir:
        """Chooses by random numbers ``u`` the path that each reservoir keeps, from this frame or the frame before."""
        lane = dr.arange(mi.UInt32, self.at.total)
        r, i = lane // self.at.n, lane % self.at.n
        domain, pixel = (r + 1) // 2, self.at.pixel(i)
        exists = self.at.on_film(pixel + step(domain))
        offers = [self._candidate(r, i, mi.UInt32(side)) for side in range(self.ends)]
        candidates = len(offers)
        if self.kept is not None:
            offers += [self._history(r, lane * len(CORNERS) + k) for k in range(len(CORNERS))]
        chosen, total = choose([dr.select(exists, offer.weight, 0) for offer in offers], u)
        best = offers[0]
        for k, offer in enumerate(offers[1:], 1):
            best = dr.select(chosen == k, offer, best)
        record = gather(self.found.record, dr.select(chosen < candidates, best.source, 0))
        if self.kept is not None:
            old = chosen >= candidates
            history = gather(self.kept.record, best.source, old).moved(best.place, best.geometry)
            record = dr.select(old, history, record)
        return Reservoir(record, best.side, best.value, weight_of(total, best.value))

    def _candidate(self, r: mi.UInt32, i: mi.UInt32, side: mi.UInt32) -> _Offer:
        """The offer of a pixel's candidate; for a pair, of the candidate of one ``side``."""
        found, e = self.found, self.e
        domain, pixel = (r + 1) // 2, self.at.pixel(i)
        at = pixel + step(domain) * mi.Int32(side)
        active = self.at.on_film(at) & ((side == 0) | (domain > 0))
        source = dr.select(active, self.at.lane(at, i % self.at.chains), 0)
        f, W = dr.gather(mi.Spectrum, found.f, source, active), dr.gather(mi.Float, found.W, source, active)
        other = mi.Spectrum(0)
        if e.partners is not None:
            other = e.partners.part((2 * domain - 2 + side) * self.at.n + source, domain > 0)
        value = _value(r, f, other, side)
        target, others = mi.luminance(value), mi.Float(0)
        if e.there is not None:
            entry = dr.select(domain > 0, 2 * domain - 1 + side, 0) * self.at.n + source
            place = dr.gather(mi.Point2f, found.record.place, source)
            for wrapped in (False, True):
                _, before, there = self.at.before(domain, pixel, side, place, mi.Bool(wrapped))
                lane = entry + (self.at.all if wrapped else 0)
                density = mi.luminance(_value(r, e.there.part(lane), e.there.part(lane, domain > 0, 1), side))
                others += dr.select(there, self.at.confidence(domain, before), 0) * density
        weight = dr.select(active, weigh(target, others, target, W)[1], 0)
        return _Offer(value, weight, side, source, dr.gather(mi.Point2f, found.record.place, source), mi.Float(0))

    def _history(self, r: mi.UInt32, lane: mi.UInt32) -> _Offer:
        """The offer of a reservoir of the frame before."""
        kept, e = self.kept, self.e
        it = self.at.corner(lane, kept)
        own, partner = e.here.at(lane), e.here.part(lane, it.domain > 0, 1)
        # In the measure of the path's own pixel
        value = _value(r, own.f, partner / own.J, it.side)
        value = dr.select(dr.all(dr.isfinite(value)), value, 0)
        target = mi.luminance(value) * own.J
        was = mi.luminance(dr.gather(mi.Spectrum, kept.value, it.source))
        other = mi.luminance(_value(r, e.elsewhere.part(lane), e.elsewhere.part(lane, it.domain > 0, 1), it.side))
        others = target + dr.select(it.twice, self.at.confidence(it.domain, it.other), 0) * other
        W = dr.gather(mi.Float, kept.W, it.source)
        _, weight = weigh(self.at.confidence(it.domain, it.before) * was, others, target, W)
        return _Offer(value, dr.select(it.good, weight, 0), it.side, it.source, it.place, own.geometry)


def differences(at: Layout, kept: Reservoir, partners: Requests) -> tuple[mi.Spectrum, mi.Spectrum]:
    """dx and dy of the paths that pixels have kept. A path from either side of a pair is weighted by MIS.

    ``partners``: E of these paths in the neighbours of their pixels.
    """
    i = dr.arange(mi.UInt32, at.lanes)
    pixel, chain = at.pixel(i), i % at.chains
    found = []
    for domain, (x, y) in enumerate(list(STEPS.values())[1:]):
        step = mi.Point2i(x, y)
        exists = at.on_film(pixel + step)
        total = mi.Spectrum(0)
        for side in (0, 1):
            lane = dr.select(exists, at.lane(pixel + step, chain), 0) if side else i
            f, W = dr.gather(mi.Spectrum, kept.value, lane, exists), dr.gather(mi.Float, kept.W, lane, exists)
            other = partners.part(dr.opaque(mi.UInt32, (2 * domain + side) * at.lanes) + lane)
            total += dr.select(exists & (W > 0), _pair(f, other, mi.UInt32(side)) * W, 0)
        found.append(total)
    return found[0], found[1]


def _pair(own: mi.Spectrum, other: mi.Spectrum, side: mi.UInt32) -> mi.Spectrum:
    first = side == 0
    return difference(dr.select(first, own, other), dr.select(first, other, own), side)


def _value(r: mi.UInt32, own: mi.Spectrum, other: mi.Spectrum, side: mi.UInt32) -> mi.Spectrum:
    """The value for reservoir ``r``: light, or one sign of a difference. ``own``, ``other``: f in both pixels."""
    sign = dr.select(r % 2 == 1, mi.Float(1), -1)
    return dr.select(r == 0, own, part(_pair(own, other, side), sign))
