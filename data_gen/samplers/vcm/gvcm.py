r"""Gradient-domain vertex connection and merging: ``vcm``, and each of its paths shifted to four neighbouring pixels.

Paths that connections, lamps and cameras complete are shifted as ``gbdpt`` shifts them: by one map, under one weight
over all strategies of both ends of a pair. Merging is one of these strategies wherever photons are gathered. Paths that
merging completes are shifted without a ray: see ``differences``.

    a pair of x and y       Δ = 2 (b' - b) / (W(x) + r W(y)), W = Σ p_j / p_s over connections and mergings
    merging at z_b          Δ = b' / W(y) - b / W(x), for photons near to both vertices; else -2 b / W(x)

z_b is the camera path's first vertex that scatters widely. The copy of a light path knows η of its own vertices, and
the copy of a camera path knows η of its own: ``mis`` carries them along.

[Sun et al. 2017, "Gradient-Domain Vertex Connection and Merging", eq. 18-23: there photons are gathered everywhere, and
the edge in front of a photon is shifted, too; here that edge is one of mirrors or glass, and stays]
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
from data_gen.paths.spectrum import to_rgb
from data_gen.paths.world import World
from data_gen.samplers.gbdpt.base_path import Plan
from data_gen.samplers.gbdpt.camera_path import shifted_camera_path
from data_gen.samplers.gbdpt.light_again import Marker, marked
from data_gen.samplers.gbdpt.light_shift import splat_differences
from data_gen.samplers.photons.passes import Passes
from data_gen.samplers.vcm.differences import ShiftedMerging
from data_gen.samplers.vcm.integrator import VCM
from data_gen.samplers.vcm.merging import Photons

# What a camera sample takes beyond ``vcm``: the rays of five paths, four Δ, and what of its light path is shifted
OFFSETS_BYTES = 1024


class GVCM(VCM):
    """Gradient-domain vertex connection and merging, for surfaces.

    Plugin ``gvcm``. Parameters: as for ``vcm``; where photons are gathered, paths are connectable as well.

    Not handled: what ``vcm`` does not handle.
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
