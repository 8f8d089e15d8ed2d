"""The shift "half-vector": an offset path leaves its vertex with the half-vector of its base path's event.

It replaces random sequence replay where the base path goes on by a *smooth* event, which means: an event that is not
specular (no Dirac delta). [Kettunen et al. 2015, section 5.2 and supplement; Hua et al. 2019, section 3.2]
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from data_gen.paths import shift
from data_gen.paths.vertex import SMOOTH, evaluate
from data_gen.samplers.gpt.base_path import Step


@dataclass
class Departure:
    """How an offset path that is apart from its base path leaves its vertex."""

    found: mi.Bool  # whether there is a direction
    wo: mi.Vector3f
    p: mi.Float  # its density
    kind: mi.UInt32
    f_p: mi.Spectrum  # f |J| / p, with the p of the base path
    r: mi.Float  # p' |J| / p
    allowed: mi.Bool | bool = True  # False where the shift is rejected


def copy_where_smooth(step: Step, y: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr, replayed: Departure) -> Departure:
    """Returns the departure from ``y`` with the base path's half-vector if it has one, else ``replayed``."""
    # A Dirac event has no density to divide by. It is replayed, which gives the same direction as the half-vector.
    copies = step.goes_on & (step.kind == SMOOTH)
    same = y.bsdf() == step.x.bsdf()
    wo, J, exists = shift.copy_half_vector(step.x.wi, step.wo, step.η, y.wi, same)
    f, p = evaluate(bsdf, y, wo, copies)
    found = dr.select(copies, exists & (p > 0), replayed.found)
    return Departure(
        found=found,
        wo=dr.select(copies, wo, replayed.wo),
        p=dr.select(copies, p, replayed.p),
        kind=dr.select(copies, SMOOTH, replayed.kind),
        # Paths with the same half-vector do not have the same random numbers (survey, eq. 15). So |J| does not cancel
        # in f |J| / p and in r.
        f_p=dr.select(copies, f * (J / step.p), replayed.f_p),
        r=dr.select(copies, p * J / step.p, replayed.r),
        # If the replayed event is smooth, the shift is rejected, since the reverse shift would copy the half-vector of
        # this event. Beside a ghost the event is allowed: there neither shift has a half-vector to copy.
        allowed=dr.select(copies, found, (replayed.kind != SMOOTH) | ~step.x.is_valid()),
    )
