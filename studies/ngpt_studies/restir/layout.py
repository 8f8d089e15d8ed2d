"""The places of lanes, pixels and pairs in arrays and on the film, in this frame and in the frame before."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ngpt_studies.restir.reservoir import CORNERS, Reservoir

# Domains, that is kinds of values, with the step to the second pixel of a pair. Reservoirs are numbered in the order 0
# primal, 1 dx+, 2 dx-, 3 dy+, 4 dy-.
STEPS = {"primal": (0, 0), "dx": (1, 0), "dy": (0, 1)}
RESERVOIRS = 5
# The motion of a pixel that was not seen in the frame before
_NOWHERE = -1e6


@dataclass
class Kept:
    """A path of the frame before, as it is offered to a reservoir."""

    domain: mi.UInt32
    side: mi.UInt32
    before: mi.Point2i  # first pixel of the pair for which it was kept
    source: mi.UInt32  # lane of that reservoir
    place: mi.Point2f  # the place of the path in this frame
    good: mi.Bool
    other: mi.Point2i  # first pixel of the other pair that could have kept the path,
    elsewhere: mi.Point2f  # at this place,
    twice: mi.Bool  # if there is such a pair


class Layout:
    """A frame of ``size`` = (width, height) with ``chains`` lanes for each pixel, and ``reservoirs`` for each lane.

    ``motions`` (3, H, W, 2), NaN where unknown, and ``confidence`` (3, H, W) of the frame before are given for pixels
    and for pairs, in the order of ``STEPS``. Numbers that kernels read are opaque: as literals they would be compiled
    into the kernels, and each value would need a new one.
    """

    def __init__(
        self, size: tuple[int, int], chains: int, reservoirs: int, motions: np.ndarray, confidence: np.ndarray
    ):
        self.lanes = size[0] * size[1] * chains
        self.reservoirs, self.total = reservoirs, self.lanes * reservoirs
        self.n, self.all, self.chains = (dr.opaque(mi.UInt32, v) for v in (self.lanes, self.total, chains))
        self.width, self.height = (dr.opaque(mi.Int32, v) for v in size)
        self.area = dr.opaque(mi.UInt32, size[0] * size[1])
        known = np.nan_to_num(motions, nan=_NOWHERE).astype(np.float32)
        self.motions = mi.Vector2f(*(mi.Float(np.ascontiguousarray(known[..., axis]).ravel()) for axis in (0, 1)))
        self.confidences = mi.Float(confidence.ravel())

    def pixel(self, lane: mi.UInt32) -> mi.Point2i:
        pixel = mi.Int32(lane // self.chains)
        return mi.Point2i(pixel % self.width, pixel // self.width)

    def lane(self, pixel: mi.Point2i, chain: mi.UInt32) -> mi.UInt32:
        return mi.UInt32(pixel.x + pixel.y * self.width) * self.chains + chain

    def on_film(self, pixel: mi.Point2i) -> mi.Bool:
        return (pixel.x >= 0) & (pixel.y >= 0) & (pixel.x < self.width) & (pixel.y < self.height)

    def _at(self, domain: mi.UInt32, pixel: mi.Point2i, active: mi.Bool) -> mi.UInt32:
        return domain * self.area + dr.select(active, mi.UInt32(pixel.x + pixel.y * self.width), 0)

    def motion(self, domain: mi.UInt32, pixel: mi.Point2i, active: mi.Bool) -> mi.Vector2f:
        return dr.gather(mi.Vector2f, self.motions, self._at(domain, pixel, active), active)

    def confidence(self, domain: mi.UInt32, pixel: mi.Point2i) -> mi.Float:
        """The confidence in the frame before; 0 off the film, and for pairs that do not exist."""
        there = self.on_film(pixel)
        return dr.gather(mi.Float, self.confidences, self._at(domain, pixel, there), there)

    def _nearest(self, pair: mi.Point2i, motion: mi.Vector2f) -> mi.Point2i:
        return mi.Point2i(dr.floor(mi.Point2f(pair) + motion + 0.5))

    def corner(self, lane: mi.UInt32, kept: Reservoir) -> Kept:
        """The path that reservoir ``lane`` // 4 finds at corner ``lane`` % 4 of its area in the frame before."""
        job, corner = lane // len(CORNERS), lane % len(CORNERS)
        r, i = job // self.n, job % self.n
        domain, pixel = (r + 1) // 2, self.pixel(i)
        motion = self.motion(domain, pixel, mi.Bool(True))
        before = mi.Point2i(dr.floor(mi.Point2f(pixel) + motion))
        before += mi.Point2i(mi.Int32(corner % 2), mi.Int32(corner // 2))
        on_film, nearest = self.on_film(before), self._nearest(pixel, motion)
        source = r * self.n + dr.select(on_film, self.lane(before, i % self.chains), 0)
        side = dr.gather(mi.UInt32, kept.side, source)
        was = dr.gather(mi.Point2f, kept.record.place, source)
        to_side = step(domain) * mi.Int32(side)
        at, straight = pixel + to_side, mi.Point2f(was - motion)
        stays = same(mi.Point2i(dr.floor(straight)), at)
        place = dr.select(stays, straight, mi.Point2f(mi.Point2f(at) + fraction(straight)))
        # The other place where this path could have been
        far = mi.Point2f(place + motion)
        other = dr.select(stays, nearest, mi.Point2i(dr.floor(far)) - to_side)
        elsewhere = dr.select(stays, mi.Point2f(mi.Point2f(nearest + to_side) + fraction(was)), far)
        good = on_film & (stays | same(before, nearest)) & (dr.gather(mi.Float, kept.W, source) > 0)
        return Kept(domain, side, before, source, place, good, other, elsewhere, good & ~same(other, before))

    def before(self, domain: mi.UInt32, pair: mi.Point2i, side: mi.UInt32, place: mi.Point2f, wrapped: mi.Bool):
        """Where a path of this frame's ``pair`` could have been in the frame before: place, pair, whether they exist.

        Without ``wrapped`` it is the place straight along the motion. With it, the place is in the nearest pair, and
        exists only if that is another pair.
        """
        exists = self.on_film(pair)
        motion = self.motion(domain, pair, exists)
        to_side, nearest = step(domain) * mi.Int32(side), self._nearest(pair, motion)
        far = mi.Point2f(place + motion)
        straight = mi.Point2i(dr.floor(far)) - to_side
        there = dr.select(wrapped, mi.Point2f(mi.Point2f(nearest + to_side) + fraction(far)), far)
        before = dr.select(wrapped, nearest, straight)
        return there, before, exists & ~(wrapped & same(nearest, straight))


def step(domain: mi.UInt32) -> mi.Point2i:
    """The step from the first pixel of a pair to the second."""
    return mi.Point2i(dr.select(domain == 1, mi.Int32(1), 0), dr.select(domain == 2, mi.Int32(1), 0))


def same(a: mi.Point2i, b: mi.Point2i) -> mi.Bool:
    return (a.x == b.x) & (a.y == b.y)


def fraction(place: mi.Point2f) -> mi.Vector2f:
    """The position of a place on the film within its pixel."""
    return mi.Vector2f(place - dr.floor(place))


def across(domain: mi.UInt32, side: mi.UInt32) -> mi.Vector2f:
    """The step from a path's own pixel to the other pixel of the pair."""
    return mi.Vector2f(step(domain)) * dr.select(side == 0, mi.Float(1), -1)
