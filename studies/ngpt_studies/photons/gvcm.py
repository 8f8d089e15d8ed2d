r"""Gradient-domain vertex connection and merging: ``vcm``, and each of its paths shifted to four neighbouring pixels.

Paths that connections, lamps and cameras complete are shifted as ``gbdpt`` shifts them: by one map, under one weight
over all strategies of both ends of a pair. Merging is one of these strategies wherever photons are gathered.

    a pair of x and y       Δ = 2 (b' - b) / (W(x) + r W(y)), W = Σ p_j / p_s over connections and mergings
    merging at z_b          Δ = b' / W(y) - b / W(x), for photons near to both vertices; else -2 b / W(x)

z_b is the camera path's first vertex that scatters widely. The copy of a light path knows η of its own vertices, and
the copy of a camera path knows η of its own: ``mis`` carries them along.

[Sun et al. 2017, "Gradient-Domain Vertex Connection and Merging", eq. 18-23: there photons are gathered everywhere, and
the edge in front of a photon is shifted, too; here that edge is one of mirrors or glass, and stays]

A photon stays where it is, whatever path it is gathered at: there is no ray to trace. Symbols are as in ``gbdpt``. At a
vertex that both paths share, it is the same photon for both. The path that it ends is shifted by the map of all other
strategies, at the first vertices, and shares their weight. At an offset path's own vertex it is gathered if it is near
to that one, too. All light here comes from mirrors or glass, so the map of the others rejects these paths; merging
shifts them by a map of its own, which keeps the light path and replays the camera path. r is 1, and weights are for
merging only (``pairs.difference_of_one``).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi

from data_gen.film import SHIFTS, GradientFilm
from data_gen.film.splats import Splats
from data_gen.paths.camera import CameraSamples
from data_gen.paths.eye import Sight
from data_gen.paths.features import features
from data_gen.paths.light_ends import World
from data_gen.paths.spectrum import to_rgb
from data_gen.samplers.bdpt import mis
from data_gen.samplers.bdpt.vertex import Vertex
from data_gen.samplers.photons.passes import Passes
from data_gen.samplers.vcm.integrator import VCM
from data_gen.samplers.vcm.merging import Merging, Photons, brought
from ngpt_studies.gbdpt.base_path import Plan
from ngpt_studies.gbdpt.camera_path import shifted_camera_path
from ngpt_studies.gbdpt.light_again import Marker, marked
from ngpt_studies.gbdpt.light_shift import splat_differences
from ngpt_studies.gbdpt.offset_path import Offset, own_vertex
from ngpt_studies.gbdpt.pairs import difference, difference_of_one, weighted
from ngpt_studies.photons.map.vertices import is_near


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


# What a camera sample takes beyond ``vcm``: the rays of five paths, four Δ, and what of its light path is shifted
OFFSETS_BYTES = 1024


class GVCM(VCM):
    """Gradient-domain vertex connection and merging, for surfaces.

    Plugin ``gvcm``. Parameters, and what is not handled: as for ``vcm``; where photons are gathered, paths are
    connectable as well.
    """

    splatter, plan_class = Marker, Plan
    sample_bytes = VCM.sample_bytes + OFFSETS_BYTES

    def sample_pass(self, passes: Passes, camera: CameraSamples, film: GradientFilm) -> None:
        """Traces one light path, one camera path, and all their shifts for each sample; a pixel has one sample."""
        world, frozen, sight, photons = passes.world, passes.frozen, Sight.of(camera), None
        shifted = [camera.rays(shift) for shift in SHIFTS.values()]
        dr.eval(sight.ray, sight.importance, shifted)
        values = frozen(features, world.scene, camera.sensor, camera.random.clone(), sight.ray)
        if self.plan(world).joins:
            photons, sight, marks = self.light_pass(passes, sight, camera, film.splats("primal"))
            self.shift_splats(passes, camera, film, marks, photons.η)
        L, Le, Δ = frozen(self.shifted_camera_pass, world, sight, shifted, photons)
        values |= {"primal": to_rgb(L + Le, sight.ray.wavelengths), "direct": to_rgb(Le, sight.ray.wavelengths)}
        Δ = [to_rgb(one, sight.ray.wavelengths) for one in Δ]
        dr.eval(values, Δ)
        film.put_all(values)
        for name, value, (_, _, inside) in zip(SHIFTS, Δ, shifted, strict=True):
            film.put(name, value, inside)

    # ------------------- Light paths that end at the camera: shifts ------------------

    def shift_splats(
        self, passes: Passes, camera: CameraSamples, film: GradientFilm, marks: mi.UInt64, η: mi.Float
    ) -> None:
        """Splats the differences of light paths that end at ``marked`` vertices, as ``gbdpt`` does."""
        lanes, depths = marked(marks, self.longest)
        splats = [film.splats(name) for name in SHIFTS]
        for bent in (False, True):
            if not dr.width(lanes):
                return
            sight = Sight.of(camera.at(lanes))
            dr.eval(sight, depths)
            sums, is_bent = passes.frozen(
                self.shifted_splats, passes.world, sight, depths, η, bent, sums=lambda: [one.zeros() for one in splats]
            )
            dr.eval(sums, is_bent)
            for one, added in zip(splats, sums, strict=True):
                one.take(added)
            if passes.world.materials.all_connectable:
                return
            few = dr.compress(is_bent)
            lanes, depths = dr.gather(mi.UInt32, lanes, few), dr.gather(mi.UInt32, depths, few)

    def shifted_splats(self, world: World, sight: Sight, depths: mi.UInt32, η: mi.Float, bent: bool, sums: Any):
        """The ``sums`` with differences of these light paths, and which lanes have bent ones, see ``light_shift``."""
        splats = {name: Splats.on(sight.eye.pixels, 3, one) for name, one in zip(SHIFTS, sums, strict=True)}
        return sums, splat_differences(self.plan(world, η=η), sight, depths, splats, bent)

    # -------------------- Camera paths and copies: joins, and merges -----------------

    def shifted_camera_pass(self, world: World, sight: Sight, shifted: list, photons: Photons | None) -> tuple:
        """L and Le of camera paths, joined to their own light paths and to the ``photons`` of all; and four Δ."""
        sight = replace(sight, random=sight.random.clone())
        if photons is None:
            return shifted_camera_path(self.plan(world), sight, shifted, None)[:3]
        plan = self.plan(world, η=photons.η)
        merging = ShiftedMerging(photons, plan)
        return shifted_camera_path(plan, sight, shifted, photons.kept.paths(), merging)[:3]
