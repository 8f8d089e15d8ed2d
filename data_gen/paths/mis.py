"""MIS weights of the techniques that can sample a path, and of the two paths of a pair."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


def mis_weight(chosen: mi.Float, other: mi.Float) -> mi.Float:
    """Power heuristic of two densities. It uses their ratio, because squares could leave the range of float32."""
    return dr.select(chosen > 0, dr.rcp(1 + dr.square(other / chosen)), 0)


def gradient_weight(r: mi.Float, good: mi.Bool) -> mi.Float:
    """2 w, twice the weight with which base path x is responsible for the pair (x, T(x)).

    ``r`` = p(T(x)) |J| / p(x). A pair can be found from x or from T(x). The balance heuristic gives the first case the
    weight w = 1 / (1 + r), and the second case 1 - w (survey, eq. 16-17). If the shift is rejected, there is no second
    case: w = 1. The factor 2 makes up for the film, which averages the two directions of a difference.
    """
    return dr.select(good, 2 / (1 + r), 2)
