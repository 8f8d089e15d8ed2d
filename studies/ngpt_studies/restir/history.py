r"""Reservoirs of all pixels, and of all pairs of neighbours, kept from frame to frame.

    for each frame
        a candidate for each pixel                                             ``walk``
        E   of each candidate in the four neighbours                           ``_partners``
        E   of each kept path in this frame                                    ``_of_kept``
        E   of each candidate with the camera of the frame before              ``_there``
        each reservoir keeps one of the paths that it is offered               ``merging``

There are five reservoirs for each pixel: one for its own light, and one for each sign of the difference to its right
and to its lower neighbour. A value that changes sign cannot be a density by which paths are chosen.

A pixel's paths come from its whole area, and a path keeps its place on the film with the fraction of a pixel. With the
motion m of a pixel, paths that were at p in the frame before are now at p - m. So the pixel's area, moved by m, lies on
up to four pixels of the frame before. Paths that these have kept inside the area are taken over. But each pixel has
kept only one path, which may lie outside the area, and a fifth of the pixels would have no history. So from the nearest
pixel of the four all paths are taken over. A path outside the area is moved by a whole pixel: it *wraps*. So a path may
have been found in three ways: by this frame's candidate, straight, and wrapped. The MIS weights of the three sum to 1,
whatever m is. Confidence is handed on in proportion to the areas. [Zhang et al. 2024, "Area ReSTIR"; Wang et al. 2026,
"Gradient-Domain ReSTIR Path Tracing", section 4.3.1]

This is unbiased as long as motion does not depend on random numbers. If more than the camera changes, there are two
scenes, and records are carried into the scene in which E is evaluated: see ``ngpt_studies.restir.carry``. The
``chains`` of a pixel are independent, so several chains give a variance. The frames of one chain are correlated over
``cap`` frames, so they must not be put into a film as if they were samples.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np

from data_gen.passes import recording
from data_gen.paths.camera import CameraSamples
from ngpt_studies.restir.carry import Carry
from ngpt_studies.restir.evaluate import Request, Requests, evaluate_record, evaluate_some
from ngpt_studies.restir.layout import RESERVOIRS, STEPS, Layout, across, step
from ngpt_studies.restir.merging import Evaluated, Merging, differences
from ngpt_studies.restir.record import Record
from ngpt_studies.restir.reservoir import CORNERS, Reservoir, confidence_after, pair_motions
from ngpt_studies.restir.stage import Pose, Stage, check
from ngpt_studies.restir.walk import Candidate, choices, walk


@dataclass
class Frame:
    """Estimates of each lane of one frame, without the emission that the camera sees directly.

    ``path``  the estimate of the candidates' walks, without history
    """

    camera: CameraSamples
    path: mi.Spectrum
    primal: mi.Spectrum
    dx: mi.Spectrum
    dy: mi.Spectrum


class History:
    """The reservoirs of a shot, frame after frame.

    Lanes are ordered pixel by pixel, within a pixel by chain. ``cap`` is the largest confidence of a reservoir, in
    frames; 1 means hardly any history. Without ``pairs``, differences have no reservoirs of their own. They are
    computed from the paths in the pixels' reservoirs, as in the paper's baseline. Raises NgptError for scenes whose
    paths records cannot hold: see ``stage.check``.
    """

    def __init__(self, stage: Stage, seed: int, chains: int = 1, cap: float = 32, pairs: bool = True):
        check(stage.plan)
        self.stage = self.before = stage
        self.seed, self.chains, self.cap, self.pairs = seed, chains, cap, pairs
        self.gradients, self.frames = True, 0
        self.kept: Reservoir | None = None
        self.pose: Pose | None = None
        self.size = width, height = tuple(int(n) for n in stage.sensor.film().crop_size())
        self.confidence = np.zeros((len(STEPS), height, width), np.float32)

    def next_frame(
        self, motion: np.ndarray | None = None, depth: np.ndarray | None = None, stage: Stage | None = None
    ) -> Frame:
        """Renders a frame.

        ``stage`` is the current scene, if more than the camera has changed. It must be another object than the scene of
        the frame before, which must not have changed since. None: the same scene.

        ``motion`` (H, W, 2) comes from ``data_gen.frames.motion``, NaN where there is no history; None: nothing moves.
        ``depth`` (H, W) determines which pixel of a pair is nearer. The motion of the nearer one applies to both.
        """
        width, height = self.size
        self.before, self.stage = self.stage, stage or self.stage
        if self.stage is not self.before:
            check(self.stage.plan)
        motions = pair_motions(np.zeros((height, width, 2)) if motion is None else motion, depth, STEPS.values())
        with recording():
            self.at = Layout(self.size, self.chains, RESERVOIRS if self.pairs else 1, motions, self.confidence)
            first = self.frames * self.chains
            camera = CameraSamples(self.stage.sensor, self.seed, self.chains, first)
            sample = dr.opaque(mi.UInt32, first) + dr.arange(mi.UInt32, self.at.lanes) % self.at.chains
            choice = choices(self.seed, camera, sample)
            found = walk(self.stage, camera, sample, choice)
            u = [choice.next_1d() for _ in range(self.at.reservoirs)]
            dr.eval(found, u)
            frame = self._resample(camera, found, dr.concat(u))
        self.confidence = confidence_after(self.confidence, motions, STEPS.values(), self.cap)
        self.pose, self.before = Pose(self.stage.sensor), self.stage
        self.frames += 1
        return frame

    @property
    def _ends(self) -> int:  # number of pixels that a value depends on
        return 2 if self.pairs else 1

    @contextmanager
    def _then(self) -> Iterator[Stage]:
        """A context with the scene of the frame before."""
        if self.before is not self.stage:
            yield self.before
            return
        with self.pose.of(self.stage.sensor):
            yield self.stage

    def _carried(self, record: Record, source: Stage, target: Stage, active: mi.Bool) -> Record:
        return record if source is target else Carry(source, target)(self.seed, record, active)

    def _of(self, stage: Stage, pool: Record, lanes: int, ends: int, active: mi.Bool, request: Request) -> Requests:
        return evaluate_some(partial(evaluate_record, stage, self.seed), pool, lanes, ends, active, request)

    def _resample(self, camera: CameraSamples, found: Candidate, u: mi.Float) -> Frame:
        e, kept = Evaluated(), self.kept
        if kept is not None:
            with self._then() as stage:
                back = self._carried(found.record, self.stage, self.before, found.W > 0)
                e.elsewhere = self._of_kept(stage, kept, elsewhere=True)
                e.there = self._there(stage, replace(found, record=back))
            kept = replace(kept, record=self._carried(kept.record, self.before, self.stage, kept.W > 0))
            e.here = self._of_kept(self.stage, kept, elsewhere=False)
        if self.pairs:
            e.partners = self._partners(found.record, found.W)
        kept = Merging(self.at, self._ends, found, kept, e).merged(u)
        dr.eval(kept)
        self.kept = kept
        values = kept.estimate()
        n = self.at.lanes
        primal, *signs = (
            dr.gather(mi.Spectrum, values, dr.arange(mi.UInt32, n) + dr.opaque(mi.UInt32, r * n))
            for r in range(self.at.reservoirs)
        )
        if self.pairs:
            dx, dy = signs[0] - signs[1], signs[2] - signs[3]
        else:
            dx, dy = mi.Spectrum(0), mi.Spectrum(0)
            if self.gradients:
                dx, dy = differences(self.at, kept, self._partners(kept.record, kept.W))
        dr.eval(primal, dx, dy)
        return Frame(camera, found.L, primal, dx, dy)

    # ------------------------------ E, where it is needed ------------------------------

    def _partners(self, record: Record, W: mi.Float) -> Requests:
        """E of each lane's path in the right, left, lower and upper neighbour (k = 0 to 3): request k n + lane."""

        def place(lane: mi.UInt32) -> tuple[mi.UInt32, mi.Point2f]:
            i, pair = lane % self.at.n, lane // self.at.n
            return i, mi.Point2f(dr.gather(mi.Point2f, record.place, i) + across(pair // 2 + 1, pair % 2))

        lane = dr.arange(mi.UInt32, 4 * self.at.lanes)
        i, where = place(lane)
        active = (dr.gather(mi.Float, W, i) > 0) & self.at.on_film(mi.Point2i(dr.floor(where)))
        request = lambda lane, end: (*place(lane), mi.Bool(True))  # noqa: E731
        return self._of(self.stage, record, 4 * self.at.lanes, 1, active, request)

    def _of_kept(self, stage: Stage, kept: Reservoir, elsewhere: bool) -> Requests:
        """E of each kept path at its place in this frame: 4 requests for each reservoir, for the corners of its area.

        With ``elsewhere``: E in the frame before, at the other place where the path could have been.
        """

        def request(lane: mi.UInt32, end: mi.UInt32):
            it = self.at.corner(lane, kept)
            place = it.elsewhere if elsewhere else it.place
            return it.source, place + mi.Float(end) * across(it.domain, it.side), (end == 0) | (it.domain > 0)

        lanes = self.at.total * len(CORNERS)
        it = self.at.corner(dr.arange(mi.UInt32, lanes), kept)
        good = it.twice & (self.at.confidence(it.domain, it.other) > 0) if elsewhere else it.good
        return self._of(stage, kept.record, lanes, self._ends, good, request)

    def _there(self, stage: Stage, found: Candidate) -> Requests:
        """E of each candidate in the frame before. There is a request for each lane, for primal and for both sides of
        dx and dy, first straight and then wrapped."""

        def where(lane: mi.UInt32):
            wrapped, e, i = lane >= self.at.all, (lane // self.at.n) % self.at.reservoirs, lane % self.at.n
            domain, side = (e + 1) // 2, dr.select(e == 0, 0, (e + 1) % 2)
            place = dr.gather(mi.Point2f, found.record.place, i)
            pair = self.at.pixel(i) - step(domain) * mi.Int32(side)
            there, before, exists = self.at.before(domain, pair, side, place, wrapped)
            return domain, side, i, there, exists & (self.at.confidence(domain, before) > 0)

        def request(lane: mi.UInt32, end: mi.UInt32):
            domain, side, i, place, _ = where(lane)
            return i, place + mi.Float(end) * across(domain, side), (end == 0) | (domain > 0)

        _, _, i, _, good = where(dr.arange(mi.UInt32, 2 * self.at.total))
        good &= dr.gather(mi.Float, found.W, i) > 0
        return self._of(stage, found.record, 2 * self.at.total, self._ends, good, request)
