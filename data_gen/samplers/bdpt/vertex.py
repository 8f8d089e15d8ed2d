"""Vertices of camera paths and light paths, how light scatters there, and the records of light paths."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import drjit as dr
import mitsuba as mi

from data_gen.paths.holes import Edge
from data_gen.paths.vertex import SMOOTH, event_kind
from data_gen.samplers.bdpt import mis
from data_gen.samplers.bdpt.mis import Partial

# These are names, because Mitsuba's own values belong to a variant.
RADIANCE, IMPORTANCE = "Radiance", "Importance"


def context(mode: str) -> mi.BSDFContext:
    """The context for Mitsuba's materials: ``mode`` is RADIANCE or IMPORTANCE, which the path carries."""
    return mi.BSDFContext(getattr(mi.TransportMode, mode))


@dataclass
class Vertex:
    """The last vertex of a path: at ``si``, behind ``depth`` edges."""

    si: mi.SurfaceInteraction3f
    β: mi.Spectrum  # throughput of the path so far
    end: Partial
    depth: mi.UInt32
    edge: Edge | None = None  # the edge to this vertex; None where no edge leads through holes


@cache
def record_class(variant: str) -> type:
    """The class of a record. It belongs to a variant, since Dr.Jit reads the types of its fields only once."""

    @dataclass
    class Record:
        """The record of a vertex of a light path: 23 words in RGB. No field is a Bool, because Dr.Jit 1.5 fails then.

        ``recall`` computes the interaction again from the ray that led to the vertex and from the hit of this ray.
        """

        o: mi.Point3f
        d: mi.Vector3f
        t: mi.Float
        prim_uv: mi.Point2f
        prim_index: mi.UInt32
        shape: mi.ShapePtr
        instance: mi.ShapePtr
        n: mi.Normal3f
        β: mi.Spectrum
        vcm: mi.Float
        vc: mi.Float
        depth: mi.UInt32

    return Record


def record(ray: mi.Ray3f, hit: mi.PreliminaryIntersection3f, vertex: Vertex, smooth: mi.Bool) -> Any:
    """The record of a ``vertex`` that ``ray`` has hit. The record's depth is 0 where the vertex is not ``smooth``, so
    that nothing can be connected to it.
    """
    return record_class(mi.variant())(
        o=mi.Point3f(ray.o),
        d=mi.Vector3f(ray.d),
        t=mi.Float(hit.t),
        prim_uv=mi.Point2f(hit.prim_uv),
        prim_index=mi.UInt32(hit.prim_index),
        shape=mi.ShapePtr(hit.shape),
        instance=mi.ShapePtr(hit.instance),
        n=mi.Normal3f(vertex.si.n),
        β=mi.Spectrum(vertex.β),
        vcm=mi.Float(vertex.end.vcm),
        vc=mi.Float(vertex.end.vc),
        depth=dr.select(smooth, vertex.depth, 0),
    )


def recall(kept, time: mi.Float, wavelengths: mi.Wavelength) -> Vertex:
    """The vertex of a record."""
    hit = dr.zeros(mi.PreliminaryIntersection3f, dr.width(kept.t))
    hit.t, hit.prim_uv, hit.prim_index = kept.t, kept.prim_uv, kept.prim_index
    hit.shape, hit.instance = kept.shape, kept.instance
    # Without this the vertex would not be valid.
    hit.valid = mi.Bool(True)
    si = hit.compute_surface_interaction(mi.Ray3f(kept.o, kept.d, time, wavelengths))
    return Vertex(si, kept.β, Partial(kept.vcm, kept.vc), kept.depth)


def scatters_smoothly(bsdf: mi.BSDFPtr) -> mi.Bool:
    """Whether a path may be connected at such a material."""
    return mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)


def evaluate(mode, si, bsdf, wo: mi.Vector3f, active=True) -> tuple[mi.Spectrum, mi.Float, mi.Float]:
    """Returns f cos for a path that goes on along ``wo`` (local), the density p of ``wo``, and q, the density with both
    directions swapped.
    """
    if mode == IMPORTANCE:
        f, q = light_scattered(si, bsdf, wo, active)
        p = bsdf.pdf(context(RADIANCE), si, wo, active)
        good = dr.isfinite(p)
        return dr.select(good, f, 0), dr.select(good, p, 0), q
    f, p = bsdf.eval_pdf(context(mode), si, wo, active)
    good = dr.isfinite(p) & dr.isfinite(dr.sum(f))
    return dr.select(good, f, 0), dr.select(good, p, 0), reverse_density(si, bsdf, wo, active)


def reverse_density(si, bsdf, wo: mi.Vector3f, active) -> mi.Float:
    """Returns the density of sampling the direction to the previous vertex, had the path arrived along ``wo``."""
    q = bsdf.pdf(context(RADIANCE), _come_along(si, wo), si.wi, active)
    return dr.select(dr.isfinite(q), q, 0)


def light_scattered(si, bsdf, wo: mi.Vector3f, active) -> tuple[mi.Spectrum, mi.Float]:
    """f cos of light that leaves along ``wo``, and the density with both directions swapped.

    The value is that of radiance in the opposite direction, times cos_g(wo) / cos_g(wi), with cosines to the geometric
    normal. So camera paths and light paths agree on f of a path, whatever shading normals a material has. Mitsuba's own
    f for light is not used: with bump and normal maps it has the cosine of the wrong direction. [Veach 1997, "Robust
    Monte Carlo Methods for Light Transport Simulation", section 5.3.2]
    """
    f, q = bsdf.eval_pdf(context(RADIANCE), _come_along(si, wo), si.wi, active)
    f *= _quotient(cosine(si, si.to_world(wo)), cosine(si, si.to_world(si.wi)))
    good = dr.isfinite(q) & dr.isfinite(dr.sum(f))
    return dr.select(good, f, 0), dr.select(good, q, 0)


def light_sampled(si, bsdf, sample: mi.BSDFSample3f, f_p: mi.Spectrum, active) -> tuple[mi.Spectrum, mi.Float]:
    """f cos / p of light that leaves by a sampled event, and the density with both directions swapped.

    ``f_p`` is Mitsuba's value for IMPORTANCE. For mirrors and glass this value lacks a ratio of cosines. They are the
    cosines to the half-vector, which is the normal of the mirror, whatever the shape's normal is.
    """
    smooth = event_kind(sample.sampled_type) == SMOOTH
    f, q = light_scattered(si, bsdf, sample.wo, active & smooth)
    h = si.wi + sample.eta * sample.wo
    bends = dr.abs(dr.dot(si.wi, h) / dr.dot(sample.wo, h))
    # Light that goes straight through has no half-vector.
    bends = dr.select(dr.squared_norm(h) > 1e-6, bends, 1)
    turns = _quotient(cosine(si, si.to_world(sample.wo)), cosine(si, si.to_world(si.wi)))
    return dr.select(smooth, f * dr.rcp(sample.pdf), f_p * (bends * turns)), q


def leave(
    vertex: Vertex, bsdf, sample: mi.BSDFSample3f, active, η: mi.Float | float = 0.0
) -> tuple[mi.Vector3f, Partial]:
    """The direction of a sampled event, and the partial sums behind it; ``η`` as in ``mis.leave``."""
    si, d = vertex.si, vertex.si.to_world(sample.wo)
    smooth = event_kind(sample.sampled_type) == SMOOTH
    q = reverse_density(si, bsdf, sample.wo, active & smooth)
    return d, mis.leave(vertex.end, cosine(si, d), sample.pdf, q, ~smooth, η)


def light_leaves(
    vertex: Vertex, bsdf, sample: mi.BSDFSample3f, f_p: mi.Spectrum, active
) -> tuple[mi.Vector3f, mi.Spectrum, Partial]:
    """As ``leave()``, for a light path. The second value is f cos / p; ``f_p`` is Mitsuba's."""
    si, d = vertex.si, vertex.si.to_world(sample.wo)
    f_p, q = light_sampled(si, bsdf, sample, f_p, active)
    return d, f_p, mis.leave(vertex.end, cosine(si, d), sample.pdf, q, event_kind(sample.sampled_type) != SMOOTH)


def _come_along(si, wo: mi.Vector3f) -> mi.SurfaceInteraction3f:
    """The interaction ``si`` as if the path had arrived along ``wo``."""
    swapped = mi.SurfaceInteraction3f(si)
    swapped.wi = wo
    return swapped


def _quotient(a: mi.Float, b: mi.Float) -> mi.Float:
    return dr.select(b > 0, a / b, 0)


def cosine(si, d: mi.Vector3f) -> mi.Float:
    """Absolute cosine between ``d`` and the geometric normal; converts densities per solid angle and per area."""
    return dr.abs(dr.dot(si.n, d))
