"""Photons that are gathered at a camera path, and what they bring to its four offset paths.

A photon stays where it is, whatever path it is gathered at: there is no ray to trace. Symbols as in ``gbdpt``.

At a vertex that both paths share, it is the same photon for both. The path that it ends is shifted by the map of all
other strategies, at the first vertices, and shares their weight.

At an offset path's own vertex it is gathered if it is near to that one, too. All light here comes from mirrors or
glass, so the map of the others rejects these paths; merging shifts them by a map of its own, which keeps the light path
and replays the camera path. r is 1, and weights are for merging only (``pairs.difference_of_one``).
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from data_gen.samplers.bdpt import mis
from data_gen.samplers.bdpt.vertex import Vertex
from data_gen.samplers.gbdpt.offset_path import Offset, own_vertex
from data_gen.samplers.gbdpt.pairs import difference, difference_of_one, weighted
from data_gen.samplers.photons.map.photon import is_near
from data_gen.samplers.vcm.merging import Merging, brought


class ShiftedMerging(Merging):
    """``Merging`` for camera paths with offset paths."""

    def differences(
        self, z: Vertex, bsdf: mi.BSDFPtr, active: mi.Bool, offsets: list[Offset]
    ) -> tuple[mi.Spectrum, list[mi.Spectrum]]:
        """The light of the photons near to the vertex ``z``, weighted; and Δ of the ``offsets``, with it."""
        photons, connectable = self.photons, self.materials.connectable
        active = active & connectable(bsdf)

        # ------------- The copies, the same for all photons --------------
        vertices = [own_vertex(offset, z.si) for offset in offsets]
        materials = [y.bsdf() for y in vertices]
        receives = [
            offset.joined | (offset.apart & y.is_valid() & connectable(material))
            for offset, y, material in zip(offsets, vertices, materials, strict=True)
        ]

        # Along with the base path, or not at all
        alike = [~(offset.apart | offset.joined) for offset in offsets]
        area = self.spread(z.si, active)
        areas = [
            dr.select(offset.apart, self.spread(y, active & offset.apart & own), area)
            for offset, y, own in zip(offsets, vertices, receives, strict=True)
        ]

        def one_more(sums, i, near):
            """The ``sums`` of light and of Δ, with photon ``i`` of the grid."""
            # --------------------- At the base path ----------------------
            photon, end, near = self.photon(i, z, near)
            g, p, q = brought(photon, z.si, bsdf, near)
            g = dr.select(near & dr.isfinite(dr.sum(g)), g, 0)
            C, others = z.β * g * area, mis.others_merged(z.end, q, end, p, photons.η)
            lit, found = dr.max(C) > 0, []

            # ----------------------- At each copy ------------------------
            for k, (offset, y, material, own) in enumerate(zip(offsets, vertices, materials, receives, strict=True)):
                own = own & lit & (offset.joined | is_near(photon, y, photons.radius2))
                g1, p1, q1 = brought(photon, y, material, own)
                g1 = dr.select(alike[k], g, dr.select(own, g1, 0))
                p1, q1 = dr.select(alike[k], p, p1), dr.select(alike[k], q, q1)
                C1, others1 = offset.β * g1 * areas[k], mis.others_merged(offset.end, q1, end, p1, photons.η)
                own_map = difference_of_one(C, others, C1, offset.r, others1)
                found.append(dr.select(offset.apart, own_map, difference(C, others, C1, offset.r, others1)))
            return tuple(total + one for total, one in zip(sums, (weighted(C, others), *found), strict=True))

        zeros = tuple(dr.zeros(mi.Spectrum, dr.width(z.depth)) for _ in (z, *offsets))
        L, *Δ = photons.grid.each(z.si.p, photons.radius2, active, one_more, zeros)
        return photons.K * L, [offset.Δ + photons.K * one for offset, one in zip(offsets, Δ, strict=True)]
