"""The four offset paths of a camera sample where the camera path is connected to a light path."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from data_gen.samplers.bdpt import mis
from data_gen.samplers.bdpt.strategies import connection
from data_gen.samplers.bdpt.vertex import Vertex
from ngpt_studies.gbdpt.base_path import Plan, Step
from ngpt_studies.gbdpt.offset_path import Offset, own_vertex


def connect(plan: Plan, step: Step, y: Vertex, times, offsets: list[Offset], Δ: list) -> tuple:
    """C and ``others`` of the connection from the vertex of ``step`` to the light path's vertex ``y``, and the sums Δ
    with the differences of this connection added ``times`` times."""
    z = step.z
    g, edge, through = connection(plan, z, z.si.bsdf(), y, mi.Bool(True))
    C, others = z.β * g, mis.others_connected(z.end, y.end, edge)
    lit = dr.max(C) > 0
    # ------- Settled copies: the same connection, other weights -------
    busy, sums = mi.Bool(False), []
    for offset, Δ_before in zip(offsets, Δ, strict=True):
        own = offset.apart | offset.joined
        busy |= own
        others1 = mis.others_connected(offset.end, y.end, edge)
        sums.append(Δ_before + dr.select(~own, times * plan.pair(C, others, offset.β * g, offset.r, others1), 0))
    # --------- Others: from the copy's own vertex, one by one ---------
    # The materials of both ends must be connectable, and below also that of the offset path's own vertex.
    both = step.connectable & plan.materials.connectable(y.si.bsdf())

    def one(i, *Δ):
        offset = pick(offsets, i)

        def own(Δ1):
            v = Vertex(own_vertex(offset, z.si), offset.β, offset.end, z.depth)
            bsdf = v.si.bsdf()
            good = lit & (offset.joined | (both & plan.materials.connectable(bsdf)))

            def sees(v, y, lit):
                return plan.sees_alike(v.si, y.si.p, through, lit & offset.apart), through[1]

            g1, edge1, _ = connection(plan, v, bsdf, y, good, sees)
            others1 = mis.others_connected(v.end, y.end, edge1)
            return times * plan.pair(C, others, v.β * g1, offset.r, others1)

        Δ1 = dr.if_stmt((mi.Spectrum(0),), lit & (offset.apart | offset.joined), own, lambda Δ1: Δ1)
        return i + 1, *(dr.select(i == k, old + Δ1, old) for k, old in enumerate(Δ))

    state = (mi.UInt32(0), *sums)
    Δ = dr.while_loop(state, lambda i, *_: busy & lit & (i < len(offsets)), one, label="connected offsets")[1:]
    return C, others, list(Δ)


def pick(offsets: list[Offset], i: mi.UInt32) -> Offset:
    """The offset path number ``i``."""
    found = offsets[0]
    for k, offset in enumerate(offsets[1:], 1):
        found = dr.select(i == k, offset, found)
    return found
