"""Copies of photons near the vertex of a neighbouring pixel's path, made by ``shift``, and the light that they bring
there.

    a           the predecessor of photon b: a vertex of its light path, or the point of the lamp where it begins
    Φ, Φ'       power of photon and copy, both with the density of the photon's path
    p, p'       densities of the directions d and d' at a, without Russian roulette: it is on top of a pair of paths
    r           p' J / p

A photon that came from a by a mirror, or through glass, has no copy: light goes there in one direction. There is no
copy either if anything is in the way, or if the copy lies outside the radius or on a surface that faces another way. A
copy must meet the same conditions as a photon, so that both directions of a difference reject alike.

In media a may be where light was scattered. Distances have densities, in the colour c of the light path: T' is in Φ',
and T'_c / T_c in r. Boundaries that do not bend light may be between a and b, or b'. There b' must be in the medium of
b.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from data_gen.paths import collisions, media, segments
from data_gen.paths.collisions import Collisions
from data_gen.paths.light_ends import LightRay, World
from data_gen.samplers.bdpt.vertex import IMPORTANCE, evaluate
from ngpt_studies.photons.gradients import shift
from ngpt_studies.photons.map.vertices import Photon, is_near, vertex_in_media_of, vertex_of


@dataclass
class LightPaths:
    starts: LightRay  # the light's ends of all light paths
    photons: Any  # the map

    def shifts(self, place: mi.UInt32) -> mi.Bool:
        """Whether photons, or edges, of the map may have copies: not those from a mirror, or through glass."""
        return dr.isfinite(dr.gather(mi.Float, self.photons.density, place))


@dataclass
class Way:
    """How light comes from a to the point ``target``, or in its direction."""

    ray: mi.Ray3f
    Φ: mi.Spectrum  # without J; 0 where no light can come
    ratio: mi.Float  # p' / p
    length2: mi.Float  # squared, from a to the target; 1 from infinity
    base_length2: mi.Float  # from a to b̂
    through: Through | None = None  # what of media is known; None without media

    def leads(self, target: mi.Point3f, r: mi.Float) -> mi.Bool:
        """Whether light comes to the ``target``, in front of a, with the ratio ``r``; if nothing is in the way."""
        ahead = dr.dot(target - self.ray.o, self.ray.d) > 0
        return ahead & (dr.max(self.Φ) > 0) & (r > 0) & dr.isfinite(r)


@dataclass
class Through:
    """Media along the way from a, and along the way of the photon itself."""

    medium: mi.MediumPtr  # at a
    τ_c: mi.Float  # of the photon's way, in colour c
    channel: mi.UInt32  # c
    nulls: Collisions | None  # of the photon's way; None without grids


@dataclass
class Passage:
    """The light that passes through media on a way."""

    T: mi.Spectrum  # T' / T_c
    T_c: mi.Float  # T'_c / T_c
    met: mi.PreliminaryIntersection3f  # the surface
    ray: mi.Ray3f  # the last piece
    medium: mi.MediumPtr  # there


def copy(
    world: World, paths: LightPaths, photon: Photon, ends: tuple, radius2: mi.Float, active: mi.Bool
) -> tuple[Photon, mi.Float, mi.Bool]:
    """(copy, r, whether it exists) of the ``photon`` that is gathered at x and not at y, the two ``ends``, for y."""
    x, y = ends
    foot = shift.on_plane(photon.p, photon.d, x.p, x.n)
    target = shift.moved(foot, x.p, x.n, y.p, y.n)
    way = redirected(world, paths, photon, foot, target, active)
    J = shift.jacobian(photon.d, x.n, way.base_length2, way.ray.d, y.n, way.length2)
    r = way.ratio * J
    good = active & way.leads(target, r)
    if world.fog is None:
        hit, Φ = world.scene.ray_intersect(way.ray, good), way.Φ * J
    else:
        passage = let_through(world, way, good)
        hit = passage.met.compute_surface_interaction(passage.ray, active=good)
        Φ, r = way.Φ * (J * passage.T), r * passage.T_c
    moved = Photon(hit.p, hit.n, way.ray.d, Φ)
    good &= hit.is_valid() & world.materials.connectable(hit.bsdf())
    # The copy must not be gathered at x: the shift back would then take it as its own copy.
    return moved, r, good & is_near(moved, y, radius2) & ~is_near(moved, x, radius2)


def copy_in_medium(
    world: World, paths: LightPaths, photon: Photon, target: mi.Point3f, active: mi.Bool
) -> tuple[Photon, mi.Float, mi.Bool]:
    """(copy, r, whether it exists) of the ``photon``, in a medium, at the ``target``."""
    way = redirected(world, paths, photon, photon.p, target, active)
    J = shift.jacobian_in_medium(way.base_length2, way.length2)
    r = way.ratio * J
    good = active & way.leads(target, r)
    passage = let_through(world, way, good, target)
    good &= ~passage.met.is_valid() & (passage.medium == photon.medium)

    # -------------- What is scattered there, over the density of the place --------------
    here = dr.zeros(mi.MediumInteraction3f, dr.width(target))
    here.p, here.wavelengths, here.medium = target, way.ray.wavelengths, passage.medium
    σs, _, σ = passage.medium.get_scattering_coefficients(here, good)
    σ_c, r = media.pick(σ, way.through.channel), r * passage.T_c
    if not world.fog.media.grids:
        Φ = way.Φ * (J * passage.T * dr.select(good, σs / σ_c, 0))
        return Photon(target, photon.n, way.ray.d, Φ), r, good
    # As ``Fog.power()``, with the density of the photon's own place
    here.p = photon.p
    _, _, σ = photon.medium.get_scattering_coefficients(here, good)
    base_σ_c = media.pick(σ, way.through.channel)
    good &= σ_c > 0
    Φ = dr.select(good & (σs > 0), way.Φ * (J * passage.T) / base_σ_c, 0)
    return Photon(target, photon.n, way.ray.d, mi.Spectrum(Φ)), r * (σ_c / base_σ_c), good


def let_through(world: World, way: Way, active, target: mi.Point3f | None = None) -> Passage:
    """Returns the light that passes on the way, to the ``target`` or up to a surface."""
    reach = mi.Float(dr.inf) if target is None else dr.norm(target - way.ray.o)
    fog, ray, through = world.fog, media.shortened(way.ray, reach), way.through
    trace = segments.next_surface(world.scene)
    passes = fog.media.passes
    if through.nulls is not None:
        how = {"channel": through.channel, "active": active, "target": target, "to_surface": target is None}
        τ, met, ray, medium, N, N_c = collisions.rescale(
            passes, trace, ray, through.medium, reach, through.nulls, **how
        )
    else:
        τ, met, ray, medium = segments.cross(passes, trace, ray, through.medium, reach, active=active, target=target)
        N, N_c = 1, 1
    T, T_c = dr.exp(through.τ_c - τ) * N, dr.exp(through.τ_c - media.pick(τ, through.channel)) * N_c
    return Passage(T, T_c, met, ray, medium)


def redirected(world: World, paths: LightPaths, photon: Photon, foot, target, active) -> Way:
    """From the photon's predecessor a to ``target`` instead of ``foot``, which is b̂.

    In media Φ is without T: see ``let_through``.
    """
    scene, lights, photons, j = world.scene, world.lights, paths.photons, photon.place
    parent = dr.gather(mi.UInt32, photons.parent, j, active)  # a, or the number of the light path
    density = dr.gather(mi.Float, photons.density, j, active)  # p
    first = density == 0  # a is on a lamp

    # ------------------------ From a lamp ------------------------
    start = start_of(paths.starts, parent, active & first)
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
    if world.fog is None:
        a, scatters = vertex_of(photons, parent, active & ~first), mi.Bool(False)
    else:
        a, place = vertex_in_media_of(photons, parent, active & ~first)
        scatters = place.scatters
    origin = a.spawn_ray(target - a.p).o
    to = mi.Vector3f(target - origin)
    length2 = dr.squared_norm(to)
    d = to * dr.rsqrt(length2)
    # f and p' of the new direction, at a surface or in a medium
    f, p, _ = evaluate(IMPORTANCE, a, a.bsdf(), a.to_local(d), active & ~first & ~scatters)
    if world.fog is not None:
        phase = place.medium.phase_function()
        of_phase = phase.eval_pdf(mi.PhaseFunctionContext(), media.in_medium(a, place), d, scatters)
        f, p = (dr.select(scatters, new, old) for new, old in zip(of_phase, (f, p), strict=True))
    survival = dr.gather(mi.Float, photons.survival, j, active)
    Φ = dr.gather(mi.Spectrum, photons.β, parent, active) * f / (density * survival)

    # ---------- How far b̂ is from a; along the photon's line it may lie behind ----------
    if world.fog is None:
        through, base_length = None, dr.gather(mi.Float, photons.t, j, active) + dr.dot(foot - photon.p, photon.d)
    else:
        # The record holds only the last piece.
        origin_of_photon = dr.select(first, start.ray.o, origin)
        base_length = dr.dot(foot - origin_of_photon, photon.d)
        through = known_of_media(world, photons, photon, origin_of_photon)
    # Not by a mirror, or through glass
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


def known_of_media(world: World, photons, photon: Photon, origin) -> Through:
    """Media between the ``photon`` and the ``origin`` of its last edge."""
    b, fog, trace = dr.zeros(mi.SurfaceInteraction3f, dr.width(photon.p)), world.fog, segments.next_surface(world.scene)
    b.p, b.n, passes = photon.p, photon.n, fog.media.passes
    back, medium, nulls = b.spawn_ray(-photon.d), photon.medium, None
    reach = dr.dot(back.o - origin, photon.d)
    if fog.media.grids:
        # Only the majorant's optical depth M of the way back: with no collision to place
        back, none = media.shortened(back, reach), mi.UInt32(0)
        steps = {"channel": photon.channel, "key": none, "scale": mi.Float(1), "most": none, "target": None}
        τ, _, _, medium, M, _ = collisions.cross(passes, trace, back, medium, reach, **steps, active=True)
        key, n, N_c = (dr.gather(type(v), v, photon.place) for v in (photons.key, photons.nulls, photons.N_c))
        nulls = Collisions(key, n, M, N_c)
    elif not fog.media.boundaries:
        τ = media.depth(media.extinction(medium, back), reach)
    else:
        back = media.shortened(back, reach)
        τ, _, _, medium = segments.cross(passes, trace, back, medium, reach, active=mi.Bool(True), target=None)
    return Through(medium, media.pick(τ, photon.channel), photon.channel, nulls)


def start_of(starts: LightRay, path: mi.UInt32, active) -> LightRay:
    def taken(value):
        return dr.gather(type(value), value, path, active)

    end = dr.zeros(mi.DirectionSample3f, dr.width(path))
    end.p, end.n = taken(starts.end.p), taken(starts.end.n)
    ray = mi.Ray3f(taken(starts.ray.o), taken(starts.ray.d), starts.ray.time, starts.ray.wavelengths)
    kept = [taken(value) for value in (starts.β, starts.emitter, starts.index)]
    return LightRay(ray, *kept, end, taken(starts.delta), None if starts.front is None else taken(starts.front))
