r"""The beam radiance estimate: photons in media are gathered along whole rays, not near to points on them.

    b, d, Φ     a photon within radius r of a segment of the camera path, in the same medium; its direction, its power
    t           the distance from where the segment begins to where b is beside it
    T(t)        what the media let through up to there, in each colour
    L           Σ T(t) f(d) Φ / (π r² N),    f: the phase function, N: light paths of the pass

Camera paths go through media up to the next surface. So no distance is sampled, each segment gathers from all of its
length, and what is blurred is two-dimensional: less noise, and less bias, than with ``vpm``, of the same photons.

[Jarosz et al. 2008, "The Beam Radiance Estimate for Volumetric Photon Mapping"; the radius: radius.py]
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from data_gen.passes import SamplePass
from data_gen.paths import media
from data_gen.paths.vertex import NULL, SMOOTH, event_kind
from data_gen.samplers.bdpt.vertex import RADIANCE, context
from data_gen.samplers.common import like_path
from data_gen.samplers.photons.grid import Grid
from data_gen.samplers.photons.ppm import Gathering
from data_gen.samplers.photons.radius import shrunk
from data_gen.samplers.photons.vpm import VPM

# Of the grid, what is gathered within one radius of a ray: in parts 3 radii long, each in a ball of this many radii.
BALL = np.sqrt(1 + 1.5**2)


@dataclass(init=False)
class AlongRays:
    """The photons of a map in media, gathered within ``radius`` of rays; ``paths`` light paths have brought them."""

    photons: Any
    grid: Grid
    radius2: mi.Float
    K: mi.Float
    max_depth: mi.UInt32

    def __init__(self, photons, radius: float, paths: int, max_depth: int):
        self.photons = photons
        scattered = (photons.depth > 0) & (dr.squared_norm(photons.n) == 0)
        self.grid = Grid(photons.p, scattered, BALL * radius)
        self.radius2 = dr.opaque(mi.Float, radius**2)
        self.K = dr.opaque(mi.Float, 1 / (np.pi * radius**2 * paths))
        self.max_depth = dr.opaque(mi.UInt32, max_depth)

    def light(self, ray, length, medium: mi.MediumPtr, σ: mi.Spectrum, depth: mi.UInt32, active) -> mi.Spectrum:
        """Σ of the photons beside a piece of a ray through one ``medium``, of paths that are not too long.

        ``depth`` is the number of the segment, T that of the piece alone.
        """
        photons, longest = self.photons, self.max_depth - depth
        phase = medium.phase_function()
        seen = seen_along(ray, medium)

        def add(sums, i, near):
            j = dr.gather(mi.UInt32, self.grid.index, i, near)
            near = near & (dr.gather(mi.MediumPtr, photons.medium, j, near) == medium)
            near &= dr.gather(mi.UInt32, photons.depth, j, near) <= longest
            d, Φ = dr.gather(mi.Vector3f, photons.d, j, near), dr.gather(mi.Spectrum, photons.β, j, near)
            t = dr.dot(dr.gather(mi.Point3f, self.grid.p, i, near) - ray.o, ray.d)
            f, _ = phase.eval_pdf(mi.PhaseFunctionContext(), seen, -d, near)
            return (sums[0] + dr.select(near, f * Φ * dr.exp(-σ * t), 0),)

        zero = dr.zeros(mi.Spectrum, dr.width(length))
        return self.K * self.grid.along(ray, length, self.radius2, active, add, (zero,))[0]


def seen_along(ray, medium: mi.MediumPtr) -> mi.MediumInteraction3f:
    """Places in a ``medium`` as its phase function knows them, for light that is scattered against the ray."""
    seen = dr.zeros(mi.MediumInteraction3f, dr.width(ray.d))
    seen.p, seen.time, seen.wavelengths, seen.medium = ray.o, ray.time, ray.wavelengths, medium
    seen.wi, seen.sh_frame = -ray.d, mi.Frame3f(-ray.d)
    return seen


@dataclass
class Both:
    """Photons on surfaces, and photons in media."""

    on_surfaces: Gathering | None
    in_media: Any


class BRE(VPM):
    """Progressive photon mapping by the beam radiance estimate in homogeneous media, and on surfaces; no gradients.

    Plugin ``bre``. Parameters, bias and what is not handled are those of ``vpm``; nor are media whose
    density varies.
    """

    name = "bre"
    grids = False

    def gathering(self, photons, width: float, number: int, paths: int):
        if self.fog is None:
            return super().gathering(photons, width, number, paths)
        radius = self.radius * width * shrunk(number)
        near = photons, radius, paths, self.max_depth
        return Both(Gathering(*near), AlongRays(*near))

    def light(self, scene, materials, random, ray, importance, near, emission: bool):
        if self.fog is None:
            return super().light(scene, materials, random, ray, importance, near, emission)
        parts = (near.on_surfaces, near.in_media) if near is not None else (None, None)
        gather = (None if part is None else part.light for part in parts)
        return self.path_in_media(scene, materials, random.clone(), ray, importance, *gather, emission)

    @dr.syntax
    def path_in_media(self, scene, materials, random, ray, importance, at_surface, along, emission: bool):
        """``camera_path()`` through media, piece by piece from boundary to boundary.

        ``along`` is called with (piece of a ray, length, medium, σ, depth, where), ``at_surface`` as there; or neither.
        """
        fog, ray, medium = self.fog, mi.Ray3f(ray), mi.MediumPtr(self.fog.within)
        Le = importance * self.lamps_in_fog(scene, fog.media, ray, fog.within, mi.UInt32(0))
        L = dr.zeros(mi.Spectrum, dr.width(ray))
        β, η, depth = mi.Spectrum(importance), mi.Float(1), mi.UInt32(1)
        # An environment that hides from the camera hides as well behind holes, where nothing has been scattered yet.
        sky_seen, active = mi.Bool(not self.hide_emitters), mi.Bool(True)
        while dr.hint(active, label="camera path"):
            # ------------------ A piece of a segment ------------------
            first = depth == 1
            if dr.hint(self.hide_emitters, mode="scalar"):
                hit = self.first_surface(scene, ray, medium, active & first)
                later = scene.ray_intersect_preliminary(ray, active=active & ~first)
                hit = dr.select(first, hit, later)
            else:
                hit = scene.ray_intersect_preliminary(ray, active=active)
            si = hit.compute_surface_interaction(ray, active=active)
            σ, found = media.extinction(medium, ray), active & hit.is_valid()
            length = dr.select(found, hit.t, dr.inf)
            if dr.hint(along is not None, mode="scalar"):
                inside = active & (medium != None)  # noqa: E711 - an array of pointers
                L += β * along(ray, length, medium, σ, depth, inside)
            β *= dr.exp(-media.depth(σ, length))
            if dr.hint(emission, mode="scalar"):
                met = active & ~first & (found | sky_seen)
                L += dr.select(met, β * si.emitter(scene).eval(si, met), 0)

            # ------------------ The vertex at its end -----------------
            passes = found & fog.media.passes(hit.shape)
            active = found & ~passes & (depth < self.max_depth)
            bsdf = si.bsdf()
            receives = active & materials.connectable(bsdf)
            if dr.hint(at_surface is not None, mode="scalar"):
                L += β * at_surface(si, None, bsdf, depth, receives)
            u_lobe, u_direction, u_survival = random.next_1d(), random.next_2d(), random.next_1d()
            sample, f_p = bsdf.sample(context(RADIANCE), si, u_lobe, u_direction, active)
            kind = event_kind(sample.sampled_type)
            active &= (sample.pdf > 0) & ((kind != SMOOTH) | ~receives)
            sky_seen |= active & (kind != NULL)
            η = dr.select(active, η * sample.eta, η)
            β = dr.select(passes, β, β * f_p)
            # As in ``path``: η² undoes what refraction does to radiance, and none survives for ever.
            survival = dr.select(depth < self.rr_depth, 1, dr.fmin(dr.max(β) * dr.square(η), 0.95))
            active &= (dr.max(β) > 0) & (u_survival < survival)
            β = dr.select(passes, β, β / survival)
            depth = dr.select(active, depth + 1, depth)
            d = dr.select(passes, ray.d, si.to_world(sample.wo))
            changes = found & si.is_medium_transition()
            medium = dr.select(changes, si.target_medium(d), medium)
            ray, active = si.spawn_ray(d), active | passes
        return L, Le


def make(scene: mi.Scene, **options) -> SamplePass:
    """The sampler ``bre``, with the parameters of the scene's own ``volpath`` or ``path``."""
    return like_path(scene, "bre", **options).prepare(scene)


mi.register_integrator("bre", lambda props: BRE(props))
