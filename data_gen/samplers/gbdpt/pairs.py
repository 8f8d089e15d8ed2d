r"""Pairs of a path and its shifted copy, found by any strategy: one weight for all of them.

The pair of a path x and its copy y = T(x) may be found from either end, and from each by every strategy s. With p_s
their densities, J the Jacobian of T, b = f(x) / p_s(x), b' = f(y) J / p_s(x), and the balance heuristic over all:

    Δ = 2 (b' - b) / (W(x) + r W(y))        W = Σ p_j / p_s = 1 + others (see ``bdpt.mis``), r = p_s(y) J / p_s(x)

The 2 is there since the film averages both directions of a difference. That holds if T depends only on the path,
whichever strategy has found it. A path whose copy does not exist or carries no light is not a pair: Δ = -2 b / W(x),
and its dark copy contributes nothing.

A single strategy may shift a class of paths, by any map that does not leave the class, if all others reject its paths.
Each has weights of its own then, and the strategy that shifts has

    Δ = 2 (b' / W(y) - b / W(x)) / (1 + r)

[Hua et al. 2019, "A Survey on Gradient-Domain Rendering", sections 3.5
and 4.2; Manzi et al. 2015, "Gradient-Domain Bidirectional Path Tracing"]
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


def difference(C: mi.Spectrum, others: mi.Float, shifted: mi.Spectrum, r: mi.Float, others_shifted) -> mi.Spectrum:
    """Returns Δ for b = ``C`` and b' = ``shifted``, which is 0 where there is no copy."""
    W, rW = 1 + others, r * (1 + others_shifted)
    # Both ends of a pair must treat darkness alike: a copy counts as dark only if it is black in all channels.
    whole = (dr.max(shifted) > 0) & dr.isfinite(dr.sum(shifted)) & dr.isfinite(rW)
    Δ = dr.select(whole, (shifted - C) * (2 / (W + rW)), C * (-2 / W))
    return dr.select(dr.max(C) > 0, Δ, 0)


def difference_of_one(
    C: mi.Spectrum, others: mi.Float, shifted: mi.Spectrum, r: mi.Float, others_shifted
) -> mi.Spectrum:
    """Δ of a path that only this strategy shifts, while all others reject it: 2 (b' / W(y) - b / W(x)) / (1 + r)."""
    whole = (dr.max(shifted) > 0) & dr.isfinite(dr.sum(shifted)) & dr.isfinite(r) & dr.isfinite(others_shifted)
    b, b1 = C / (1 + others), shifted / (1 + others_shifted)
    Δ = dr.select(whole, (b1 - b) * (2 / (1 + r)), -2 * b)
    return dr.select(dr.max(C) > 0, Δ, 0)


def weighted(C: mi.Spectrum, others: mi.Float) -> mi.Spectrum:
    """C(x) / W(x): what one path adds to the image."""
    return dr.select(dr.max(C) > 0, C / (1 + others), 0)
