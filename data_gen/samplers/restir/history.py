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

    def at(self, lane: mi.UInt32, second: bool = False) -> Shifted:
        """What is known of these lanes; 0 with a Jacobian of 1 where nothing was asked for."""
        slot = dr.gather(mi.UInt32, self.slot, lane)
        asked, slot = slot != _NONE, slot + (self.count if second else 0)
        f = dr.gather(mi.Spectrum, self.shifted.f, slot, asked)
        J, geometry = (dr.gather(mi.Float, v, slot, asked) for v in (self.shifted.J, self.shifted.geometry))
        return Shifted(f, dr.select(asked, J, 1), geometry)


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
            u = [choice.next_1d() for _ in range(self.total // n)]
            dr.eval(found, u)
            frame = self._resample(camera, found, dr.concat(u))
        self.confidence = confidence_after(self.confidence, motions, STEPS.values(), self.cap)
        self.pose = Pose(self.sensor)
        self.frames += 1
        return frame

    def _resample(self, camera: CameraSamples, found: Candidate, u: mi.Float) -> Frame:
        here = there = None
        if self.kept is not None:
            here = self._here(self.kept)
            with self.pose.of(self.sensor):
                there = self._there(found)
        partners = self._partners(found.record, found.W) if self.pairs else None
        kept = self._merged(found, self.kept, partners, here, there, u)
        dr.eval(kept)
        self.kept = kept
        values = kept.estimate()
        n = self.lanes
        primal, *signs = (
            dr.gather(mi.Spectrum, values, dr.arange(mi.UInt32, n) + dr.opaque(mi.UInt32, r * n))
            for r in range(RESERVOIRS if self.pairs else 1)
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
        self.total = n * (RESERVOIRS if self.pairs else 1)
        self.n, self.chain_count = dr.opaque(mi.UInt32, n), dr.opaque(mi.UInt32, self.chains)
        self.width, self.height = (dr.opaque(mi.Int32, v) for v in self.size)
        self.area = dr.opaque(mi.UInt32, self.size[0] * self.size[1])
        self.motions = mi.Vector2f(*(mi.Float(np.ascontiguousarray(motions[..., a], np.float32).ravel()) for a in (0, 1)))
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
            i, which = lane % self.n, lane // self.n
            back = dr.select(which % 2 == 0, mi.Float(1), -1)
            move = mi.Vector2f(dr.select(which < 2, back, 0), dr.select(which < 2, 0, back))
            return i, dr.gather(mi.Point2f, record.place, i) + move

        lane = dr.arange(mi.UInt32, 4 * self.lanes)
        i, where = place(lane)
        active = (dr.gather(mi.Float, W, i) > 0) & self._on_film(mi.Point2i(dr.floor(where)))
        return self._evaluate(record, 4 * self.lanes, 1, active, lambda lane, end: (*place(lane), mi.Bool(True)))

    def _corner(self, lane: mi.UInt32):
        """Of request ``lane``, four for each reservoir: what it is about, and the reservoir of before at that corner."""
        job, corner = lane // len(CORNERS), lane % len(CORNERS)
        r, i = job // self.n, job % self.n
        domain = (r + 1) // 2
        pixel = self._pixel(i)
        motion = self._motion(domain, pixel, mi.Bool(True))
        before = mi.Point2i(dr.floor(mi.Point2f(pixel) + motion)) + mi.Point2i(
            *(mi.Int32(part_) for part_ in (corner % 2, corner // 2))
        )
        source = r * self.n + dr.select(self._on_film(before), self._lane(before, i % self.chain_count), 0)
        return domain, pixel, motion, before, source

    def _here(self, kept: Reservoir) -> _Requests:
        """Each path that was kept, where the pixels that look for it have it now: 4 requests for each reservoir."""

        def where(lane: mi.UInt32):
            domain, pixel, motion, before, source = self._corner(lane)
            place = dr.gather(mi.Point2f, kept.record.place, source) - motion
            side = dr.gather(mi.UInt32, kept.side, source)
            at = pixel + _step(domain) * mi.Int32(side)
            found = mi.Point2i(dr.floor(place))
            good = self._on_film(before) & (found.x == at.x) & (found.y == at.y)
            return domain, source, place, side, good

        def request(lane: mi.UInt32, end: mi.UInt32):
            domain, source, place, side, _ = where(lane)
            return source, place + mi.Float(end) * _across(domain, side), (end == 0) | (domain > 0)

        lanes = self.total * len(CORNERS)
        _, source, _, _, good = where(dr.arange(mi.UInt32, lanes))
        good &= dr.gather(mi.Float, kept.W, source) > 0
        return self._evaluate(kept.record, lanes, 2 if self.pairs else 1, good, request)

    def _there(self, found: Candidate) -> _Requests:
        """Each candidate in the frame before: requests of lane, of primal, dx and dy as side 0 and 1, 5 n."""

        def where(lane: mi.UInt32):
            e, i = lane // self.n, lane % self.n
            domain, side = (e + 1) // 2, dr.select(e == 0, 0, (e + 1) % 2)
            place = dr.gather(mi.Point2f, found.record.place, i)
            pair = self._pixel(i) - _step(domain) * mi.Int32(side)
            exists = self._on_film(pair)
            place = place + self._motion(domain, pair, exists)
            before = mi.Point2i(dr.floor(place)) - _step(domain) * mi.Int32(side)
            return domain, side, i, place, exists & (self._confidence(domain, before) > 0)

        def request(lane: mi.UInt32, end: mi.UInt32):
            domain, side, i, place, _ = where(lane)
            return i, place + mi.Float(end) * _across(domain, side), (end == 0) | (domain > 0)

        _, _, i, _, good = where(dr.arange(mi.UInt32, self.total))
        good &= dr.gather(mi.Float, found.W, i) > 0
        return self._evaluate(found.record, self.total, 2 if self.pairs else 1, good, request)

    # ------------------------------ What is kept ------------------------------

    def _merged(
        self,
        found: Candidate,
        kept: Reservoir | None,
        partners: _Requests | None,
        here: _Requests | None,
        there: _Requests | None,
        u: mi.Float,
    ) -> Reservoir:
        """Of each reservoir the path that is kept, of this frame or of the one before."""
        lane = dr.arange(mi.UInt32, self.total)
        r, i = lane // self.n, lane % self.n
        domain, pixel, chain = (r + 1) // 2, self._pixel(i), i % self.chain_count
        step, one = _step(domain), mi.Float(1)
        exists = self._on_film(pixel + step)
        motion = self._motion(domain, pixel, mi.Bool(True))
        values, weights, sides = [], [], []
        new, old, slot = mi.UInt32(0), mi.UInt32(0), mi.UInt32(0)
        lanes = []
        for side in (0, 1) if self.pairs else (0,):
            active = exists & (domain > 0) if side else exists
            at = dr.select(active, self._lane(pixel + step, chain), 0) if side else i
            f, W = dr.gather(mi.Spectrum, found.f, at, active), dr.gather(mi.Float, found.W, at, active)
            other = mi.Spectrum(0)
            if partners is not None:
                shifted = partners.at(dr.select(domain > 0, (2 * domain - 2 + side) * self.n + at, 0))
                other = shifted.f * shifted.J
            value = dr.select(active, _value(r, f, other, mi.UInt32(side)), 0)
            target, rest, density = mi.luminance(value), mi.Float(0), mi.Float(0)
            if there is not None:
                place = dr.gather(mi.Point2f, found.record.place, at) + motion
                rest = self._confidence(domain, mi.Point2i(dr.floor(place)) - step * side)
                entry = dr.select(domain > 0, 2 * domain - 1 + side, 0) * self.n + at
                own, far = there.at(entry), there.at(entry, True) if self.pairs else None
                density = mi.luminance(_value(r, own.f * own.J, far.f * far.J if far else 0, mi.UInt32(side)))
            weights.append(weigh(one, target, rest, density, target, W)[1])
            values.append(value)
            sides.append(mi.UInt32(side))
            lanes.append(at)
        candidates = len(values)
        sources, entries = [], []
        for corner in range(len(CORNERS)) if kept is not None else ():
            entry = lane * len(CORNERS) + corner
            _, _, _, before, source = self._corner(entry)
            side = dr.gather(mi.UInt32, kept.side, source)
            own, far = here.at(entry), here.at(entry, True) if self.pairs else None
            # In the measure of the pixel that the path is in
            value = _value(r, own.f, far.f * (far.J / own.J) if far else 0, side)
            value = dr.select(exists & dr.all(dr.isfinite(value)), value, 0)
            target = mi.luminance(value) * own.J
            was = mi.luminance(dr.gather(mi.Spectrum, kept.value, source))
            W = dr.gather(mi.Float, kept.W, source)
            weights.append(weigh(self._confidence(domain, before), was, one, target, target, W)[1])
            values.append(value)
            sides.append(side)
            sources.append(source)
            entries.append(entry)
        chosen, total = choose(weights, u)
        value, side = values[0], sides[0]
        for k in range(1, len(values)):
            value, side = dr.select(chosen == k, values[k], value), dr.select(chosen == k, sides[k], side)
        new = lanes[0]
        for k, at in enumerate(lanes):
            new = dr.select(chosen == k, at, new)
        record = gather(found.record, new)
        if kept is not None:
            for k, (source, entry) in enumerate(zip(sources, entries, strict=True)):
                old, slot = (dr.select(chosen == candidates + k, a, b) for a, b in ((source, old), (entry, slot)))
            history = gather(kept.record, old)
            history = history.moved(mi.Point2f(history.place - motion), here.at(slot).geometry)
            record = select(chosen < candidates, record, history)
        return Reservoir(record, side, value, weight_of(total, value))

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
                shifted = partners.at(dr.opaque(mi.UInt32, (2 * domain + side) * self.lanes) + at)
                total += dr.select(exists & (W > 0), _pair(f, shifted.f * shifted.J, mi.UInt32(side)) * W, 0)
            found.append(total)
        return found[0], found[1]


def _step(domain: mi.UInt32) -> mi.Point2i:
    """From the first pixel of a pair to the second."""
    return mi.Point2i(dr.select(domain == 1, mi.Int32(1), 0), dr.select(domain == 2, mi.Int32(1), 0))


def _across(domain: mi.UInt32, side: mi.UInt32) -> mi.Vector2f:
    """From the pixel of a pair that a path is in to the other one."""
    return mi.Vector2f(_step(domain)) * dr.select(side == 0, mi.Float(1), -1)


def _pair(own: mi.Spectrum, other: mi.Spectrum, side: mi.UInt32) -> mi.Spectrum:
    first = side == 0
    return difference(dr.select(first, own, other), dr.select(first, other, own), side)


def _value(r: mi.UInt32, own: mi.Spectrum, other: mi.Spectrum, side: mi.UInt32) -> mi.Spectrum:
    """What reservoir number ``r`` is of: light, or one sign of a difference; of a path in its pixel and in the other."""
    sign = dr.select(r % 2 == 1, mi.Float(1), -1)
    return dr.select(r == 0, own, part(_pair(own, other, side), sign))
