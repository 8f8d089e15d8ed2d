r"""Photon planes: a plane is swept by two edges of a light path; light scattered twice is gathered where a camera
ray meets it.

    a, d        where an edge enters a medium, and its direction; S: how far the edge might go in that medium
    e           the direction in which light was scattered there, somewhere on the edge
    Φ           power at a, times σs f(d, e) / p(e)
    s, t        distances on the edge, and from there along e: a + s d + t e are the points of the plane
    x, w, u     the only point of the plane that is on a camera ray, the ray's direction, distance along the ray
    L           Σ T(s) T(t) T(u) σs f(e) Φ / (|d · (e × w)| (1 - T_c(S)) N),    f: the phase function, N: light paths

The estimate integrates the place of scattering on the edge, the distance from there, and the distance along the ray.
These are the three dimensions of space, so nothing is left to blur, and this part of the light has no bias. Light paths
that scatter in the medium, as 1 - T_c(S) of them do, stand for all distances at which they might have done so. A shadow
ray says whether anything is between the edge and x.

Only one edge sweeps the light that comes to x straight from a lamp or a surface. This light is gathered as in
``beams``, blurred in one dimension. Each path of light is found in one way.

Each ray is crossed with each plane, since a plane is as large as its medium. So few light paths are swept: ``planes``
of a map, however many pixels there are.

[Bitterli and Jarosz 2017, "Beyond Points and Beams: Higher-Dimensional Photon Samples for Volumetric Light Transport",
section 4, the plane of two distances]
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, get_type_hints

import drjit as dr
import mitsuba as mi

from data_gen.paths import media, segments
from data_gen.paths.light_ends import World
from data_gen.samplers.photons.bre import Along, seen_along
from data_gen.samplers.photons.map.trace import VERTICES_PER_PATH
from data_gen.samplers.photons.passes import Passes
from ngpt_studies.photons.map.whole import Traced
from ngpt_studies.photons.media.beams import BEAMS

# Bytes of a plane, and of the edge of a map that it may be swept from
PLANE_BYTES = (18 + 3) * 4


@cache
def planes_class(variant: str) -> type:
    """The class of a map's planes; Mitsuba's types belong to a variant."""

    @dataclass
    class Planes:
        """Planes of light paths as a structure of arrays."""

        a: mi.Point3f
        d: mi.Vector3f
        e: mi.Vector3f
        length: mi.Float  # S
        Φ: mi.Spectrum  # over (1 - T_c(S)) N
        σ: mi.Spectrum
        medium: mi.MediumPtr
        depth: mi.UInt32  # edges from the light, including the plane's edges

        def __len__(self) -> int:
            return dr.width(self.length)

    return Planes


@dataclass
class Crossing:
    """Where a line along ``w`` meets the plane a + s d + t e."""

    s: mi.Float
    t: mi.Float
    u: mi.Float
    volume: mi.Float  # d · (e × w)


def crossing(a, d, e, o, w) -> Crossing:
    """Returns where the line from ``o`` crosses the plane. No value is finite if they are parallel."""
    to, across = o - a, dr.cross(e, w)
    volume = dr.dot(d, across)
    n = dr.cross(d, e)
    return Crossing(dr.dot(to, across) / volume, dr.dot(d, dr.cross(to, w)) / volume, -dr.dot(to, n) / volume, volume)


@dataclass
class AcrossPlanes:
    world: World
    planes: Any
    number: mi.UInt32
    max_depth: mi.UInt32

    def light(self, ray, length, medium: mi.MediumPtr, σ: mi.Spectrum, depth: mi.UInt32, active) -> mi.Spectrum:
        """Σ of the planes that a piece of a ray through one ``medium`` meets, of paths that are not too long.

        ``depth`` is the number of the segment; T(u) is of the piece only.
        """
        longest = self.max_depth - depth
        seen, scattering = seen_along(ray, medium), scattered_of(medium, ray, active)

        def add(sums, i, met):
            met = met & (dr.gather(mi.UInt32, self.planes.depth, i, met) <= longest)
            plane, at = self.plane(i, met), self.crossing(i, ray, met)
            T = self.transmitted(plane, at, medium, met)
            f, _ = medium.phase_function().eval_pdf(mi.PhaseFunctionContext(), seen, -plane.e, met)
            one = T * plane.Φ * (f * dr.exp(-σ * at.u) * scattering / dr.abs(at.volume))
            return (sums[0] + dr.select(met & dr.isfinite(dr.sum(one)), one, 0),)

        return self.each(ray, length, active, add, (dr.zeros(mi.Spectrum, dr.width(length)),))[0]

    def each(self, ray, length, active, visit, state: tuple) -> tuple:
        """``state`` after ``visit`` (state, number of the plane, whether a piece of a ray meets it) for all planes."""

        def step(i, state):
            at = self.crossing(i, ray, active)
            met = active & (at.s > 0) & (at.s < dr.gather(mi.Float, self.planes.length, i, active))
            return i + 1, visit(state, i, met & (at.t > 0) & (at.u > 0) & (at.u < length))

        first = dr.zeros(mi.UInt32, dr.width(length))
        return dr.while_loop((first, state), lambda i, _: active & (i < self.number), step, label="planes")[1]

    def plane(self, i: mi.UInt32, active=True):
        fields = get_type_hints(type(self.planes))
        return type(self.planes)(*(dr.gather(t, getattr(self.planes, name), i, active) for name, t in fields.items()))

    def crossing(self, i: mi.UInt32, ray, active) -> Crossing:
        a = dr.gather(mi.Point3f, self.planes.a, i, active)
        d, e = dr.gather(mi.Vector3f, self.planes.d, i, active), dr.gather(mi.Vector3f, self.planes.e, i, active)
        return crossing(a, d, e, ray.o, ray.d)

    def transmitted(self, plane, at: Crossing, medium: mi.MediumPtr, active) -> mi.Spectrum:
        """T(s) T(t) of planes; 0 where anything is in the way, or x would be in another ``medium``."""
        ray = media.shortened(mi.Ray3f(plane.a + plane.d * at.s, plane.e), at.t)
        trace = segments.next_surface(self.world.scene)
        τ, met, _, there = segments.cross(
            self.world.fog.media.passes, trace, ray, plane.medium, at.t, active=active, target=None
        )
        return dr.select(active & ~met.is_valid() & (there == medium), dr.exp(-plane.σ * at.s - τ), 0)


def scattered_of(medium: mi.MediumPtr, ray, active) -> mi.Spectrum:
    """σs of a homogeneous medium."""
    here = dr.zeros(mi.MediumInteraction3f, dr.width(ray.o))
    here.p, here.wavelengths, here.medium = ray.o, ray.wavelengths, medium
    return medium.get_scattering_coefficients(here, active)[0]


def after_scattering(photons) -> mi.Bool:
    """Returns which edges of a map begin where light was scattered in a medium."""
    later = photons.bounce > 1
    parent = dr.gather(mi.Normal3f, photons.n, photons.parent, later)
    return later & (dr.squared_norm(parent) == 0)


def only_beams(traced: Traced) -> Traced:
    """Returns the map without the edges that are the last edge of a plane."""
    photons = traced.photons
    others = replace(photons, bounce=dr.select(after_scattering(photons), 0, photons.bounce))
    dr.eval(others.bounce)
    return replace(traced, photons=others)


def planes_of(passes: Passes, traced: Traced) -> AcrossPlanes:
    """Returns the planes of some light paths of a map, or one that no ray meets if there are none. All paths have the
    same distribution, so every k-th stands for k. Further maps have fewer paths.
    """
    integrator, photons, kind = passes.integrator, traced.photons, planes_class(mi.variant())
    lanes, most = len(photons) // VERTICES_PER_PATH, integrator.options["planes"]
    k = (lanes + most - 1) // most
    taken = (lanes + k - 1) // k
    slot = dr.arange(mi.UInt32, taken * VERTICES_PER_PATH)
    slot += (slot // VERTICES_PER_PATH) * ((k - 1) * VERTICES_PER_PATH)
    edges = dr.gather(mi.UInt32, slot, dr.compress(dr.gather(mi.Bool, after_scattering(photons), slot)))
    number = dr.width(edges)
    if number:
        weight = dr.opaque(mi.Float, lanes / (taken * traced.paths))
        planes = passes.frozen(swept, passes.world.scene, photons, edges, weight)
    else:
        planes = kind(*(dr.zeros(t, 1) for t in get_type_hints(kind).values()))
    dr.eval(planes)
    number, longest = dr.opaque(mi.UInt32, number), dr.opaque(mi.UInt32, integrator.limits.max_depth)
    return AcrossPlanes(passes.world, planes, number, longest)


def swept(scene, photons, edges: mi.UInt32, weight: mi.Float):
    """The planes whose last edges are these."""
    before = dr.gather(mi.UInt32, photons.parent, edges)
    p, d = dr.gather(mi.Point3f, photons.p, before), dr.gather(mi.Vector3f, photons.d, before)
    since, channel = dr.gather(mi.Float, photons.t, before), dr.gather(mi.UInt32, photons.channel, before)
    medium = dr.gather(mi.MediumPtr, photons.medium, before)
    hit = scene.ray_intersect_preliminary(mi.Ray3f(p, d))
    length = since + dr.select(hit.is_valid(), hit.t, dr.inf)
    σ = media.extinction(medium, mi.Ray3f(p, d))
    σ_c = media.pick(σ, channel)
    # 1 - exp(-τ), precise for thin media
    half = dr.tanh(dr.minimum(0.5 * σ_c * length, 40))
    Φ = dr.gather(mi.Spectrum, photons.power, edges) * dr.exp((σ - σ_c) * since) * (σ_c * (1 + half) / (2 * half))
    e, depth = dr.gather(mi.Vector3f, photons.e, edges), dr.gather(mi.UInt32, photons.bounce, edges)
    kind = planes_class(mi.variant())
    Φ = dr.select(dr.isfinite(dr.sum(Φ)), Φ * weight, 0)
    return kind(mi.Point3f(p - d * since), d, e, length, Φ, σ, medium, depth)


class PLANES(BEAMS):
    """Photon planes for light scattered in homogeneous media twice or more, beams and photons for the rest.

    Plugin ``planes``, without gradients. Parameters, and what is not handled: as for ``beams``, and

    ``planes``  64, light paths of a map that are swept, whatever the number of pixels

    Unbiased in what is scattered twice in media, apart from Monte Carlo noise; biased and consistent in all else.
    """

    map_bytes = BEAMS.map_bytes + VERTICES_PER_PATH * PLANE_BYTES

    def near(self, passes: Passes, traced: Traced) -> Iterator[Along]:
        yield from super().near(passes, only_beams(traced))
        yield Along(None, planes_of(passes, traced))
