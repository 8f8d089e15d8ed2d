r"""Progressive photon mapping in media and on surfaces: ``ppm``, and photons where light scatters in a medium.

    x           the vertex of a camera path in a medium, at a sampled distance
    b, d, Φ     a photon within radius r of it, in the same medium; the direction it came along, its scattered power
    L(x)        Σ f(d) Φ / (4/3 π r³ N),    f: the phase function, N: light paths of the pass

Φ is the power that is scattered at b, and the camera path brings T over the density of x, without σs. In scenes with
media whose density varies it is Φ / σs(b), and the camera path has σs(x). Paths of both ends go by null collisions.

Each segment of a camera path has one vertex: where it scatters in a medium, or on the surface behind. All light that is
scattered in a medium comes from photons there. This includes light that arrives directly from lamps: the photons of a
lamp draw its beam in haze.

[Jensen and Christensen 1998, "Efficient Simulation of Light Transport in Scenes with Participating Media using Photon
Maps"; Knaus and Zwicker 2011, section 5]
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from data_gen.paths import media
from data_gen.paths.light_ends import World
from data_gen.paths.segments import Segment, next_surface
from data_gen.paths.vertex import SMOOTH, event_kind
from data_gen.paths.walk import Sky, roulette
from data_gen.samplers.bdpt.vertex import RADIANCE, context
from data_gen.samplers.photons.integrator import MEDIA_MAP_BYTES, PhotonIntegrator, Traced
from data_gen.samplers.photons.map.fog import Fog
from data_gen.samplers.photons.map.grid import Grid
from data_gen.samplers.photons.map.vertices import in_media
from data_gen.samplers.photons.passes import Passes, Start
from data_gen.samplers.photons.ppm import PPM, Gathering


@dataclass(init=False)
class GatheringInMedia:
    """The photons of a map where they are gathered in media; for paths of at most ``max_depth`` edges."""

    photons: Any
    Φ: mi.Spectrum
    grid: Grid
    radius2: mi.Float
    K: mi.Float
    max_depth: mi.UInt32

    def __init__(self, fog: Fog, traced: Traced, max_depth: int):
        self.photons, radius = traced.photons, traced.radius(3)
        self.Φ = fog.power(self.photons)
        dr.eval(self.Φ)
        self.grid = Grid(self.photons.p, in_media(self.photons), radius)
        self.radius2 = dr.opaque(mi.Float, radius**2)
        self.K = dr.opaque(mi.Float, 1 / (4 / 3 * np.pi * radius**3 * traced.paths))
        self.max_depth = dr.opaque(mi.UInt32, max_depth)

    def light(self, x: mi.SurfaceInteraction3f, place: media.Place, depth: mi.UInt32, active: mi.Bool) -> mi.Spectrum:
        """L(x) at a vertex in a medium, behind ``depth`` edges, of paths that are not too long."""
        photons, longest = self.photons, self.max_depth - depth
        phase, seen = place.medium.phase_function(), media.in_medium(x, place)

        def one(i, near):
            j = dr.gather(mi.UInt32, self.grid.index, i, near)
            near = near & (dr.gather(mi.MediumPtr, photons.medium, j, near) == place.medium)
            near &= dr.gather(mi.UInt32, photons.depth, j, near) <= longest
            d, Φ = dr.gather(mi.Vector3f, photons.d, j, near), dr.gather(mi.Spectrum, self.Φ, j, near)
            f, _ = phase.eval_pdf(mi.PhaseFunctionContext(), seen, -d, near)
            return dr.select(near, f * Φ, 0)

        zero = dr.zeros(mi.Spectrum, dr.width(depth))
        return self.K * self.grid.gather(x.p, self.radius2, active, one, zero)


@dataclass
class InBoth:
    on_surfaces: Gathering
    in_media: GatheringInMedia

    def light(self, x, place: media.Place, bsdf: mi.BSDFPtr, depth: mi.UInt32, active: mi.Bool) -> mi.Spectrum:
        scatters = active & place.scatters
        L = self.in_media.light(x, place, depth, scatters)
        return L + self.on_surfaces.light(x, bsdf, depth, active & ~place.scatters)


class VPM(PPM):
    """Progressive photon mapping in media and on surfaces; no gradients.

    Plugin ``vpm``. Parameters, bias and what is not handled: as for ``bre``.
    """

    follows, map_bytes = "volpath", MEDIA_MAP_BYTES

    def near(self, passes: Passes, traced: Traced) -> Iterator[InBoth]:
        world, max_depth = passes.world, self.limits.max_depth
        yield InBoth(Gathering(world, traced, max_depth), GatheringInMedia(world.fog, traced, max_depth))

    def light(self, *path) -> tuple[mi.Spectrum, mi.Spectrum]:
        return by_segments(self, *path)


@dr.syntax
def by_segments(integrator: PhotonIntegrator, world: World, start: Start, near, emission: bool) -> tuple:
    """``ppm.by_vertices()`` through media, from one scattering event or surface to the next.

    ``near.light`` is called with (vertex, its place, its material, depth, where); or there is nothing near.
    """
    scene, fog, limits, random = world.scene, world.fog, integrator.limits, start.random.clone()
    ray, importance = mi.Ray3f(start.ray), start.importance
    connectable, gathered = world.materials.connectable, near.light if near is not None else None
    sky = Sky.from_camera(limits.hide_emitters)
    β, η = mi.Spectrum(importance), mi.Float(1)  # throughput, and the relative index of refraction up to the vertex
    depth = mi.UInt32(1)  # edges up to the vertex si
    # ------------------------- The first vertex --------------------------
    channel, first = media.choose_channel(random.next_1d()), partial(integrator.first_surface, scene, fog.media)
    segment, si = fog.fly(first, ray, fog.within, channel, random, mi.Bool(True))
    place, Le = segment.place, importance * integrator.lamps_in_fog(scene, fog.media, ray, fog.within, channel)
    β *= brought(fog, segment, channel)
    L = dr.zeros(mi.Spectrum, dr.width(ray))
    if dr.hint(emission, mode="scalar"):
        L += β * integrator.behind_grids(scene, fog.media, segment)
    active = si.is_valid() & (depth < limits.max_depth)
    while dr.hint(active, label="camera path"):
        # ------------------ What is gathered at a vertex ------------------
        bsdf = si.bsdf()
        receives = active & (connectable(bsdf) | place.scatters)
        if dr.hint(gathered is not None, mode="scalar"):
            L += β * gathered(si, place, bsdf, depth, receives)

        # ------- The next direction: what scatters widely is gathered ------
        u_lobe, u_direction, u_survival = random.next_1d(), random.next_2d(), random.next_1d()
        sample, f_p = bsdf.sample(context(RADIANCE), si, u_lobe, u_direction, active)
        kind = event_kind(sample.sampled_type)
        found = active & (sample.pdf > 0) & ((kind != SMOOTH) | ~receives)
        sky = sky.behind(kind, found)
        η = dr.select(found, η * sample.eta, η)
        β *= f_p
        survival = roulette(dr.max(β), depth >= limits.rr_depth, η)
        active = found & (dr.max(β) > 0) & (u_survival < survival)
        β /= survival
        depth += 1

        # ------------------- The next vertex, its emission ----------------
        onward = si.spawn_ray(si.to_world(sample.wo))
        segment, si = fog.fly(next_surface(scene), onward, place.toward(si, onward.d), channel, random, active)
        place = segment.place
        β *= brought(fog, segment, channel)
        if dr.hint(emission, mode="scalar"):
            met = active & sky.meets(si)
            L += dr.select(met, β * si.emitter(scene).eval(si, met), 0)
        active &= si.is_valid() & (depth < limits.max_depth)
    return L, Le


def brought(fog: Fog, segment: Segment, channel) -> mi.Spectrum:
    """The integrand of a camera path's segment over its density; without σs, if that is in ``Fog.power()``."""
    if fog.media.grids:
        return segment.weight
    σ_c = media.pick(media.extinction(segment.place.medium, segment.ray), channel)
    # If a medium scatters nothing of a colour, its photons have none of this colour either.
    weight = dr.select(segment.albedo > 0, segment.weight / (segment.albedo * σ_c), 0)
    return mi.Spectrum(dr.select(segment.place.scatters, weight, segment.weight))
