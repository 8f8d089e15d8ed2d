"""Media, and the vertices of paths in them.

A vertex of a path is on a surface or in a medium. A vertex in a medium is also a ``SurfaceInteraction3f``, without a
shape, with a normal of 0 and the world's axes as its frame. So the same code handles both kinds; the ``Place`` of a
vertex says which kind it is. The segments between vertices are in ``data_gen.paths.segments``. The kernel of a scene
without media contains none of this code.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from data_gen.paths.vertex import consistent, dr_number, evaluate
from data_gen.scenes.facts import media_of, shapes_of


@dataclass
class Place:
    """Where a vertex is: on a surface, or in a medium."""

    medium: mi.MediumPtr  # around it, on the side from which the path has come; null where there is none
    scatters: mi.Bool  # in the medium, not on a surface

    def toward(self, x: mi.SurfaceInteraction3f, d: mi.Vector3f) -> mi.MediumPtr:
        """The medium that a path enters when it leaves ``x`` in direction ``d``."""
        changes = ~self.scatters & x.is_valid() & x.is_medium_transition()
        return dr.select(changes, x.target_medium(d), self.medium)


class Media:
    """Facts about the media of a scene.

    ``boundaries``  whether there are surfaces that rays go straight through: see ``index_matched()``
    ``grids``       whether there are media whose density varies
    """

    def __init__(self, scene: mi.Scene):
        self.grids = any(not medium.is_homogeneous() for medium in media_of(scene))
        matched = {dr_number(mi.ShapePtr(shape)): index_matched(shape) for shape in shapes_of(scene)}
        table = np.zeros(max(matched, default=0) + 1, bool)
        table[list(matched)] = list(matched.values())
        self.boundaries = bool(table.any())
        self.size, self.matched = dr.opaque(mi.UInt32, len(table)), mi.Bool(table)
        dr.eval(self.matched)

    def passes(self, shape: mi.ShapePtr) -> mi.Bool:
        index = dr.reinterpret_array(mi.UInt32, shape)
        return dr.gather(mi.Bool, self.matched, index, index < self.size)


def index_matched(shape: mi.Shape) -> bool:
    """Whether light goes through as if the surface were not there: its material is ``null``, and it is no lamp."""
    bsdf = shape.bsdf()
    if bsdf is None or shape.is_emitter() or not mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null):
        return False
    others = (mi.BSDFFlags.Smooth, mi.BSDFFlags.DeltaReflection, mi.BSDFFlags.DeltaTransmission)
    return not any(mi.has_flag(bsdf.flags(), flag) for flag in others)


# ------------------------------ Vertices ------------------------------


def scatters(place: Place | None) -> mi.Bool:
    """Whether a vertex is in a medium; ``place`` is None in scenes without media, here and below."""
    return mi.Bool(False) if place is None else place.scatters


def vertex(ray: mi.Ray3f, hit: mi.PreliminaryIntersection3f, place: Place | None) -> mi.SurfaceInteraction3f:
    """The vertex at the end of a segment whose last piece is ``ray`` and ``hit``."""
    if place is None:
        return hit.compute_surface_interaction(ray)
    on_surface = hit.compute_surface_interaction(ray, mi.RayFlags.All, ~place.scatters)
    inside = dr.zeros(mi.SurfaceInteraction3f, dr.width(hit.t))
    inside.t, inside.p, inside.time, inside.wavelengths = hit.t, ray(hit.t), ray.time, ray.wavelengths
    # Local directions are the world's.
    inside.sh_frame = mi.Frame3f(mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0), mi.Vector3f(0, 0, 1))
    inside.wi = -ray.d
    return dr.select(place.scatters, inside, on_surface)


def in_medium(x: mi.SurfaceInteraction3f, place: Place) -> mi.MediumInteraction3f:
    """Vertex ``x`` as an interaction for Mitsuba's media and phase functions."""
    found = dr.zeros(mi.MediumInteraction3f, dr.width(x.t))
    found.t, found.p, found.time, found.wavelengths = x.t, x.p, x.time, x.wavelengths
    found.wi, found.medium = x.wi, place.medium
    found.sh_frame = mi.Frame3f(x.wi)
    return found


def evaluate_vertex(
    bsdf: mi.BSDFPtr, x: mi.SurfaceInteraction3f, place: Place | None, wo: mi.Vector3f, active: bool | mi.Bool = True
) -> tuple[mi.Spectrum, mi.Float]:
    """``evaluate()`` for a vertex of either kind: f, with the cosine of a surface, and the density of sampling ``wo``.

    ``bsdf`` is the material of the vertex, null in a medium.
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
        sample, f_p = bsdf.sample(mi.BSDFContext(), x, u_lobe, u_direction)
        return consistent(bsdf, x, sample, f_p), f_p
    sample, f_p = bsdf.sample(mi.BSDFContext(), x, u_lobe, u_direction, ~place.scatters)
    sample = consistent(bsdf, x, sample, f_p, ~place.scatters)
    return scattered(x, place, u_lobe, u_direction, sample, f_p)


def evaluate_and_sample(
    bsdf: mi.BSDFPtr,
    x: mi.SurfaceInteraction3f,
    place: Place | None,
    wo: mi.Vector3f,
    u_lobe: mi.Float,
    u_direction: mi.Point2f,
) -> tuple[mi.Spectrum, mi.Float, mi.BSDFSample3f, mi.Spectrum]:
    """``evaluate_vertex()`` for ``wo``, and ``sample_vertex()``: in one call, because virtual calls are expensive."""
    context = mi.BSDFContext()
    if place is None:
        f, p, sample, f_p = bsdf.eval_pdf_sample(context, x, wo, u_lobe, u_direction)
        return f, p, consistent(bsdf, x, sample, f_p), f_p
    f, p, sample, f_p = bsdf.eval_pdf_sample(context, x, wo, u_lobe, u_direction, ~place.scatters)
    sample = consistent(bsdf, x, sample, f_p, ~place.scatters)
    phase = place.medium.phase_function()
    f_phase, p_phase = phase.eval_pdf(mi.PhaseFunctionContext(), in_medium(x, place), wo, place.scatters)
    f, p = dr.select(place.scatters, f_phase, f), dr.select(place.scatters, p_phase, p)
    return f, p, *scattered(x, place, u_lobe, u_direction, sample, f_p)


def scattered(x, place: Place, u_lobe, u_direction, sample, f_p) -> tuple[mi.BSDFSample3f, mi.Spectrum]:
    """``sample`` and ``f_p`` of a material, or of the phase function in a medium."""
    phase = place.medium.phase_function()
    wo, weight, p = phase.sample(mi.PhaseFunctionContext(), in_medium(x, place), u_lobe, u_direction, place.scatters)
    own = dr.zeros(mi.BSDFSample3f, dr.width(x.t))
    own.wo, own.pdf, own.eta = wo, p, mi.Float(1)
    own.sampled_type = mi.UInt32(+mi.BSDFFlags.DiffuseReflection)
    return dr.select(place.scatters, own, sample), dr.select(place.scatters, weight, f_p)


# ------------------------- Colours and pieces -------------------------


def choose_channel(u: mi.Float) -> mi.UInt32:
    """The colour by which a path samples its distances; in spectral variants the first of its wavelengths."""
    if not mi.is_rgb:
        return mi.UInt32(0)
    return dr.minimum(mi.UInt32(u * 3), 2)


def pick(value: mi.Spectrum, channel: mi.UInt32) -> mi.Float:
    """The component of ``value`` in colour ``channel``."""
    if not mi.is_rgb:
        return value[0]
    return dr.select(channel == 0, value[0], dr.select(channel == 1, value[1], value[2]))


def extinction(medium: mi.MediumPtr, ray: mi.Ray3f) -> mi.Spectrum:
    """σ of a homogeneous medium, 0 outside of all media."""
    where = dr.zeros(mi.MediumInteraction3f, dr.width(ray.o))
    where.p, where.wavelengths = ray.o, ray.wavelengths
    σ = medium.get_majorant(where)
    return mi.Spectrum(dr.select(medium != None, σ, 0))  # noqa: E711 - an array of pointers


def depth(σ: mi.Spectrum, distance: mi.Float) -> mi.Spectrum:
    """τ of a piece, which may be infinitely long where there is no medium."""
    return mi.Spectrum(dr.select(σ > 0, σ * distance, 0))


def end_of(ray: mi.Ray3f) -> mi.Float:
    """How far a ray goes if nothing is in the way: a camera ray to the far plane, other rays infinitely far."""
    return dr.select(ray.maxt < dr.largest(mi.Float), ray.maxt, dr.inf)


def shortened(ray: mi.Ray3f, length: mi.Float) -> mi.Ray3f:
    """The ray, at most as long as ``length``."""
    short = mi.Ray3f(ray)
    short.maxt = dr.minimum(ray.maxt, length)
    return short


def beyond(ray: mi.Ray3f, hit: mi.PreliminaryIntersection3f, medium: mi.MediumPtr) -> tuple[mi.Ray3f, mi.MediumPtr]:
    """The ray behind a boundary, and the medium there."""
    si = hit.compute_surface_interaction(ray, mi.RayFlags.Minimal)
    after = si.spawn_ray(ray.d)
    after.maxt = ray.maxt - hit.t
    return after, dr.select(si.is_medium_transition(), si.target_medium(ray.d), medium)


def onward(ray, hit, medium, reach: mi.Float, target: mi.Point3f | None) -> tuple[mi.Ray3f, mi.MediumPtr, mi.Float]:
    """Returns what ``beyond()`` returns, and what is left of ``reach``. If there is a finite ``target``, the ray is
    aimed at it anew.

    Behind a boundary a ray is displaced along the normal. A displaced ray that grazes the target's surface could meet
    this surface before the target and seem to be blocked.
    """
    after, there = beyond(ray, hit, medium)
    left = reach - hit.t
    if target is None:
        return after, there, left
    aims, to = dr.isfinite(target.x), target - after.o
    length = dr.norm(to)
    aimed = mi.Ray3f(after.o, to / length, length * (1 - mi.math.ShadowEpsilon), ray.time, ray.wavelengths)
    return dr.select(aims, aimed, after), there, dr.select(aims, length, left)
