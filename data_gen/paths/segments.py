"""Segments of a path through media: where they end, how much light they transmit, and how they are shifted.

A *segment* leads from vertex to vertex. It goes straight through index-matched boundaries. These are no vertices: they
do not count in the length of a path, and emitters are sampled and found through them.

    σ, σs       extinction and scattering coefficients, one for each colour
    c           the colour by which distances are sampled, the same for a base path and its four shifted copies
    τ           optical depth of the homogeneous media of a segment
    T           exp(-τ)

An optical depth in colour c is sampled, not a distance, so one random number decides where a path scatters, through any
number of homogeneous media. The density of a vertex is T_c σ_c in a medium, and T_c on a surface. A shifted copy that
reconnects to the vertex has T_c' instead of T_c. A copy that replays the number has r = 1. For media whose density
varies see ``data_gen.paths.collisions``. [Hua et al. 2019, section 7.1; docs/samplers/media.md]
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from data_gen.paths import collisions
from data_gen.paths.collisions import Collisions
from data_gen.paths.holes import Holes
from data_gen.paths.media import Media, Place, beyond, depth, end_of, extinction, onward, pick, shortened


@dataclass
class Numbers:
    u: mi.Float
    key: mi.UInt32 | None  # of the random numbers for null collisions; None without grids


@dataclass
class Segment:
    """A segment, which ends at a vertex in a medium, at a vertex on a surface, or nowhere."""

    ray: mi.Ray3f  # the last piece of the segment, behind the last boundary
    hit: mi.PreliminaryIntersection3f  # at the end of this piece; its distance leads to the vertex, also in a medium
    place: Place
    weight: mi.Spectrum  # integrand over density in colour c: T / T_c, times σs / σ_c in a medium
    albedo: mi.Spectrum  # σs / σ_c in a medium, else 1
    τ_c: mi.Float
    nulls: Collisions | None  # None without grids


def draw(random, media: Media) -> Numbers:
    return Numbers(random.next_1d(), random.next_key() if media.grids else None)


def next_surface(scene):
    """The function ``trace`` of ``fly()`` and ``cross()``."""
    return lambda ray, medium, active: scene.ray_intersect_preliminary(ray, active=active)


def fly(media: Media, trace, ray, medium, channel, numbers: Numbers, *, active) -> Segment:
    """Samples the segment along ``ray``, which starts in ``medium``, from ``numbers``.

    ``trace`` (ray, medium, active) finds the next surface, as ``next_surface()`` does.
    """
    nulls, N = None, 1
    if media.grids:
        ray, hit, medium, scatters, τ, nulls, N = collisions.fly_on(
            media.passes, trace, ray, medium, channel=channel, u=numbers.u, key=numbers.key, active=active
        )
    else:
        ray, hit, medium, scatters, τ = fly_on(media.passes, trace, ray, medium, channel, numbers.u, active=active)
    here = dr.zeros(mi.MediumInteraction3f, dr.width(hit.t))
    here.p, here.wavelengths, here.medium, here.t = ray(hit.t), ray.wavelengths, medium, hit.t
    σs, _, σ = medium.get_scattering_coefficients(here, scatters)
    albedo = mi.Spectrum(dr.select(scatters, σs / pick(σ, channel), 1))
    τ_c = pick(τ, channel)
    weight = dr.exp(τ_c - τ) * albedo * N
    return Segment(ray, hit, Place(medium, scatters), dr.select(dr.isfinite(weight), weight, 0), albedo, τ_c, nulls)


@dr.syntax
def fly_on(passes, trace, ray, medium, channel, u, *, active):
    """Samples a segment: its last piece, the hit, the medium there, whether the path scatters in it, and τ."""
    ray, medium = mi.Ray3f(ray), mi.MediumPtr(medium)
    left = -dr.log(1 - u)
    τ = dr.zeros(mi.Spectrum, dr.width(ray.o))
    scatters, flying = mi.Bool(False), mi.Bool(active)
    hit = dr.zeros(mi.PreliminaryIntersection3f, dr.width(ray.o))
    while dr.hint(flying, label="segment"):
        σ = extinction(medium, ray)
        σ_c = pick(σ, channel)
        collision = dr.select(σ_c > 0, left / σ_c, dr.inf)
        hit = trace(shortened(ray, collision), medium, flying)
        end = end_of(ray)
        scatters = flying & ~hit.is_valid() & (collision < end)
        hit.t, hit.valid = dr.select(scatters, collision, hit.t), hit.valid | scatters
        τ += depth(σ, dr.minimum(hit.t, end))
        left = dr.maximum(left - dr.select(σ_c > 0, σ_c * hit.t, 0), 0)
        flying &= hit.is_valid() & ~scatters & passes(hit.shape)
        if flying:
            ray, medium = beyond(ray, hit, medium)
    return ray, hit, medium, scatters, τ


@dr.syntax
def cross(passes, trace, ray, medium, reach, *, active, target):
    """Follows ``ray`` for the distance ``reach``, or up to the first surface that is no boundary.

    Each piece aims at the ``target`` again, if there is one and it is finite: see ``media.onward()``. Returns τ, the
    hit, the last piece of the ray, and the medium there.
    """
    ray, medium, reach = mi.Ray3f(ray), mi.MediumPtr(medium), mi.Float(reach)
    τ = dr.zeros(mi.Spectrum, dr.width(ray.o))
    hit = dr.zeros(mi.PreliminaryIntersection3f, dr.width(ray.o))
    crossing = mi.Bool(active)
    while dr.hint(crossing, label="transmittance"):
        hit = trace(ray, medium, crossing)
        # The ray may be a little shorter than ``reach``, so that it does not meet its target. Its light still crosses
        # the medium over the full length.
        τ += depth(extinction(medium, ray), dr.select(hit.is_valid(), hit.t, reach))
        crossing &= hit.is_valid() & passes(hit.shape)
        if crossing:
            ray, medium, reach = onward(ray, hit, medium, reach, target)
    return τ, hit, ray, medium


def see(media: Media, trace, ray, medium, reach, *, channel, key, active) -> tuple:
    """T along ``ray`` for the distance ``reach``, or up to the first surface that is no boundary. In grids, T is an
    estimate.

    Returns T, the hit, the last piece of the ray, and the medium there.
    """
    if not media.grids:
        τ, hit, ray, medium = cross(media.passes, trace, ray, medium, reach, active=active, target=None)
        return dr.exp(-τ), hit, ray, medium
    # Ratio tracking: each collision of the majorant multiplies T by the share of null collisions.
    every = {"channel": channel, "key": key, "scale": mi.Float(1), "most": mi.UInt32(0xFFFFFFFF), "target": None}
    τ, hit, ray, medium, _, N = collisions.cross(media.passes, trace, ray, medium, reach, **every, active=active)
    return dr.exp(-τ) * N, hit, ray, medium


def clear_view(media: Media, trace, ray, medium, channel, active) -> tuple:
    """exp(-τ) along ``ray`` up to the first surface that is no boundary, or 0 if a grid is on the way.

    Returns that number, the hit, and the last piece of the ray.
    """
    reach = end_of(ray)
    if not media.grids:
        τ, hit, ray, _ = cross(media.passes, trace, ray, medium, reach, active=active, target=None)
        return dr.exp(-τ), hit, ray
    none = {"channel": channel, "key": mi.UInt32(0), "scale": mi.Float(1), "most": mi.UInt32(0), "target": None}
    τ, hit, ray, _, M, _ = collisions.cross(media.passes, trace, ray, medium, reach, **none, active=active)
    return dr.select(M > 0, 0, dr.exp(-τ)), hit, ray


def transmittance(
    scene, media: Media, x, place: Place, target: mi.Point3f, *, channel, key, active: mi.Bool
) -> mi.Spectrum:
    """T from vertex ``x`` to the point ``target`` of an emitter; 0 if it is blocked."""
    ray = x.spawn_ray_to(target)
    medium, reach = place.toward(x, ray.d), dr.norm(target - ray.o)
    if not media.boundaries and not media.grids:
        return dr.select(scene.ray_test(ray, active), 0, dr.exp(-depth(extinction(medium, ray), reach)))
    T, hit, _, _ = see(media, next_surface(scene), ray, medium, reach, channel=channel, key=key, active=active)
    return dr.select(active & hit.is_valid(), 0, T)


@dr.syntax
def through_holes(
    scene, media: Media, x, place: Place, target: mi.Point3f, *, holes: Holes, most, channel, key, active: mi.Bool
) -> mi.Spectrum:
    """``transmittance()`` through at most ``most`` holes."""
    trace, ray = next_surface(scene), x.spawn_ray_to(target)
    medium, left, going = mi.MediumPtr(place.toward(x, ray.d)), mi.UInt32(most), mi.Bool(active)
    T = dr.select(active, mi.Spectrum(1), 0)
    while dr.hint(going, label="holes"):
        reach = dr.norm(target - ray.o)
        piece, hit, last, there = see(media, trace, ray, medium, reach, channel=channel, key=key, active=going)
        T = dr.select(going, mi.Spectrum(T * piece), T)
        going &= hit.is_valid()
        si = hit.compute_surface_interaction(last, mi.RayFlags.All, going)
        T, left, going = holes.behind(si, T, left, going)
        ray = si.spawn_ray_to(target)
        medium = dr.select(si.is_medium_transition(), si.target_medium(ray.d), there)
        if dr.hint(key is not None, mode="scalar"):
            # Each piece needs its own random numbers for collisions.
            key = mi.sample_tea_32(key, mi.UInt32(left))[0]
    return T


def reconnect(scene, media: Media, y, place: Place, ray, *, x1, base: Segment, channel, active) -> tuple:
    """Shifts the segment ``base`` by reconnection: ``ray`` leads from the offset path's vertex ``y`` to its end ``x1``.

    Returns the integrand divided by the density of ``base``, the ratio of the two densities (colour c), and whether the
    segment is blocked. The Jacobian of x1 is left out of both.
    """
    reach, medium = dr.select(x1.is_valid(), dr.norm(x1.p - ray.o), dr.inf), place.toward(y, ray.d)
    trace, target = next_surface(scene), dr.select(x1.is_valid(), x1.p, dr.inf)
    if media.grids:
        τ, hit, _, medium, N, N_c = collisions.rescale(
            media.passes, trace, ray, medium, reach, base.nulls, channel=channel, active=active, target=target
        )
    else:
        τ, hit, _, medium = cross(media.passes, trace, ray, medium, reach, active=active, target=target)
        N, N_c = 1, 1
    # Both paths must arrive through the same medium. This is checked, since a boundary may have holes.
    blocked = hit.is_valid() | (medium != base.place.medium)
    τ_c = pick(τ, channel)
    return dr.exp(base.τ_c - τ) * base.albedo * N, dr.exp(base.τ_c - τ_c) * N_c, blocked
