"""Media between the vertices of a path: where a path scatters in them, and how much light comes through.

A vertex of a path is on a surface or in a medium. One in a medium is a ``SurfaceInteraction3f`` too, of no shape, with a
normal of 0 and the world's axes for a frame, so that what holds for any vertex is written once; its ``Place`` says
which of the two it is. A *segment* leads from vertex to vertex. It goes straight through index-matched boundaries,
which bend nothing and reflect nothing: surfaces of the material ``null`` that are no lamps. These are no vertices.

    σ, σs, σn   extinction, scattering and null-collision coefficients, one for each colour
    μ           majorant: at least σ, constant in a medium, σ itself in a homogeneous one
    τ           optical depth of a segment by the majorants of its media
    c           the colour by which the distances of a path are sampled, the same for all five paths

Distances are sampled as optical depths: a collision comes at every exponentially distributed step of τ in colour c, so
one number decides where a path first collides, through whatever media it goes. Nothing of what is here is compiled
into the kernel of a scene without media.

[Hua et al. 2019, section 7.1; docs/media.md]
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from data_gen.paths.vertex import evaluate


@dataclass
class Place:
    """Where a vertex is."""

    medium: mi.MediumPtr  # around it, on the side from which the path has come; null where there is none
    scatters: mi.Bool  # in the medium, not on a surface

    def toward(self, x: mi.SurfaceInteraction3f, d: mi.Vector3f) -> mi.MediumPtr:
        """The medium into which direction ``d`` leads from vertex ``x``."""
        changes = ~self.scatters & x.is_valid() & x.is_medium_transition()
        return dr.select(changes, x.target_medium(d), self.medium)


@dataclass
class Segment:
    """What is met along a ray: a vertex in a medium, one on a surface, or nothing."""

    ray: mi.Ray3f  # its last piece, behind the last boundary
    hit: mi.PreliminaryIntersection3f  # of that piece; its distance is that of the vertex, in a medium too
    place: Place
    weight: mi.Spectrum  # transmittance, times σs in a medium, over the density in colour c
    σ: mi.Spectrum  # albedo by colour c, σs / σ_c, in a medium, else 1
    τ_c: mi.Float


class Media:
    """Facts about the media of a scene.

    ``boundaries``  whether there are index-matched ones
    """

    def __init__(self, scene: mi.Scene):
        matched = {dr_number(shape): index_matched(shape) for shape in scene.shapes()}
        table = np.zeros(max(matched, default=0) + 1, bool)
        table[list(matched)] = list(matched.values())
        self.boundaries = bool(table.any())
        self.size, self.matched = len(table), mi.Bool(table)
        dr.eval(self.matched)

    def passes(self, shape: mi.ShapePtr) -> mi.Bool:
        """Whether a ray goes straight through this shape."""
        index = dr.reinterpret_array(mi.UInt32, shape)
        return dr.gather(mi.Bool, self.matched, index, index < self.size)


def index_matched(shape: mi.Shape) -> bool:
    """Whether light goes through as if the surface were not there."""
    bsdf = shape.bsdf()
    if bsdf is None or shape.is_emitter() or not mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null):
        return False
    others = (mi.BSDFFlags.Smooth, mi.BSDFFlags.DeltaReflection, mi.BSDFFlags.DeltaTransmission)
    return not any(mi.has_flag(bsdf.flags(), flag) for flag in others)


def dr_number(shape: mi.Shape) -> int:
    return int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0])


# ------------------------------ Vertices ------------------------------


def vertex(ray: mi.Ray3f, hit: mi.PreliminaryIntersection3f, place: Place) -> mi.SurfaceInteraction3f:
    """The vertex at the end of a segment, of which ``ray`` and ``hit`` are the last piece."""
    on_surface = hit.compute_surface_interaction(ray, mi.RayFlags.All, ~place.scatters)
    inside = dr.zeros(mi.SurfaceInteraction3f, dr.width(hit.t))
    inside.t, inside.p, inside.time, inside.wavelengths = hit.t, ray(hit.t), ray.time, ray.wavelengths
    # Local directions are the world's.
    inside.sh_frame = mi.Frame3f(mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0), mi.Vector3f(0, 0, 1))
    inside.wi = -ray.d
    return dr.select(place.scatters, inside, on_surface)


def in_medium(x: mi.SurfaceInteraction3f, place: Place) -> mi.MediumInteraction3f:
    """Vertex ``x`` as Mitsuba's media and phase functions know it."""
    found = dr.zeros(mi.MediumInteraction3f, dr.width(x.t))
    found.t, found.p, found.time, found.wavelengths = x.t, x.p, x.time, x.wavelengths
    found.wi, found.medium = x.wi, place.medium
    found.sh_frame = mi.Frame3f(x.wi)
    return found


def evaluate_vertex(
    bsdf: mi.BSDFPtr, x: mi.SurfaceInteraction3f, place: Place | None, wo: mi.Vector3f, active: bool | mi.Bool = True
) -> tuple[mi.Spectrum, mi.Float]:
    """``evaluate()`` for a vertex of either kind: f, with the cosine of a surface, and the density of sampling ``wo``.

    ``bsdf`` is the material of the vertex, null in a medium; ``place`` is None in scenes without media.
    """
    if place is None:
        return evaluate(bsdf, x, wo, active)
    scatters = active & place.scatters
    f, p = evaluate(bsdf, x, wo, active & ~place.scatters)
    phase = place.medium.phase_function()
    f_phase, p_phase = phase.eval_pdf(mi.PhaseFunctionContext(), in_medium(x, place), wo, scatters)
    return dr.select(scatters, f_phase, f), dr.select(scatters, p_phase, p)


def sample_vertex(
    bsdf: mi.BSDFPtr, x: mi.SurfaceInteraction3f, place: Place | None, u_lobe: mi.Float, u_direction: mi.Point2f
) -> tuple[mi.BSDFSample3f, mi.Spectrum]:
    """A direction at a vertex, and f / p: what a material's ``sample()`` returns. In a medium it is a smooth event."""
    if place is None:
        return bsdf.sample(mi.BSDFContext(), x, u_lobe, u_direction)
    sample, f_p = bsdf.sample(mi.BSDFContext(), x, u_lobe, u_direction, ~place.scatters)
    return scattered(x, place, u_lobe, u_direction, sample, f_p)


def evaluate_and_sample(
    bsdf: mi.BSDFPtr,
    x: mi.SurfaceInteraction3f,
    place: Place | None,
    wo: mi.Vector3f,
    u_lobe: mi.Float,
    u_direction: mi.Point2f,
) -> tuple[mi.Spectrum, mi.Float, mi.BSDFSample3f, mi.Spectrum]:
    """Both at once: materials are virtual functions, and calls to them dear."""
    context = mi.BSDFContext()
    if place is None:
        return bsdf.eval_pdf_sample(context, x, wo, u_lobe, u_direction)
    f, p, sample, f_p = bsdf.eval_pdf_sample(context, x, wo, u_lobe, u_direction, ~place.scatters)
    phase = place.medium.phase_function()
    f_phase, p_phase = phase.eval_pdf(mi.PhaseFunctionContext(), in_medium(x, place), wo, place.scatters)
    f, p = dr.select(place.scatters, f_phase, f), dr.select(place.scatters, p_phase, p)
    return f, p, *scattered(x, place, u_lobe, u_direction, sample, f_p)


def scattered(x, place: Place, u_lobe, u_direction, sample, f_p) -> tuple[mi.BSDFSample3f, mi.Spectrum]:
    """``sample`` and ``f_p`` of a material, or in a medium those of its phase function."""
    phase = place.medium.phase_function()
    wo, weight, p = phase.sample(mi.PhaseFunctionContext(), in_medium(x, place), u_lobe, u_direction, place.scatters)
    own = dr.zeros(mi.BSDFSample3f, dr.width(x.t))
    own.wo, own.pdf, own.eta = wo, p, mi.Float(1)
    own.sampled_type = mi.UInt32(+mi.BSDFFlags.DiffuseReflection)
    return dr.select(place.scatters, own, sample), dr.select(place.scatters, weight, f_p)


# ------------------------------ Segments ------------------------------


def choose_channel(u: mi.Float) -> mi.UInt32:
    """The colour by which a path samples its distances; in spectral variants the first of its wavelengths."""
    if not mi.is_rgb:
        return mi.UInt32(0)
    return dr.minimum(mi.UInt32(u * 3), 2)


def pick(value: mi.Spectrum, channel: mi.UInt32) -> mi.Float:
    """Its value in one colour."""
    if not mi.is_rgb:
        return value[0]
    return dr.select(channel == 0, value[0], dr.select(channel == 1, value[1], value[2]))


def majorant(medium: mi.MediumPtr, ray: mi.Ray3f, active: mi.Bool) -> mi.Spectrum:
    """μ, 0 outside of all media."""
    where = dr.zeros(mi.MediumInteraction3f, dr.width(ray.o))
    where.p, where.wavelengths = ray.o, ray.wavelengths
    return dr.select(medium != None, medium.get_majorant(where, active), 0)  # noqa: E711 - an array of pointers


def depth(μ: mi.Spectrum, distance: mi.Float) -> mi.Spectrum:
    """τ of a piece, which may be infinitely long where there is no medium."""
    return dr.select(μ > 0, μ * distance, 0)


def fly(scene, media: Media, trace, ray, medium, channel, u, active) -> Segment:
    """The segment along ``ray``, from within ``medium``, with the distance of the random number ``u``.

    ``trace`` (ray, medium, active) finds the next surface, as ``next_surface()`` does.
    """
    ray, hit, medium, scatters, τ = fly_on(scene, media, trace, ray, medium, channel, u, active)
    here = dr.zeros(mi.MediumInteraction3f, dr.width(hit.t))
    here.p, here.wavelengths, here.medium, here.t = ray(hit.t), ray.wavelengths, medium, hit.t
    σs, _, σ = medium.get_scattering_coefficients(here, scatters)
    σ = dr.select(scatters, σs / pick(σ, channel), 1)
    τ_c = pick(τ, channel)
    weight = dr.exp(τ_c - τ) * σ
    return Segment(ray, hit, Place(medium, scatters), dr.select(dr.isfinite(weight), weight, 0), σ, τ_c)


@dr.syntax
def fly_on(scene, media: Media, trace, ray, medium, channel, u, active):
    """The last piece of a segment, its surface, its medium, whether the path scatters there, and τ up to there."""
    ray, medium = mi.Ray3f(ray), mi.MediumPtr(medium)
    left = -dr.log(1 - u)
    τ = dr.zeros(mi.Spectrum, dr.width(ray.o))
    scatters = mi.Bool(False)
    hit = dr.zeros(mi.PreliminaryIntersection3f, dr.width(ray.o))
    flying = mi.Bool(active)
    while dr.hint(flying, label="segment"):
        μ = majorant(medium, ray, flying)
        μ_c = pick(μ, channel)
        collision = dr.select(μ_c > 0, left / μ_c, dr.inf)
        hit = trace(piece(ray, collision), medium, flying)
        scatters = flying & ~hit.is_valid() & dr.isfinite(collision)
        hit.t, hit.valid = dr.select(scatters, collision, hit.t), hit.valid | scatters
        τ += depth(μ, hit.t)
        left = dr.maximum(left - dr.select(μ_c > 0, μ_c * hit.t, 0), 0)
        flying &= hit.is_valid() & ~scatters & media.passes(hit.shape)
        if flying:
            ray, medium = beyond(ray, hit, medium)
    return ray, hit, medium, scatters, τ


def piece(ray: mi.Ray3f, length: mi.Float) -> mi.Ray3f:
    """The first ``length`` of a ray."""
    short = mi.Ray3f(ray)
    short.maxt = dr.minimum(ray.maxt, length)
    return short


def beyond(ray: mi.Ray3f, hit: mi.PreliminaryIntersection3f, medium: mi.MediumPtr) -> tuple[mi.Ray3f, mi.MediumPtr]:
    """The ray behind a boundary, and the medium there."""
    si = hit.compute_surface_interaction(ray, mi.RayFlags.Minimal)
    after = si.spawn_ray(ray.d)
    after.maxt = ray.maxt - hit.t
    return after, dr.select(si.is_medium_transition(), si.target_medium(ray.d), medium)


@dr.syntax
def cross(scene, media: Media, trace, ray, medium, reach, active):
    """Straight along ``ray`` for the distance ``reach``, or up to the first surface that is no boundary.

    Returns τ, the surface, the last piece of the ray, and the medium there.
    """
    ray, medium, reach = mi.Ray3f(ray), mi.MediumPtr(medium), mi.Float(reach)
    τ = dr.zeros(mi.Spectrum, dr.width(ray.o))
    hit = dr.zeros(mi.PreliminaryIntersection3f, dr.width(ray.o))
    crossing = mi.Bool(active)
    while dr.hint(crossing, label="transmittance"):
        hit = trace(ray, medium, crossing)
        # A ray that was shortened, not to meet what it leads to, goes all the way in the medium.
        τ += depth(majorant(medium, ray, crossing), dr.select(hit.is_valid(), hit.t, reach))
        crossing &= hit.is_valid() & media.passes(hit.shape)
        if crossing:
            reach -= hit.t
            ray, medium = beyond(ray, hit, medium)
    return τ, hit, ray, medium


def next_surface(scene):
    """What ``fly()`` and ``cross()`` trace with."""
    return lambda ray, medium, active: scene.ray_intersect_preliminary(ray, active=active)


def transmittance(scene, media: Media, x, place: Place, ray, target: mi.Point3f, active: mi.Bool) -> mi.Spectrum:
    """Of the way along ``ray``, from vertex ``x`` to the point ``target`` of an emitter; 0 where it is blocked."""
    medium, reach = place.toward(x, ray.d), dr.norm(target - ray.o)
    if not media.boundaries:
        return dr.select(scene.ray_test(ray, active), 0, dr.exp(-depth(majorant(medium, ray, active), reach)))
    τ, hit, _, _ = cross(scene, media, next_surface(scene), ray, medium, reach, active)
    return dr.select(active & hit.is_valid(), 0, dr.exp(-τ))


def reconnect(scene, media: Media, y, place: Place, ray, x1, base: Segment, channel, active) -> tuple:
    """``ray`` from the offset path's vertex ``y`` to ``x1``, where the segment ``base`` ends.

    Returns its transmittance T'(d') over the density T_c(d) of the base path, times the albedo at x1; the ratio of
    densities T_c'(d') / T_c(d); and whether it is blocked.
    """
    reach = dr.select(x1.is_valid(), dr.norm(x1.p - ray.o), dr.inf)
    τ, hit, _, medium = cross(scene, media, next_surface(scene), ray, place.toward(y, ray.d), reach, active)
    # In what is around x1 both paths must have come: a boundary may have holes.
    blocked = hit.is_valid() | (medium != base.place.medium)
    return dr.exp(base.τ_c - τ) * base.σ, dr.exp(base.τ_c - pick(τ, channel)), blocked
