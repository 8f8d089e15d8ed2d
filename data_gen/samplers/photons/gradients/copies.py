"""Photons and their copies near the vertex of a neighbouring pixel's path: by ``shift``, what light they bring there.

    a           the predecessor of photon b: a vertex of its light path, or the point of the lamp where it begins
    Φ, Φ'       power of photon and copy, both with the density of the photon's path
    p, p'       densities of the directions d and d' at a, without Russian roulette: it is on top of a pair of paths
    r           p' J / p

A photon that came from a by a mirror, or through glass, has no copy: light goes there in one direction. Nor is there
one where anything is in the way, or where the copy lies outside the radius or on a surface that faces another way. What
a photon must fulfil the copy must, too, so that both directions of a difference reject alike.

In media a may be where light was scattered. Distances have densities, in the colour c of the light path: T' is in Φ',
and T'_c / T_c in r. Boundaries that bend nothing may lie between a and b, or b'. There b' must be in the medium of b.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from data_gen.paths import collisions, media, segments
from data_gen.paths.collisions import Collisions
from data_gen.paths.light_ends import LightEnds, LightRay
from data_gen.samplers.bdpt.vertex import IMPORTANCE, evaluate
from data_gen.samplers.photons.gradients import shift
from data_gen.samplers.photons.map.photon import Photon, is_near
from data_gen.samplers.photons.map.trace import vertex_in_media_of, vertex_of


@dataclass
class Way:
    """How light comes from a to the point ``target``, or in its direction."""

    ray: mi.Ray3f
    Φ: mi.Spectrum  # without J
    ratio: mi.Float  # p' / p
    length2: mi.Float  # squared, from a to the target; 1 from infinity
    base_length2: mi.Float  # from a to b̂
    through: Through | None = None  # what of media is known; None without media


@dataclass
class Through:
    """Media along the way from a, and along that of the photon itself."""

    medium: mi.MediumPtr  # at a
    τ_c: mi.Float  # of the photon's way, in colour c
    channel: mi.UInt32  # c
    nulls: Collisions | None  # of the photon's way; None without grids


def copy(
    scene, lights: LightEnds, connectable, starts: LightRay, photons, j, photon: Photon, x, y, radius2, active, fog=None
):
    """(copy, r, whether it exists) of the ``photon`` of place ``j`` that is gathered at ``x`` and not at ``y``, for y.

    ``starts`` are the light's ends of all light paths, ``connectable`` (material) says where photons are gathered.
    """
    foot = shift.on_plane(photon.p, photon.d, x.p, x.n)
    target = shift.moved(foot, x.p, x.n, y.p, y.n)
    way = redirected(scene, lights, starts, photons, j, photon, foot, target, active, fog)
    J = shift.jacobian(photon.d, x.n, way.base_length2, way.ray.d, y.n, way.length2)
    r = way.ratio * J
    # In front of a
    good = active & (dr.dot(target - way.ray.o, way.ray.d) > 0) & (dr.max(way.Φ) > 0) & (r > 0) & dr.isfinite(r)
    if fog is None:
        hit, Φ = scene.ray_intersect(way.ray, good), way.Φ * J
    else:
        T, T_c, met, ray, _ = let_through(scene, fog, way, mi.Float(dr.inf), good, to_surface=True)
        hit, Φ, r = met.compute_surface_interaction(ray, active=good), way.Φ * (J * T), r * T_c
    moved = Photon(hit.p, hit.n, way.ray.d, Φ)
    good &= hit.is_valid() & connectable(hit.bsdf())
    # At x it would be gathered as it is, not as a copy: the shift back would be another.
    return moved, r, good & is_near(moved, y, radius2) & ~is_near(moved, x, radius2)


def copy_in_medium(scene, fog, lights: LightEnds, starts: LightRay, photons, j, photon: Photon, target, active):
    """(copy, r, whether it exists) of the ``photon`` of place ``j``, in a medium, at the ``target``."""
    way = redirected(scene, lights, starts, photons, j, photon, photon.p, target, active, fog)
    J = shift.jacobian_in_medium(way.base_length2, way.length2)
    r = way.ratio * J
    good = active & (dr.dot(target - way.ray.o, way.ray.d) > 0) & (dr.max(way.Φ) > 0) & (r > 0) & dr.isfinite(r)
    reach = dr.norm(target - way.ray.o)
    T, T_c, met, _, medium = let_through(scene, fog, way, reach, good)
    good &= ~met.is_valid() & (medium == photon.medium)
    here = dr.zeros(mi.MediumInteraction3f, dr.width(reach))
    here.p, here.wavelengths, here.medium = target, way.ray.wavelengths, medium
    σs, _, σ = medium.get_scattering_coefficients(here, good)
    σ_c = media.pick(σ, way.through.channel)
    if not fog.media.grids:
        return Photon(target, photon.n, way.ray.d, way.Φ * (J * T * dr.select(good, σs / σ_c, 0))), r * T_c, good
    # As ``Fog.power()``, with the density of the photon's own place
    here.p = photon.p
    _, _, σ = photon.medium.get_scattering_coefficients(here, good)
    base_σ_c = media.pick(σ, way.through.channel)
    good &= σ_c > 0
    Φ = dr.select(good & (σs > 0), way.Φ * (J * T) / base_σ_c, 0)
    return Photon(target, photon.n, way.ray.d, mi.Spectrum(Φ)), r * T_c * (σ_c / base_σ_c), good


def let_through(scene, fog, way: Way, reach: mi.Float, active, to_surface: bool = False) -> tuple:
    """T' / T_c and T'_c / T_c of the way, over a distance or up to a surface; the surface, last piece, and medium."""
    ray, through = media.shortened(way.ray, reach), way.through
    trace = segments.next_surface(scene)
    if through.nulls is not None:
        known = through.channel, through.nulls, active, to_surface
        τ, met, ray, medium, N, N_c = collisions.rescale(fog.media.passes, trace, ray, through.medium, reach, *known)
        T, T_c = dr.exp(through.τ_c - τ) * N, dr.exp(through.τ_c - media.pick(τ, through.channel)) * N_c
        return T, T_c, met, ray, medium
    τ, met, ray, medium = segments.cross(fog.media.passes, trace, ray, through.medium, reach, active)
    return dr.exp(through.τ_c - τ), dr.exp(through.τ_c - media.pick(τ, through.channel)), met, ray, medium


def redirected(scene, lights: LightEnds, starts: LightRay, photons, j, photon, foot, target, active, fog=None) -> Way:
    """From the photon's predecessor to ``target`` instead of ``foot``. Φ is 0 where that is not possible.

    In media it is without their T: see ``let_through``.
    """
    parent = dr.gather(mi.UInt32, photons.parent, j, active)
    density = dr.gather(mi.Float, photons.density, j, active)
    first = density == 0

    # ------------------------ From a lamp ------------------------
    start = start_of(starts, parent, active & first)
    beyond = lights.far(start.index)
    # The origin of light from infinity moves, on a plane that the light is normal to.
    aside = target + start.ray.d * dr.dot(start.ray.o - target, start.ray.d)
    there = dr.zeros(mi.Interaction3f, dr.width(j))
    # Rays begin a little above their surface, here and below.
    there.p = target + (start.end.p - start.ray.o)
    there.time, there.wavelengths = start.ray.time, start.ray.wavelengths
    moved, lamp_ratio, per_length2 = lights.redirected(scene, start, there)
    beyond &= first

    # ------------------------ From a vertex ----------------------
    if fog is None:
        a, scatters = vertex_of(photons, parent, active & ~first), mi.Bool(False)
    else:
        a, place = vertex_in_media_of(photons, parent, active & ~first)
        scatters = place.scatters
    origin = a.spawn_ray(target - a.p).o
    to = mi.Vector3f(target - origin)
    length2 = dr.squared_norm(to)
    d = to * dr.rsqrt(length2)
    f, p, _ = evaluate(IMPORTANCE, a, a.bsdf(), a.to_local(d), active & ~first & ~scatters)
    if fog is not None:
        phase = place.medium.phase_function()
        of_phase = phase.eval_pdf(mi.PhaseFunctionContext(), media.in_medium(a, place), d, scatters)
        f, p = (dr.select(scatters, new, old) for new, old in zip(of_phase, (f, p), strict=True))
    survival = dr.gather(mi.Float, photons.survival, j, active)
    Φ = dr.gather(mi.Spectrum, photons.β, parent, active) * f / (density * survival)

    # Along the photon's line, b̂ may lie behind a.
    if fog is None:
        through, base_length = None, dr.gather(mi.Float, photons.t, j, active) + dr.dot(foot - photon.p, photon.d)
    else:
        # The record knows the last piece alone.
        origin_of_photon = dr.select(first, start.ray.o, origin)
        base_length = dr.dot(foot - origin_of_photon, photon.d)
        through = known_of_media(scene, fog, photons, j, photon, origin_of_photon)
    known = dr.isfinite(density) & (base_length > 0)
    Φ = dr.select(first, moved.β, Φ)
    origin = dr.select(first, dr.select(beyond, aside, moved.ray.o), origin)
    return Way(
        ray=mi.Ray3f(origin, dr.select(first, moved.ray.d, d), start.ray.time, start.ray.wavelengths),
        Φ=dr.select(known & dr.isfinite(dr.sum(Φ)), Φ, 0),
        ratio=dr.select(first, lamp_ratio, p / density),
        length2=dr.select(first, dr.rcp(per_length2), length2),
        base_length2=dr.select(beyond, 1, dr.square(base_length)),
        through=through,
    )


def known_of_media(scene, fog, photons, j, photon: Photon, origin) -> Through:
    """Media between the ``photon``, of place ``j``, and the ``origin`` of its last edge."""
    b = dr.zeros(mi.SurfaceInteraction3f, dr.width(photon.p))
    b.p, b.n = photon.p, photon.n
    back, medium = b.spawn_ray(-photon.d), photon.medium
    reach = dr.dot(back.o - origin, photon.d)
    if fog.media.grids:
        trace, back, none = segments.next_surface(scene), media.shortened(back, reach), mi.UInt32(0)
        steps = none, mi.Float(1), none, mi.Bool(True)
        τ, _, _, medium, M, _ = collisions.cross(fog.media.passes, trace, back, medium, reach, photon.channel, *steps)
        key, n, N_c = (dr.gather(type(v), v, j) for v in (photons.key, photons.nulls, photons.N_c))
        return Through(medium, media.pick(τ, photon.channel), photon.channel, Collisions(key, n, M, N_c))
    if not fog.media.boundaries:
        τ = media.depth(media.extinction(medium, back), reach)
    else:
        trace, back = segments.next_surface(scene), media.shortened(back, reach)
        τ, _, _, medium = segments.cross(fog.media.passes, trace, back, medium, reach, True)
    return Through(medium, media.pick(τ, photon.channel), photon.channel, None)


def start_of(starts: LightRay, path: mi.UInt32, active) -> LightRay:
    """The light's end of a light path."""

    def taken(value):
        return dr.gather(type(value), value, path, active)

    end = dr.zeros(mi.DirectionSample3f, dr.width(path))
    end.p, end.n = taken(starts.end.p), taken(starts.end.n)
    ray = mi.Ray3f(taken(starts.ray.o), taken(starts.ray.d), starts.ray.time, starts.ray.wavelengths)
    return LightRay(ray, taken(starts.β), taken(starts.emitter), taken(starts.index), end, taken(starts.delta))
