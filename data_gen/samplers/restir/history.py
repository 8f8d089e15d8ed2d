r"""Frames of a camera that stands still: each pixel, and each pair of neighbours, keeps a reservoir over frames.

    for each frame
        a candidate for each pixel                                       ``walk``
        primal  its reservoir, merged with that of the frame before
        dx, dy  both paths of a pair, each shifted to the other pixel    ``evaluate_at``
                of each sign the one or the other                        ``pair``
                merged with that of the frame before

A pixel's paths are those of its whole area, so that a frame needs no sub-pixel position of its own. Nothing moves: the
path of the frame before is one of this frame, with the value that is stored, and to merge takes no shift.

``chains`` of each pixel know nothing of each other. One chain has no variance: its frames are correlated over ``cap``
of them, and must not be put into a film as if they were samples. Several have the variance over chains.

To go on from here (a camera or shapes that move): ``merge`` is written for reservoirs that are shifted. Their pixel is
found by ``data_gen.frames.motion``, at a fraction of a pixel, since with the nearest pixel differences gain next to
nothing; ``evaluate_record`` displaces a record by fractions. Which of the four pixels around is the one whose area the
displaced sample falls into, and the test for that from both sides, is to be written (Zhang et al. 2024, "Area ReSTIR").
``merge`` needs both pixels' f of the *current* scene, and is unbiased only while the camera alone moves.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from data_gen.passes import recording
from data_gen.paths.camera import CameraSamples
from data_gen.samplers.gpt.plan import Plan
from data_gen.samplers.restir.evaluate import evaluate_at
from data_gen.samplers.restir.events import check
from data_gen.samplers.restir.record import gather, select
from data_gen.samplers.restir.reservoir import Reservoir, Seen, difference, merge, part, weight_of
from data_gen.samplers.restir.walk import Candidate, choices, walk

# Of differences there are two reservoirs for each pair: values that change sign have no density to choose by.
SIGNS = (1, -1)


class History:
    """Reservoirs of all pixels and pairs of a scene whose camera stands still.

    Lanes are ordered pixel by pixel, within a pixel by chain. ``cap`` is the confidence that a reservoir can reach, in
    frames; 1: hardly any history. Raises NgptError for what records cannot hold: see ``events.check``.
    """

    def __init__(self, scene: mi.Scene, plan: Plan, sensor: mi.Sensor, seed: int, chains: int = 1, cap: float = 32):
        check(scene, plan)
        self.scene, self.plan, self.sensor, self.seed = scene, plan, sensor, seed
        self.chains, self.cap = chains, cap
        self.frames = 0
        self.kept: dict[str | tuple[str, int], Reservoir] = {}

    def next_frame(self) -> dict[str, mi.Spectrum]:
        """Renders a frame: estimates of each lane's ``primal``, ``dx`` and ``dy``, and of the ``path`` without history.

        Emission that the camera sees directly is in none of them. Differences are forward, as those of a stack: 0 in
        the last column, or row.
        """
        first = self.frames * self.chains
        with recording():
            camera = CameraSamples(self.sensor, self.seed, self.chains, first)
            lane = dr.arange(mi.UInt32, dr.width(camera.pixel))
            sample = dr.opaque(mi.UInt32, first) + lane % dr.opaque(mi.UInt32, self.chains)
            choice = choices(self.seed, camera, sample)
            found = walk(self.scene, self.plan, camera, sample, choice)
            dr.eval(found, choice.random)
            single = Reservoir(found.record, dr.zeros(mi.UInt32, len(lane)), found.f, found.W, _ones(len(lane)))
            values = {"path": found.L, "primal": self.remember("primal", single, choice).estimate()}
            for name, toward in (("dx", (1, 0)), ("dy", (0, 1))):
                reservoirs = self.pair(camera, found, toward, choice)
                estimates = [
                    sign * self.remember((name, sign), reservoir, choice).estimate()
                    for sign, reservoir in zip(SIGNS, reservoirs, strict=True)
                ]
                values[name] = estimates[0] + estimates[1]
            dr.eval(values, self.kept)
        self.frames += 1
        return values

    def remember(self, key: str | tuple[str, int], current: Reservoir, choice) -> Reservoir:
        """The reservoir of this frame, merged with that of all frames before."""
        previous = self.kept.get(key)
        if previous is not None:
            there, here = Seen(current.value, mi.Float(1)), Seen(previous.value, mi.Float(1))
            current = merge(current, previous, there, here, choice.next_1d(), self.cap)
        self.kept[key] = current
        return current

    def pair(self, camera: CameraSamples, found: Candidate, toward: tuple[int, int], choice) -> list[Reservoir]:
        """For each sign a reservoir of a pixel and the one that lies ``toward`` = (columns, rows) from it, not before.

        Their only candidates are the paths ``found`` in the two.
        """
        width, height = (dr.opaque(mi.UInt32, int(n)) for n in camera.size)
        columns, rows = (dr.opaque(mi.UInt32, n) for n in toward)
        pixel, lane = camera.pixel, dr.arange(mi.UInt32, dr.width(camera.pixel))
        exists = (pixel % width + columns < width) & (pixel // width + rows < height)
        step = (rows * width + columns) * dr.opaque(mi.UInt32, self.chains)
        partner = dr.select(exists, lane + step, lane)
        record = gather(found.record, partner)
        f, W = dr.gather(mi.Spectrum, found.f, partner), dr.gather(mi.Float, found.W, partner)
        second = dr.gather(mi.UInt32, pixel, partner)
        # The first pixel's path in the second, and the second's in the first
        shift = (self.scene, self.plan, self.sensor, self.seed)
        there = evaluate_at(*shift, found.record, pixel, second, exists & (found.W > 0))
        here = evaluate_at(*shift, record, second, pixel, exists & (W > 0))
        one = difference(found.f, there.f * there.J, mi.UInt32(0))
        two = difference(here.f * here.J, f, mi.UInt32(1))
        reservoirs = []
        for sign in SIGNS:
            values = [dr.select(exists, part(value, sign), 0) for value in (one, two)]
            # Paths of two pixels are different paths: each is the only candidate of its domain, with m = 1.
            weights = [
                dr.select(weight > 0, mi.luminance(value) * weight, 0)
                for value, weight in zip(values, (found.W, W), strict=True)
            ]
            total = weights[0] + weights[1]
            first = choice.next_1d() * total < weights[0]
            value = dr.select(first, *values)
            chosen = select(first, found.record, record)
            side = dr.select(first, mi.UInt32(0), mi.UInt32(1))
            reservoirs.append(Reservoir(chosen, side, value, weight_of(total, value), _ones(len(lane))))
        return reservoirs


def _ones(lanes: int) -> mi.Float:
    return dr.full(mi.Float, 1, lanes)
