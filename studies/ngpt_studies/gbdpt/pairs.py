r"""Pairs of a path and its shifted copy, found by any strategy: one weight over all strategies.

The pair of a path x and its copy y = T(x) may be found from x or from y, each by every strategy s with density p_s.
With the Jacobian J of T, b = f(x) / p_s(x), b' = f(y) J / p_s(x), and the balance heuristic over all cases:

    Δ = 2 (b' - b) / (W(x) + r W(y))        W = Σ p_j / p_s = 1 + others (see ``bdpt.mis``), r = p_s(y) J / p_s(x)

The factor 2 makes up for the film, which averages both directions of a difference. The formula holds if T depends only
on the path, and not on the strategy that has found it. A path whose copy does not exist or carries no light makes no
pair: Δ = -2 b / W(x), and its dark copy contributes nothing.

A strategy may also shift a class of paths by its own map, if this does not leave the class and all other strategies
reject these paths. Then each strategy has separate weights, and the strategy that shifts has

    Δ = 2 (b' / W(y) - b / W(x)) / (1 + r)

[Hua et al. 2019, "A Survey on Gradient-Domain Rendering", sections 3.5
and 4.2; Manzi et al. 2015, "Gradient-Domain Bidirectional Path Tracing"]
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


def difference(C: mi.Spectrum, others: mi.Float, shifted: mi.Spectrum, r: mi.Float, others_shifted) -> mi.Spectrum:
    """Returns Δ for b = ``C`` and b' = ``shifted``. ``shifted`` must be 0 where there is no copy."""
    W, rW = 1 + others, r * (1 + others_shifted)
    # From x and from y a pair must be judged alike: a copy counts as dark only if it is black in all channels.
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
    """C(x) / W(x), the contribution of one path to the image."""
    return dr.select(dr.max(C) > 0, C / (1 + others), 0)
