r"""Reservoirs: each keeps one of many paths, with a weight that accounts for the others. All functions are pure.

A reservoir holds one path of its pixel, or of its pair of pixels. ``value`` · ``W`` is an unbiased estimate of the
integral over all paths; W estimates 1 / density. M, the confidence, is the number of candidates seen so far. It weights
reservoirs against each other, and is kept below a cap so that a chain can forget: see ``confidence_after``.

A value is light, or one sign of a difference, so it is never negative. Paths are chosen in proportion to p̂, the
luminance of their value.

| quantity | formula | identity |
|---|---|---|
| resampling weight of path l | w = m p̂ \|J\| W, with p̂ in the reservoir's pixel | |
| choice | path l with probability w_l / Σ w | |
| weight of the chosen path | W = Σ w / p̂ | E[Σ over choices of value · W] = Σ m · value \|J\| W |
| MIS weights of one path in all pixels that could have found it | ``weigh`` | they sum to 1 |

[Lin et al. 2022, "Generalized Resampled Importance Sampling"]
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ngpt_studies.restir.record import Record


@dataclass
class Reservoir:
    record: Record
    side: mi.UInt32  # of a pair: 0 if the path is one of the first pixel, 1 of the second; else 0
    value: mi.Spectrum
    W: mi.Float

    def estimate(self) -> mi.Spectrum:
        return dr.select(self.W > 0, self.value * self.W, 0)


def share(own: mi.Float, others: mi.Float) -> mi.Float:
    """The balance heuristic: own / (own + others), or 0 if ``own`` is 0."""
    return dr.select(own > 0, own / (own + others), 0)


def weight_of(total: mi.Float, value: mi.Spectrum) -> mi.Float:
    """W of the chosen path, given the sum of all resampling weights and its value."""
    target = mi.luminance(value)
    return dr.select((target > 0) & dr.isfinite(total), total / target, 0)


def weigh(own: mi.Float, others: mi.Float, target: mi.Float, W: mi.Float) -> tuple[mi.Float, mi.Float]:
    """The MIS weight of a path by the generalised balance heuristic, and its resampling weight; 0 if it is not finite.

    ``own``         M p̂ of the path in the reservoir that it comes from
    ``others``      the sum of M p̂ |J| over all other reservoirs that could have found it
    ``target``, W   p̂ |J| in the pixel of the new reservoir, and the path's W
    """
    m = share(own, others)
    w = m * target * W
    return m, dr.select(dr.isfinite(w) & (w > 0), w, 0)


def choose(weights: list[mi.Float], u: mi.Float) -> tuple[mi.UInt32, mi.Float]:
    """The number of the path that is kept, chosen by ``u`` in [0, 1), and the sum of all resampling weights.

    The weight of the chosen path is positive if any weight is.
    """
    total = sum(weights, start=mi.Float(0))
    chosen, below, place = mi.UInt32(0), mi.Float(0), u * total
    for k, weight in enumerate(weights):
        chosen = dr.select((weight > 0) & (place >= below), k, chosen)
        below += weight
    return chosen, total


def difference(first: mi.Spectrum, second: mi.Spectrum, side: mi.UInt32) -> mi.Spectrum:
    """The contribution of a path to "second pixel - first pixel", with its MIS weight for a pair of pixels.

    ``first`` and ``second`` are f of the path in either pixel, in the measure of the pixel (``side``) that sampled it:
    one is f itself, the other f |J| of the shift. A pair of paths can be sampled from both sides. The weight uses p̂
    instead of densities, since no density is known after resampling. [Wang et al. 2026, "Gradient-Domain ReSTIR Path
    Tracing", equations 13 to 16]
    """
    a, b = mi.luminance(first), mi.luminance(second)
    own, other = dr.select(side == 0, a, b), dr.select(side == 0, b, a)
    return share(own, other) * (second - first)


def part(value: mi.Spectrum, sign: int) -> mi.Spectrum:
    """The positive (``sign`` 1) or negative (-1) part of a difference, never below 0; ``value`` is their difference."""
    return dr.maximum(sign * value, 0)


def confidence_after(
    before: np.ndarray, motions: np.ndarray, steps: Iterable[tuple[int, int]], cap: float
) -> np.ndarray:
    """(steps, H, W) float32: the confidence of a frame, at most ``cap``.

    It is 1 plus the confidence of the frame ``before``, weighted by areas; 0 for pairs that reach over the edge of the
    film. It depends on motion only, and not on random numbers, so weights by it cause no bias.
    """
    count, height, width = before.shape
    y, x = np.mgrid[:height, :width]
    after = np.ones((count, height, width))
    for domain, (right, down) in enumerate(steps):
        known = np.isfinite(motions[domain]).all(axis=-1)
        place = np.stack([x, y], axis=-1) + np.where(known[..., None], motions[domain], -2)
        base = np.floor(place).astype(np.int64)
        part = place - base
        for corner in CORNERS:
            at = base + corner
            inside = ((at >= 0) & (at < (width, height))).all(axis=-1)
            area = np.prod(np.where(corner, part, 1 - part), axis=-1)
            column, row = np.where(inside[..., None], at, 0).transpose(2, 0, 1)
            after[domain] += np.where(inside & known, area * before[domain, row, column], 0)
        after[domain] = np.minimum(after[domain], cap)
        if right:
            after[domain, :, -right:] = 0
        if down:
            after[domain, -down:] = 0
    return after.astype(np.float32)


# The pixels that a pixel's area overlaps after a move by a fraction of a pixel, relative to the first of them.
CORNERS = ((0, 0), (1, 0), (0, 1), (1, 1))


def pair_motions(motion: np.ndarray, depth: np.ndarray | None, steps: Iterable[tuple[int, int]]) -> np.ndarray:
    """(steps, H, W, 2): the motion of each pixel or pair of pixels. A pair has the motion of its nearer pixel.

    NaN where motion is not known, and for pairs that reach over the edge of the film.
    """
    height, width = motion.shape[:2]
    found = np.full((0, height, width, 2), np.nan)
    for x, y in steps:
        second = np.full_like(motion, np.nan, dtype=np.float64)
        inside = np.s_[: height - y, : width - x]
        second[inside] = motion[y:, x:]
        of_both = np.where(np.isfinite(second).all(axis=-1, keepdims=True), motion, np.nan)
        if depth is not None and (x or y):
            nearer = np.zeros((height, width), bool)
            nearer[inside] = depth[y:, x:] < depth[inside]
            of_both = np.where(nearer[..., None], second, of_both)
        found = np.concatenate([found, of_both[None]])
    return found
