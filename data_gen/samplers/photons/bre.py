r"""The beam radiance estimate: photons in media are gathered along whole rays, not near points on them.

    b, d, Φ     a photon within radius r of a segment of the camera path, in the same medium; its direction; its power
    t           the distance along the segment to the point nearest to b
    T(t)        the transmittance of the media up to the distance t, in each colour
    L           Σ T(t) f(d) Φ / (π r² N),    f: the phase function, N: light paths of the pass

Camera paths go through media up to the next surface. No distance is sampled, each segment gathers over its whole
length, and the blur is two-dimensional. So the same photons give less noise and less bias than if they were gathered
near points.

In grids, which are media whose density varies, T is not known. There a ray samples collisions and ends at the first
real collision, so it reaches a point with the probability T. A photon counts as Φ / σs, where σs is the scattering
coefficient at the photon, times σs at the nearest point of the ray.

[Jarosz et al. 2008, "The Beam Radiance Estimate for Volumetric Photon Mapping"; Křivánek et al. 2014, "Unifying Points,
Beams, and Paths in Volumetric Light Transport Simulation", short beams; the radius: radius.py]
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from data_gen.paths import collisions, media
from data_gen.paths.light_ends import World
from data_gen.paths.vertex import SMOOTH, event_kind
from data_gen.paths.walk import Sky, roulette
from data_gen.samplers.bdpt.vertex import RADIANCE, context
from data_gen.samplers.photons.integrator import MEDIA_MAP_BYTES, PhotonIntegrator, Traced
from data_gen.samplers.photons.map.fog import Fog
from data_gen.samplers.photons.map.grid import Grid
from data_gen.samplers.photons.map.vertices import in_media
from data_gen.samplers.photons.passes import Passes, Start
from data_gen.samplers.photons.ppm import PPM, Gathering

# A ray is cut into parts 3 radii long. The points within one radius of a part lie in a ball of this many radii.
BALL = np.sqrt(1 + 1.5**2)


@dataclass(init=False)
class AlongRays:
    """The photons of a map, to be gathered along rays; for paths of at most ``max_depth`` edges."""

    photons: Any
    Φ: mi.Spectrum
    grid: Grid
    radius2: mi.Float
    K: mi.Float
    max_depth: mi.UInt32
    grids: bool

    def __init__(self, fog: Fog, traced: Traced, max_depth: int):
        self.photons, self.grids, radius = traced.photons, fog.media.grids, traced.radius()
        self.Φ = fog.power(self.photons)
        dr.eval(self.Φ)
        self.grid = Grid(self.photons.p, in_media(self.photons), BALL * radius)
        self.radius2 = dr.opaque(mi.Float, radius**2)
        self.K = dr.opaque(mi.Float, 1 / (np.pi * radius**2 * traced.paths))
        self.max_depth = dr.opaque(mi.UInt32, max_depth)

    def light(self, ray, length, medium: mi.MediumPtr, σ: mi.Spectrum, depth: mi.UInt32, active) -> mi.Spectrum:
        """Returns the light of photons beside a piece of a ray through one ``medium`` with the extinction ``σ``.

        ``depth`` is the number of the segment that contains the piece. Photons that would make a path too long are left
        out. Here T is only the transmittance within the piece.
        """
        photons, longest = self.photons, self.max_depth - depth
        phase = medium.phase_function()
        seen, scattering = seen_along(ray, medium), scattering_along(ray, medium) if self.grids else None

        def add(sums, i, near):
            j = dr.gather(mi.UInt32, self.grid.index, i, near)
            near = near & (dr.gather(mi.MediumPtr, photons.medium, j, near) == medium)
            near &= dr.gather(mi.UInt32, photons.depth, j, near) <= longest
            d, Φ = dr.gather(mi.Vector3f, photons.d, j, near), dr.gather(mi.Spectrum, self.Φ, j, near)
            t = dr.dot(dr.gather(mi.Point3f, self.grid.p, i, near) - ray.o, ray.d)
            if dr.hint(self.grids, mode="scalar"):
                Φ *= scattering(t, near)
            f, _ = phase.eval_pdf(mi.PhaseFunctionContext(), seen, -d, near)
            return (sums[0] + dr.select(near, f * Φ * dr.exp(-σ * t), 0),)

        zero = dr.zeros(mi.Spectrum, dr.width(length))
        return self.K * self.grid.along(ray, length, self.radius2, active, add, (zero,))[0]


def seen_along(ray, medium: mi.MediumPtr) -> mi.MediumInteraction3f:
    """Interactions for the phase function of a ``medium``, for light that is scattered against the ray."""
    seen = dr.zeros(mi.MediumInteraction3f, dr.width(ray.d))
    seen.p, seen.time, seen.wavelengths, seen.medium = ray.o, ray.time, ray.wavelengths, medium
    seen.wi, seen.sh_frame = -ray.d, mi.Frame3f(-ray.d)
    return seen


def scattering_along(ray, medium: mi.MediumPtr) -> Callable[[mi.Float, mi.Bool], mi.Spectrum]:
    """A function (distance, active) -> σs of a ``medium`` along a ray. A grid is empty outside of its box."""
    _, _, near, far = collisions.extent(medium, ray)

    def scattering(t: mi.Float, active: mi.Bool) -> mi.Spectrum:
        here, active = dr.zeros(mi.MediumInteraction3f, dr.width(t)), active & (t >= near) & (t <= far)
        here.t, here.p, here.wavelengths, here.medium = t, ray(t), ray.wavelengths, medium
        return mi.Spectrum(dr.select(active, medium.get_scattering_coefficients(here, active)[0], 0))

    return scattering


@dataclass
class Along:
    """The photons that camera paths gather in ``by_pieces()``: on surfaces and in media."""

    on_surfaces: Gathering | None
    in_media: Any  # has ``light`` (piece of a ray, length, medium, σ, depth, active)


class BRE(PPM):
    """Progressive photon mapping by the beam radiance estimate in media, and on surfaces; no gradients.

    Plugin ``bre``. Parameters: as for ``ppm``; the ``radius`` of the first pass is also used for photons in media.

    Biased, and consistent: the mean over passes converges to the image of ``volpath``.

    Not handled: light from infinitely far away through a medium without bounds, scenes without media, and what ``ppm``
    does not handle, except media.
    """

    follows, map_bytes = "volpath", MEDIA_MAP_BYTES

    def near(self, passes: Passes, traced: Traced) -> Iterator[Along]:
        world, max_depth = passes.world, self.limits.max_depth
        yield Along(Gathering(world, traced, max_depth), AlongRays(world.fog, traced, max_depth))

    def light(self, *path) -> tuple[mi.Spectrum, mi.Spectrum]:
        return by_pieces(self, *path)


@dr.syntax
def by_pieces(integrator: PhotonIntegrator, world: World, start: Start, near, emission: bool) -> tuple:
    """As ``by_vertices()``, but camera paths go through media, piece by piece from boundary to boundary."""
    scene, fog, limits, random = world.scene, world.fog, integrator.limits, start.random.clone()
    connectable = world.materials.connectable
    parts = (near.on_surfaces, near.in_media) if near is not None else (None, None)
    at_surface, along = (None if part is None else part.light for part in parts)
    ray, medium = mi.Ray3f(start.ray), mi.MediumPtr(fog.within)  # a piece, and its medium
    importance = start.importance
    Le = importance * integrator.lamps_in_fog(scene, fog.media, ray, fog.within, mi.UInt32(0))
    L = dr.zeros(mi.Spectrum, dr.width(ray))
    β, η = mi.Spectrum(importance), mi.Float(1)  # throughput and relative index of refraction at the piece
    depth = mi.UInt32(1)  # the number of the segment that contains the piece
    sky, active = Sky.from_camera(limits.hide_emitters), mi.Bool(True)
    # In scenes with grids: whether the path has gone through a grid, and whether it continues behind a null collision
    grids, behind, skips = fog.media.grids, mi.Bool(False), mi.Bool(False)
    if dr.hint(grids, mode="scalar"):
        channel = media.choose_channel(random.next_1d())
    while dr.hint(active, label="camera path"):
        # ------------------ A piece of a segment ------------------
        first = depth == 1
        if dr.hint(limits.hide_emitters, mode="scalar"):
            hit = integrator.first_surface(scene, fog.media, ray, medium, active & first)
            later = scene.ray_intersect_preliminary(ray, active=active & ~first)
            hit = dr.select(first, hit, later)
        else:
            hit = scene.ray_intersect_preliminary(ray, active=active)
        si = hit.compute_surface_interaction(ray, active=active)
        σ, found = media.extinction(medium, ray), active & hit.is_valid()
        length = dr.select(found, hit.t, media.end_of(ray))
        if dr.hint(grids, mode="scalar"):
            ahead, u_real = -dr.log(1 - random.next_1d()), random.next_1d()
            stop = collisions.next_stop(ray, length, medium, channel, ahead, active)
            σ, length = dr.select(stop.grid, 0, σ), stop.t
        if dr.hint(along is not None, mode="scalar"):
            inside = active & (medium != None)  # noqa: E711 - an array of pointers
            L += β * along(ray, length, medium, σ, depth, inside)
        β *= dr.exp(-media.depth(σ, length))
        if dr.hint(grids, mode="scalar"):
            real = stop.collides & (u_real < media.pick(stop.real, channel))
            skips = stop.collides & ~real
            β = dr.select(skips, β * stop.null, β)
            active &= ~stop.collides
            found &= active
        if dr.hint(emission, mode="scalar"):
            met = active & ~first & (found | sky.seen)
            if dr.hint(grids and limits.shows, mode="scalar"):
                # Le leaves out light that comes through a grid, and the light of the sky: see ``behind_grids()``. Here
                # both are added to L.
                behind |= stop.passed > 0
                met |= active & first & (behind | ~found)
            L += dr.select(met, β * si.emitter(scene).eval(si, met), 0)

        # ------------------ The vertex at its end -----------------
        passes = found & fog.media.passes(hit.shape)
        active = found & ~passes & (depth < limits.max_depth)
        bsdf = si.bsdf()
        receives = active & connectable(bsdf)
        if dr.hint(at_surface is not None, mode="scalar"):
            L += β * at_surface(si, bsdf, depth, receives)

        # -------------------- The next piece ----------------------
        u_lobe, u_direction, u_survival = random.next_1d(), random.next_2d(), random.next_1d()
        sample, f_p = bsdf.sample(context(RADIANCE), si, u_lobe, u_direction, active)
        kind = event_kind(sample.sampled_type)
        active &= (sample.pdf > 0) & ((kind != SMOOTH) | ~receives)
        sky = sky.behind(kind, active)
        η = dr.select(active, η * sample.eta, η)
        straight = passes | skips
        β = dr.select(straight, β, β * f_p)
        survival = roulette(dr.max(β), depth >= limits.rr_depth, η)
        active &= (dr.max(β) > 0) & (u_survival < survival)
        β = dr.select(straight, β, β / survival)
        depth = dr.select(active, depth + 1, depth)
        d = dr.select(passes, ray.d, si.to_world(sample.wo))
        changes = found & si.is_medium_transition()
        medium = dr.select(changes, si.target_medium(d), medium)
        onward = si.spawn_ray(d)
        if dr.hint(grids, mode="scalar"):
            skips &= dr.max(β) > 0
            onward = dr.select(skips, mi.Ray3f(ray(length), ray.d, ray.time, ray.wavelengths), onward)
        ray, active = onward, active | passes | skips
    return L, Le
