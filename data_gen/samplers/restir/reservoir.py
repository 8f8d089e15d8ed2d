r"""Reservoirs: of many paths one, with a weight that makes up for the others. Pure functions on arrays.

A reservoir holds one path of its pixel, or of its pair of pixels. ``value`` · ``W`` is unbiased for the integral over
all paths, for whatever path it holds: W is an estimate of 1 / density. M, the confidence, says how many candidates have
been seen; it weighs reservoirs against each other and is held below a cap, so that a chain can forget.

All values are light, or one sign of a difference: never negative. What paths are chosen by, p̂, is their luminance.

| quantity | formula | identity |
|---|---|---|
| resampling weight of path l | w = m p̂ \|J\| W, p̂ in the pixel that the reservoir is for | |
| choice | path l with probability w_l / Σ w | |
| weight of the chosen path | W = Σ w / p̂ | E[Σ over choices of value · W] = Σ m · value \|J\| W |
| MIS weights of one path in all pixels that could have found it | ``weigh``, ``pairwise`` | they sum to 1 |

[Lin et al. 2022, "Generalized Resampled Importance Sampling"; Bitterli 2022 for the defensive pairwise
weights]
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from data_gen.samplers.restir.record import Record


@dataclass
class Reservoir:
    record: Record
    side: mi.UInt32  # of a pair: 0 if the path is one of the first pixel, 1 of the second; else 0
    value: mi.Spectrum
    W: mi.Float

    def estimate(self) -> mi.Spectrum:
        return dr.select(self.W > 0, self.value * self.W, 0)


def share(own: mi.Float, others: mi.Float) -> mi.Float:
    """The balance heuristic: the part of a density in the sum of that and others; 0 of nothing."""
    return dr.select(own > 0, own / (own + others), 0)


def weight_of(total: mi.Float, value: mi.Spectrum) -> mi.Float:
    """W of the chosen path, whose value is given, from the sum of all resampling weights."""
    target = mi.luminance(value)
    return dr.select((target > 0) & dr.isfinite(total), total / target, 0)


def weigh(own: mi.Float, others: mi.Float, target: mi.Float, W: mi.Float) -> tuple[mi.Float, mi.Float]:
    """The MIS weight of a path by the generalised balance heuristic, and its resampling weight; 0 of what is not.

    ``own``         M p̂ of the path in the reservoir that it is from
    ``others``      the sum of M p̂ |J| of all others that could have found it
    ``target``, W   p̂ |J| in the pixel that the reservoir is for, and the path's W
    """
    m = share(own, others)
    w = m * target * W
    return m, dr.select(dr.isfinite(w) & (w > 0), w, 0)


def choose(weights: list[mi.Float], u: mi.Float) -> tuple[mi.UInt32, mi.Float]:
    """The number of the path that is kept, by a random number in [0, 1), and the sum of all resampling weights.

    It is one whose weight is not 0, wherever there is one.
    """
    total = sum(weights, start=mi.Float(0))
    chosen, below, place = mi.UInt32(0), mi.Float(0), u * total
    for k, weight in enumerate(weights):
        chosen = dr.select((weight > 0) & (place >= below), k, chosen)
        below += weight
    return chosen, total


def pairwise(M: mi.Float, target: mi.Float, others: list[tuple[mi.Float, mi.Float]]) -> mi.Float:
    """Defensive pairwise MIS weight of a reservoir's own path against those of ``others``.

    ``M``, ``target``  the reservoir's confidence, and p̂ of its path
    ``others``         for each other reservoir its confidence, and p̂ |J| of the path there

    Each of the others has ``pairwise_other``. The weights of a path in all places sum to 1.
    """
    rest = sum((c for c, _ in others), start=mi.Float(0))
    weight = M + sum((c * share(M * target, rest * there) for c, there in others), start=mi.Float(0))
    return weight / (M + rest)


def pairwise_other(c: mi.Float, target: mi.Float, M: mi.Float, here: mi.Float, rest: mi.Float) -> mi.Float:
    """The same of the path of another reservoir.

    ``c``, ``target``  the other's confidence, and p̂ of its path where it comes from
    ``M``, ``here``    confidence of the reservoir for which paths are chosen, and p̂ |J| of the path there
    ``rest``           the sum of confidences of all others
    """
    return c / (M + rest) * share(rest * target, M * here)


def difference(first: mi.Spectrum, second: mi.Spectrum, side: mi.UInt32) -> mi.Spectrum:
    """What a path of a pair of pixels adds to "second pixel - first pixel", weighted against its mirror image.

    ``first`` and ``second`` are f of the path in either pixel, in the measure of the pixel (``side``) that sampled it:
    one is f itself, the other f |J| of the shift. A pair of paths can be sampled from both sides: the weight is p̂'s
    share, since after resampling no density is known. [Gradient-domain ReSTIR 2025, equations 13 to 16]
    """
    a, b = mi.luminance(first), mi.luminance(second)
    own, other = dr.select(side == 0, a, b), dr.select(side == 0, b, a)
    return share(own, other) * (second - first)


def part(value: mi.Spectrum, sign: int) -> mi.Spectrum:
    """The positive or the negative part of a difference, each not negative: it is their difference."""
    return dr.maximum(sign * value, 0)
