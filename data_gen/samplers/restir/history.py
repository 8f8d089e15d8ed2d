r"""Reservoirs of all pixels, and of all pairs of neighbours, kept from frame to frame while the camera moves.

    for each frame
        a candidate for each pixel                                             ``walk``
        E   of each candidate in the four neighbours                           ``_partners``
        E   of what is kept, in this frame                                     ``_here``
        E   of each candidate, by the camera of the frame before               ``_there``
        of each reservoir, one path of all that is offered                     ``_merged``

There are five reservoirs for each pixel: of its own light, and of the difference to its right and to its lower
neighbour, one for each sign. Values that change sign have no density to choose by.

A pixel's paths are those of its whole area, and a path keeps its place on the film to a fraction of a pixel. With the
motion m of a pixel, paths that were at p in the frame before are now at p - m. So the pixel's area, moved by m, lies on
up to four pixels of the frame before. Each path of it was one of exactly one of these four. Two things can have found
a path, then: this frame's candidate, and that one reservoir. Their MIS weights sum to 1, whatever m is. Confidence is
handed on in proportion to the areas. [Zhang et al. 2024, "Area ReSTIR"; gradient-domain ReSTIR 2025, section 4.3.1]

That is unbiased as long as the camera alone moves, and motion depends on no random numbers. Lanes of ``chains`` of a
pixel know nothing of each other. One chain has no variance: its frames are correlated, over ``cap`` of them, and must
not be put into a film as if they were samples. Several have the variance over chains.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from data_gen.passes import recording
from data_gen.paths.camera import CameraSamples
from data_gen.samplers.gpt.plan import Plan
from data_gen.samplers.restir.evaluate import Shifted, evaluate_record
from data_gen.samplers.restir.events import check
from data_gen.samplers.restir.footprint import CORNERS, confidence_after, pair_motions
from data_gen.samplers.restir.pose import Pose
from data_gen.samplers.restir.record import Record, gather, select
from data_gen.samplers.restir.reservoir import Reservoir, choose, difference, part, weigh, weight_of
from data_gen.samplers.restir.walk import Candidate, choices, walk

# What reservoirs are of, and of pairs the step to the second pixel. Reservoirs are numbered in the order 0 primal,
# 1 dx+, 2 dx-, 3 dy+, 4 dy-.
STEPS = {"primal": (0, 0), "dx": (1, 0), "dy": (0, 1)}
RESERVOIRS = 5
_NONE = 0xFFFFFFFF
# Where what a pixel shows was not seen in the frame before
_NOWHERE = -1e6


@dataclass
class Frame:
    """Estimates of each lane of one frame; emission that the camera sees directly is in none of them.

    ``path``  what the candidates' walks found, without history
    """

    camera: CameraSamples
    path: mi.Spectrum
    primal: mi.Spectrum
    dx: mi.Spectrum
    dy: mi.Spectrum


@dataclass
class _Requests:
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


@dataclass
class _Evaluated:
    """E of all that a frame needs; None where it is not needed."""

    partners: _Requests | None = None
    here: _Requests | None = None
    elsewhere: _Requests | None = None
    there: _Requests | None = None


@dataclass
class _Kept:
    """A path of the frame before, for a reservoir that looks for it."""

    domain: mi.UInt32
    side: mi.UInt32
    before: mi.Point2i  # first pixel of the pair that it was kept for
    source: mi.UInt32  # lane of that reservoir
    place: mi.Point2f  # where the path is now
    good: mi.Bool
    other: mi.Point2i  # first pixel of the other pair that could have kept it,
    elsewhere: mi.Point2f  # at this place,
    twice: mi.Bool  # if there is one


@dataclass
class _Offer:
    """A path for a reservoir: its value there, resampling weight, side; lane of the record, and how that has moved."""

    value: mi.Spectrum
    weight: mi.Float
    side: mi.UInt32
    source: mi.UInt32
    place: mi.Point2f
    geometry: mi.Float


class History:
    """The reservoirs of a scene whose camera moves, frame after frame.

    Lanes are ordered pixel by pixel, within a pixel by chain. ``cap`` is the confidence that a reservoir can reach, in
    frames; 1: hardly any history. Without ``pairs``, differences have no reservoirs of their own: they are taken of the
    paths that the pixels' reservoirs have kept, the paper's baseline. Raises NgptError for what records cannot hold:
    see ``events.check``.
    """

    def __init__(
        self,
        scene: mi.Scene,
        plan: Plan,
        sensor: mi.Sensor,
        seed: int,
        chains: int = 1,
        cap: float = 32,
        pairs: bool = True,
    ):
        check(scene, plan)
        self.scene, self.plan, self.sensor, self.seed = scene, plan, sensor, seed
        self.chains, self.cap, self.pairs = chains, cap, pairs
        self.frames = 0
        self.kept: Reservoir | None = None
        self.pose: Pose | None = None
        width, height = (int(n) for n in sensor.film().crop_size())
        self.size = (width, height)
        self.confidence = np.zeros((len(STEPS), height, width), np.float32)

    def next_frame(self, motion: np.ndarray | None = None, depth: np.ndarray | None = None) -> Frame:
        """Renders a frame.

        ``motion`` (H, W, 2) is that of ``data_gen.frames.motion``, NaN where there is no history; None: nothing moves.
        ``depth`` (H, W) tells which pixel of a pair is the nearer one, whose motion is that of both.
        """
        width, height = self.size
        n = width * height * self.chains
        motions = pair_motions(np.zeros((height, width, 2)) if motion is None else motion, depth, STEPS.values())
        with recording():
            self._prepare(n, np.nan_to_num(motions, nan=_NOWHERE))
            camera = CameraSamples(self.sensor, self.seed, self.chains, self.frames * self.chains)
            sample = dr.opaque(mi.UInt32, self.frames * self.chains) + dr.arange(mi.UInt32, n) % self.chain_count
            choice = choices(self.seed, camera, sample)
            found = walk(self.scene, self.plan, camera, sample, choice)
            u = [choice.next_1d() for _ in range(self.reservoirs)]
            dr.eval(found, u)
            frame = self._resample(camera, found, dr.concat(u))
        self.confidence = confidence_after(self.confidence, motions, STEPS.values(), self.cap)
        self.pose = Pose(self.sensor)
        self.frames += 1
        return frame

    def _resample(self, camera: CameraSamples, found: Candidate, u: mi.Float) -> Frame:
        e = _Evaluated()
        if self.kept is not None:
            e.here = self._here(self.kept)
            with self.pose.of(self.sensor):
                e.elsewhere, e.there = self._elsewhere(self.kept), self._there(found)
        if self.pairs:
            e.partners = self._partners(found.record, found.W)
        kept = self._merged(found, self.kept, e, u)
        dr.eval(kept)
        self.kept = kept
        values = kept.estimate()
        n = self.lanes
        primal, *signs = (
            dr.gather(mi.Spectrum, values, dr.arange(mi.UInt32, n) + dr.opaque(mi.UInt32, r * n))
            for r in range(self.reservoirs)
        )
        if self.pairs:
            dx, dy = signs[0] - signs[1], signs[2] - signs[3]
        else:
            dx, dy = self._differences(kept)
        dr.eval(primal, dx, dy)
        return Frame(camera, found.L, primal, dx, dy)

    # ------------------------------ Where things are ------------------------------

    def _prepare(self, n: int, motions: np.ndarray) -> None:
        """What kernels read: opaque, since literals would be compiled into them, each anew."""
        self.lanes = n
        self.reservoirs, self.ends = (RESERVOIRS, 2) if self.pairs else (1, 1)
        self.total = n * self.reservoirs
        self.opaque_total = dr.opaque(mi.UInt32, self.total)
        self.n, self.chain_count = dr.opaque(mi.UInt32, n), dr.opaque(mi.UInt32, self.chains)
        self.width, self.height = (dr.opaque(mi.Int32, v) for v in self.size)
        self.area = dr.opaque(mi.UInt32, self.size[0] * self.size[1])
        self.motions = mi.Vector2f(
            *(mi.Float(np.ascontiguousarray(motions[..., a], np.float32).ravel()) for a in (0, 1))
        )
        self.confidences = mi.Float(self.confidence.ravel())

    def _pixel(self, lane: mi.UInt32) -> mi.Point2i:
        pixel = mi.Int32(lane // self.chain_count)
        return mi.Point2i(pixel % self.width, pixel // self.width)

    def _lane(self, pixel: mi.Point2i, chain: mi.UInt32) -> mi.UInt32:
        return mi.UInt32(pixel.x + pixel.y * self.width) * self.chain_count + chain

    def _on_film(self, pixel: mi.Point2i) -> mi.Bool:
        return (pixel.x >= 0) & (pixel.y >= 0) & (pixel.x < self.width) & (pixel.y < self.height)

    def _at(self, domain: mi.UInt32, pixel: mi.Point2i, active: mi.Bool) -> mi.UInt32:
        return domain * self.area + dr.select(active, mi.UInt32(pixel.x + pixel.y * self.width), 0)

    def _motion(self, domain: mi.UInt32, pixel: mi.Point2i, active: mi.Bool) -> mi.Vector2f:
        return dr.gather(mi.Vector2f, self.motions, self._at(domain, pixel, active), active)

    def _confidence(self, domain: mi.UInt32, pixel: mi.Point2i) -> mi.Float:
        """Of the frame before; 0 off the film, and of pairs that are not there."""
        there = self._on_film(pixel)
        return dr.gather(mi.Float, self.confidences, self._at(domain, pixel, there), there)

    # ------------------------------ E, of as few as there are ------------------------------

    def _evaluate(self, pool: Record, lanes: int, ends: int, active: mi.Bool, request: Callable) -> _Requests:
        """E of the ``active`` ones of so many requests.

        ``request`` of lanes and of the number of the end, 0 or 1: which record of the ``pool``, at what place on the
        film, and whether there is one.
        """
        slot = dr.full(mi.UInt32, _NONE, lanes)
        index = dr.compress(active)
        count = dr.width(index)
        if not count:
            none = dr.zeros(mi.Float, 1)
            return _Requests(slot, mi.UInt32(0), Shifted(dr.zeros(mi.Spectrum, 1), none + 1, none))
        dr.scatter(slot, dr.arange(mi.UInt32, count), index)
        each = dr.opaque(mi.UInt32, count)
        number = dr.arange(mi.UInt32, count * ends)
        lane, end = dr.gather(mi.UInt32, index, number % each), number // each
        source, place, exists = request(lane, end)
        record = gather(pool, source, exists)
        shifted = evaluate_record(self.scene, self.plan, self.sensor, self.seed, record, place, exists)
        dr.eval(slot, shifted)
        return _Requests(slot, each, shifted)

    def _partners(self, record: Record, W: mi.Float) -> _Requests:
        """Each path of a pixel in its right, left, lower and upper neighbour: requests of lane, of 4 n."""

        def place(lane: mi.UInt32) -> tuple[mi.UInt32, mi.Point2f]:
            i, pair = lane % self.n, lane // self.n
            return i, mi.Point2f(dr.gather(mi.Point2f, record.place, i) + _across(pair // 2 + 1, pair % 2))

        lane = dr.arange(mi.UInt32, 4 * self.lanes)
        i, where = place(lane)
        active = (dr.gather(mi.Float, W, i) > 0) & self._on_film(mi.Point2i(dr.floor(where)))
        return self._evaluate(record, 4 * self.lanes, 1, active, lambda lane, end: (*place(lane), mi.Bool(True)))

    def _nearest(self, pair: mi.Point2i, motion: mi.Vector2f) -> mi.Point2i:
        return mi.Point2i(dr.floor(mi.Point2f(pair) + motion + 0.5))

    def _corner(self, lane: mi.UInt32, kept: Reservoir) -> _Kept:
        """What reservoir ``lane`` // 4 finds at one of the corners of its area in the frame before."""
        job, corner = lane // len(CORNERS), lane % len(CORNERS)
        r, i = job // self.n, job % self.n
        domain, pixel = (r + 1) // 2, self._pixel(i)
        motion = self._motion(domain, pixel, mi.Bool(True))
        before = mi.Point2i(dr.floor(mi.Point2f(pixel) + motion))
        before += mi.Point2i(mi.Int32(corner % 2), mi.Int32(corner // 2))
        on_film, nearest = self._on_film(before), self._nearest(pixel, motion)
        source = r * self.n + dr.select(on_film, self._lane(before, i % self.chain_count), 0)
        side = dr.gather(mi.UInt32, kept.side, source)
        was = dr.gather(mi.Point2f, kept.record.place, source)
        step = _step(domain) * mi.Int32(side)
        at, straight = pixel + step, mi.Point2f(was - motion)
        stays = _same(mi.Point2i(dr.floor(straight)), at)
        place = dr.select(stays, straight, mi.Point2f(mi.Point2f(at) + _fraction(straight)))
        # Where else the path that it is now could have been
        far = mi.Point2f(place + motion)
        other = dr.select(stays, nearest, mi.Point2i(dr.floor(far)) - step)
        elsewhere = dr.select(stays, mi.Point2f(mi.Point2f(nearest + step) + _fraction(was)), far)
        good = on_film & (stays | _same(before, nearest)) & (dr.gather(mi.Float, kept.W, source) > 0)
        return _Kept(domain, side, before, source, place, good, other, elsewhere, good & ~_same(other, before))

    def _here(self, kept: Reservoir) -> _Requests:
        """Each path that was kept, where the pixels that look for it have it now: 4 requests for each reservoir."""

        def request(lane: mi.UInt32, end: mi.UInt32):
            it = self._corner(lane, kept)
            return it.source, it.place + mi.Float(end) * _across(it.domain, it.side), (end == 0) | (it.domain > 0)

        lanes = self.total * len(CORNERS)
        good = self._corner(dr.arange(mi.UInt32, lanes), kept).good
        return self._evaluate(kept.record, lanes, self.ends, good, request)

    def _elsewhere(self, kept: Reservoir) -> _Requests:
        """The same in the frame before, where else the path could have been."""

        def request(lane: mi.UInt32, end: mi.UInt32):
            it = self._corner(lane, kept)
            return it.source, it.elsewhere + mi.Float(end) * _across(it.domain, it.side), (end == 0) | (it.domain > 0)

        lanes = self.total * len(CORNERS)
        it = self._corner(dr.arange(mi.UInt32, lanes), kept)
        known = it.twice & (self._confidence(it.domain, it.other) > 0)
        return self._evaluate(kept.record, lanes, self.ends, known, request)

    def _before(self, domain: mi.UInt32, pair: mi.Point2i, side: mi.UInt32, place: mi.Point2f, wrapped: mi.Bool):
        """Where a path of this frame's ``pair`` could have been in the frame before: place, pair, and whether at all.

        Not ``wrapped``: straight along the motion. Else within the nearest pair, unless that is the same.
        """
        exists = self._on_film(pair)
        motion = self._motion(domain, pair, exists)
        step, nearest = _step(domain) * mi.Int32(side), self._nearest(pair, motion)
        far = mi.Point2f(place + motion)
        straight = mi.Point2i(dr.floor(far)) - step
        there = dr.select(wrapped, mi.Point2f(mi.Point2f(nearest + step) + _fraction(far)), far)
        before = dr.select(wrapped, nearest, straight)
        return there, before, exists & ~(wrapped & _same(nearest, straight))

    def _there(self, found: Candidate) -> _Requests:
        """Each candidate in the frame before: requests of lane, of primal, dx and dy as side 0 and 1; all that twice,
        straight and wrapped."""

        def where(lane: mi.UInt32):
            wrapped, e, i = lane >= self.opaque_total, (lane // self.n) % self.reservoirs, lane % self.n
            domain, side = (e + 1) // 2, dr.select(e == 0, 0, (e + 1) % 2)
            place = dr.gather(mi.Point2f, found.record.place, i)
            pair = self._pixel(i) - _step(domain) * mi.Int32(side)
            there, before, exists = self._before(domain, pair, side, place, wrapped)
            return domain, side, i, there, exists & (self._confidence(domain, before) > 0)

        def request(lane: mi.UInt32, end: mi.UInt32):
            domain, side, i, place, _ = where(lane)
            return i, place + mi.Float(end) * _across(domain, side), (end == 0) | (domain > 0)

        _, _, i, _, good = where(dr.arange(mi.UInt32, 2 * self.total))
        good &= dr.gather(mi.Float, found.W, i) > 0
        return self._evaluate(found.record, 2 * self.total, self.ends, good, request)

    # ------------------------------ What is kept ------------------------------

    def _merged(self, found: Candidate, kept: Reservoir | None, e: _Evaluated, u: mi.Float) -> Reservoir:
        """Of each reservoir the path that is kept, of this frame or of the one before."""
        lane = dr.arange(mi.UInt32, self.total)
        r, i = lane // self.n, lane % self.n
        domain, pixel = (r + 1) // 2, self._pixel(i)
        exists = self._on_film(pixel + _step(domain))
        offers = [self._candidate(found, e, r, i, mi.UInt32(side)) for side in range(self.ends)]
        candidates = len(offers)
        if kept is not None:
            offers += [self._history(kept, e, r, lane * len(CORNERS) + k) for k in range(len(CORNERS))]
        chosen, total = choose([dr.select(exists, offer.weight, 0) for offer in offers], u)
        best = offers[0]
        for k, offer in enumerate(offers[1:], 1):
            best = dr.select(chosen == k, offer, best)
        record = gather(found.record, dr.select(chosen < candidates, best.source, 0))
        if kept is not None:
            old = chosen >= candidates
            history = gather(kept.record, best.source, old).moved(best.place, best.geometry)
            record = select(old, history, record)
        return Reservoir(record, best.side, best.value, weight_of(total, best.value))

    def _candidate(self, found: Candidate, e: _Evaluated, r: mi.UInt32, i: mi.UInt32, side: mi.UInt32) -> _Offer:
        """What a pixel's candidate offers: of a pair that of either side."""
        domain, pixel = (r + 1) // 2, self._pixel(i)
        at = pixel + _step(domain) * mi.Int32(side)
        active = self._on_film(at) & ((side == 0) | (domain > 0))
        source = dr.select(active, self._lane(at, i % self.chain_count), 0)
        f, W = dr.gather(mi.Spectrum, found.f, source, active), dr.gather(mi.Float, found.W, source, active)
        other = mi.Spectrum(0)
        if e.partners is not None:
            other = e.partners.part((2 * domain - 2 + side) * self.n + source, domain > 0)
        value = _value(r, f, other, side)
        target, others = mi.luminance(value), mi.Float(0)
        if e.there is not None:
            entry = dr.select(domain > 0, 2 * domain - 1 + side, 0) * self.n + source
            place = dr.gather(mi.Point2f, found.record.place, source)
            for wrapped in (False, True):
                _, before, there = self._before(domain, pixel, side, place, mi.Bool(wrapped))
                lane = entry + (self.opaque_total if wrapped else 0)
                density = mi.luminance(_value(r, e.there.part(lane), e.there.part(lane, domain > 0, 1), side))
                others += dr.select(there, self._confidence(domain, before), 0) * density
        weight = dr.select(active, weigh(target, others, target, W)[1], 0)
        return _Offer(value, weight, side, source, dr.gather(mi.Point2f, found.record.place, source), mi.Float(0))

    def _history(self, kept: Reservoir, e: _Evaluated, r: mi.UInt32, lane: mi.UInt32) -> _Offer:
        """What a reservoir of the frame before offers."""
        it = self._corner(lane, kept)
        own, partner = e.here.at(lane), e.here.part(lane, it.domain > 0, 1)
        # In the measure of the pixel that the path is in
        value = _value(r, own.f, partner / own.J, it.side)
        value = dr.select(dr.all(dr.isfinite(value)), value, 0)
        target = mi.luminance(value) * own.J
        was = mi.luminance(dr.gather(mi.Spectrum, kept.value, it.source))
        other = mi.luminance(_value(r, e.elsewhere.part(lane), e.elsewhere.part(lane, it.domain > 0, 1), it.side))
        others = target + dr.select(it.twice, self._confidence(it.domain, it.other), 0) * other
        W = dr.gather(mi.Float, kept.W, it.source)
        _, weight = weigh(self._confidence(it.domain, it.before) * was, others, target, W)
        return _Offer(value, dr.select(it.good, weight, 0), it.side, it.source, it.place, own.geometry)

    def _differences(self, kept: Reservoir) -> tuple[mi.Spectrum, mi.Spectrum]:
        """dx and dy of the paths that pixels have kept, each weighted against its mirror image."""
        partners = self._partners(kept.record, kept.W)
        i = dr.arange(mi.UInt32, self.lanes)
        pixel, chain = self._pixel(i), i % self.chain_count
        found = []
        for domain, (x, y) in enumerate(list(STEPS.values())[1:]):
            step = mi.Point2i(x, y)
            exists = self._on_film(pixel + step)
            total = mi.Spectrum(0)
            for side in (0, 1):
                at = dr.select(exists, self._lane(pixel + step, chain), 0) if side else i
                f, W = dr.gather(mi.Spectrum, kept.value, at, exists), dr.gather(mi.Float, kept.W, at, exists)
                other = partners.part(dr.opaque(mi.UInt32, (2 * domain + side) * self.lanes) + at)
                total += dr.select(exists & (W > 0), _pair(f, other, mi.UInt32(side)) * W, 0)
            found.append(total)
        return found[0], found[1]


def _step(domain: mi.UInt32) -> mi.Point2i:
    """From the first pixel of a pair to the second."""
    return mi.Point2i(dr.select(domain == 1, mi.Int32(1), 0), dr.select(domain == 2, mi.Int32(1), 0))


def _same(a: mi.Point2i, b: mi.Point2i) -> mi.Bool:
    return (a.x == b.x) & (a.y == b.y)


def _fraction(place: mi.Point2f) -> mi.Vector2f:
    """Of a place on the film, that within its pixel."""
    return mi.Vector2f(place - dr.floor(place))


def _across(domain: mi.UInt32, side: mi.UInt32) -> mi.Vector2f:
    """From the pixel of a pair that a path is in to the other one."""
    return mi.Vector2f(_step(domain)) * dr.select(side == 0, mi.Float(1), -1)


def _pair(own: mi.Spectrum, other: mi.Spectrum, side: mi.UInt32) -> mi.Spectrum:
    first = side == 0
    return difference(dr.select(first, own, other), dr.select(first, other, own), side)


def _value(r: mi.UInt32, own: mi.Spectrum, other: mi.Spectrum, side: mi.UInt32) -> mi.Spectrum:
    """What reservoir number ``r`` is of, light or one sign of a difference: of a path in its pixel and in the other."""
    sign = dr.select(r % 2 == 1, mi.Float(1), -1)
    return dr.select(r == 0, own, part(_pair(own, other, side), sign))
