r"""Gradient-domain vertex connection and merging: ``vcm``, and each of its paths shifted to four neighbouring pixels.

Paths that connections, lamps and cameras complete are shifted as ``gbdpt`` shifts them: by one map, under one weight
over all strategies of both ends of a pair, of which merging is one wherever photons are gathered. Paths that merging
completes are shifted without a ray: see ``differences``.

    a pair of x and y       Δ = 2 (b' - b) / (W(x) + r W(y)), W = Σ p_j / p_s over connections and mergings
    merging at z_b          Δ = b' / W(y) - b / W(x), for photons near to both vertices; else -2 b / W(x)

z_b is the camera path's first vertex that scatters widely. The copy of a light path knows η of its own vertices, and
the copy of a camera path those of its own: ``mis`` carries them along.

[Sun et al. 2017, "Gradient-Domain Vertex Connection and Merging", eq. 18-23: there photons are gathered everywhere, and
the edge in front of a photon is shifted, too; here that edge is one of mirrors or glass, and stays]
"""

from __future__ import annotations

from types import SimpleNamespace

import drjit as dr
import mitsuba as mi

from data_gen.film import SHIFTS, GradientFilm
from data_gen.film.splats import Splats
from data_gen.paths.camera import CameraSamples
from data_gen.paths.features import features
from data_gen.paths.spectrum import to_rgb
from data_gen.samplers.common import like_path
from data_gen.samplers.gbdpt.base_path import Plan
from data_gen.samplers.gbdpt.integrator import GBDPT
from data_gen.samplers.gbdpt.light_again import Marker, marked
from data_gen.samplers.gbdpt.light_shift import splat_differences
from data_gen.samplers.photons.passes import Passes
from data_gen.samplers.vcm.differences import ShiftedMerging
from data_gen.samplers.vcm.integrator import VCM
from data_gen.samplers.vcm.merging import Photons, Reader

# Of a camera sample beside that of ``vcm``: the rays of five paths, four Δ, and what of its light path is shifted
OFFSETS_BYTES = 1024


class GVCM(VCM):
    """Gradient-domain vertex connection and merging, for surfaces.

    Plugin ``gvcm``. Parameters are those of ``vcm``; where photons are gathered, paths are connectable as well.

    Not handled: what ``vcm`` does not handle.
    """

    name = "gvcm"
    splatter = Marker
    sample_bytes = VCM.sample_bytes + OFFSETS_BYTES
    # Nanobind allows one base for a class of Mitsuba's.
    shifted_camera_path = GBDPT.shifted_camera_path
    shifted_connection = GBDPT.shifted_connection

    def sample_pass(self, passes: Passes, camera: CameraSamples, film: GradientFilm) -> None:
        """One light path, one camera path, and all their shifts for each camera sample, of which a pixel has one."""
        scene, frozen = passes.world.scene, passes.frozen
        rays = [camera.rays(shift) for shift in ((0, 0), *SHIFTS.values())]
        random = camera.random.clone()
        dr.eval(rays)
        (ray, importance, _), *shifted = rays
        values = frozen(features, scene, camera.sensor, camera.random.clone(), ray, fixed=True)
        ends = scene, passes.world.lights, passes.world.materials, camera.sensor, camera.lens
        photons = None
        if self.vertices and passes.world.lights.emitters is not None:
            random, photons, marks = self.light_paths(passes, camera, random, ray, importance, film.splats("primal"))
            self.shift_splats(passes, camera, film, marks, photons.η)
        L, Le, Δ = frozen(self.seen_shifted, *ends, random, rays, photons, fixed=True)
        values |= {"primal": to_rgb(L + Le, ray.wavelengths), "direct": to_rgb(Le, ray.wavelengths)}
        Δ = [to_rgb(one, ray.wavelengths) for one in Δ]
        dr.eval(values, Δ)
        film.put_all(values)
        for name, value, (_, _, inside) in zip(SHIFTS, Δ, shifted, strict=True):
            film.put(name, value, inside)

    def shift_splats(self, passes: Passes, camera: CameraSamples, film: GradientFilm, marks: mi.UInt64, η) -> None:
        """Splats the differences of light paths that end at ``marked`` vertices, as ``gbdpt`` does."""
        lanes, depths = marked(marks, self.longest)
        ends = passes.world.scene, passes.world.lights, passes.world.materials, camera.sensor
        splats = [film.splats(name) for name in SHIFTS]
        for shift in (self.straight_splats, self.bent_splats):
            if not dr.width(lanes):
                return
            some = camera.at(lanes)
            seen = some.lens, some.time, some.wavelength, some.random, some.rays()[:2], depths
            dr.eval(seen)
            sums, is_bent = passes.frozen(shift, *ends, *seen, η, sums=lambda: [one.zeros() for one in splats])
            dr.eval(sums, is_bent)
            for one, added in zip(splats, sums, strict=True):
                one.take(added)
            if passes.world.materials.all_connectable:
                return
            few = dr.compress(is_bent)
            lanes, depths = dr.gather(mi.UInt32, lanes, few), dr.gather(mi.UInt32, depths, few)

    def straight_splats(self, scene, lights, materials, sensor, *seen) -> tuple:
        """Splats differences of light paths that end at the camera without mirrors or glass in front of it."""
        return self.shifted_splats(scene, lights, materials, sensor, False, *seen)

    def bent_splats(self, scene, lights, materials, sensor, *seen) -> tuple:
        """Splats those of all others, see ``light_shift``."""
        return self.shifted_splats(scene, lights, materials, sensor, True, *seen)

    def shifted_splats(
        self, scene, lights, materials, sensor, bent: bool, lens, time, wavelength, random, rays, depths, η, sums
    ) -> tuple:
        """The ``sums`` with differences of the paths of these samples, and which lanes have bent ones."""
        size = mi.ScalarVector2u(sensor.film().crop_size())
        camera = SimpleNamespace(sensor=sensor, lens=lens, size=size, time=time, wavelength=wavelength, random=random)
        camera.rays = lambda: (*rays, mi.Bool(True))
        splats = [Splats.on(int(dr.prod(size)), 3, one) for one in sums]
        plan = self.plan(lights, materials, η)
        by_name = dict(zip(SHIFTS, splats, strict=True))
        is_bent = splat_differences(scene, plan, camera, depths, self.first_hit, by_name, bent)
        return sums, is_bent

    def plan(self, lights, materials, η: mi.Float | None) -> Plan:
        """That of ``gbdpt``."""
        return Plan(lights, materials, self.max_depth, self.rr_depth, self.longest, η=η)

    def seen_shifted(self, scene, lights, materials, sensor, lens, random, rays, photons: Photons | None) -> tuple:
        """L and Le of camera paths, joined to their own light paths and to the ``photons`` of all; and four Δ."""
        (ray, importance, _), *shifted = rays
        camera, random = SimpleNamespace(sensor=sensor, lens=lens), random.clone()
        path = camera, random, ray, importance, shifted
        if photons is None:
            return self.shifted_camera_path(scene, self.plan(lights, materials, None), *path, None, mi.UInt32(0))[:3]
        kept, merging = photons.kept, ShiftedMerging(photons, materials, self.longest)
        plan = self.plan(lights, materials, photons.η)
        return self.shifted_camera_path(scene, plan, *path, Reader(kept), kept.count, merging=merging)[:3]


def make(scene: mi.Scene, **options):
    """The sampler ``gvcm``, with the parameters of the scene's own ``path``."""
    return like_path(scene, "gvcm", **options).prepare(scene)


mi.register_integrator("gvcm", lambda props: GVCM(props))
