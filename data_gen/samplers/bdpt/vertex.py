"""Vertices of paths from either end, how light scatters there, and what is kept of those of light paths."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import drjit as dr
import mitsuba as mi

from data_gen.paths.vertex import SMOOTH, event_kind
from data_gen.samplers.bdpt import mis
from data_gen.samplers.bdpt.mis import Partial

# By name: Mitsuba's own values belong to a variant.
RADIANCE, IMPORTANCE = "Radiance", "Importance"


def context(mode: str) -> mi.BSDFContext:
    """What a path carries, for Mitsuba's materials."""
    return mi.BSDFContext(getattr(mi.TransportMode, mode))


@dataclass
class Vertex:
    """The last vertex of a path: at ``si``, behind ``depth`` edges."""

    si: mi.SurfaceInteraction3f
    β: mi.Spectrum  # throughput of the path so far
    end: Partial
    depth: mi.UInt32


@cache
def record_class(variant: str) -> type:
    """Of what is kept; Dr.Jit reads the types of its fields once, and Mitsuba's belong to a variant."""

    @dataclass
    class Record:
        """A vertex of a light path as it is kept: 23 words in RGB, and no Bool, with which Dr.Jit 1.5 breaks off.

        The interaction is computed anew from the ray that led there and what it hit.
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
    """What is kept of a ``vertex`` that ``ray`` has hit; its depth is 0 if nothing can be connected to it."""
    end = vertex.end
    where = (mi.Point3f(ray.o), mi.Vector3f(ray.d), mi.Float(hit.t), mi.Point2f(hit.prim_uv), mi.UInt32(hit.prim_index))
    shapes = (mi.ShapePtr(hit.shape), mi.ShapePtr(hit.instance))
    depth = dr.select(smooth, vertex.depth, 0)
    return record_class(mi.variant())(
        *where, *shapes, mi.Normal3f(vertex.si.n), mi.Spectrum(vertex.β), mi.Float(end.vcm), mi.Float(end.vc), depth
    )


def recall(kept, time: mi.Float, wavelengths: mi.Wavelength) -> Vertex:
    """The vertex of which a record was kept."""
    hit = dr.zeros(mi.PreliminaryIntersection3f, dr.width(kept.t))
    hit.t, hit.prim_uv, hit.prim_index, hit.shape, hit.instance = (
        kept.t,
        kept.prim_uv,
        kept.prim_index,
        kept.shape,
        kept.instance,
    )
    # Not told by any other field: without it the vertex would be void.
    hit.valid = mi.Bool(True)
    si = hit.compute_surface_interaction(mi.Ray3f(kept.o, kept.d, time, wavelengths))
    return Vertex(si, kept.β, Partial(kept.vcm, kept.vc), kept.depth)


def scatters_smoothly(bsdf: mi.BSDFPtr) -> mi.Bool:
    """Whether a path may be connected at such a material."""
    return mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)


def evaluate(mode, si, bsdf, wo: mi.Vector3f, active=True) -> tuple[mi.Spectrum, mi.Float, mi.Float]:
    """f cos for a path that goes on along ``wo`` (local), the density of that, and with both directions swapped."""
    f, p = bsdf.eval_pdf(context(mode), si, wo, active)
    good = dr.isfinite(p) & dr.isfinite(dr.sum(f))
    f, p = dr.select(good, f, 0), dr.select(good, p, 0)
    if mode == IMPORTANCE:
        f = f * adjoint(si, wo)
    return f, p, reverse_density(si, bsdf, wo, active)


def reverse_density(si, bsdf, wo: mi.Vector3f, active) -> mi.Float:
    """Density of sampling the direction that the path comes from, had it come along ``wo``."""
    swapped = mi.SurfaceInteraction3f(si)
    swapped.wi = wo
    q = bsdf.pdf(mi.BSDFContext(), swapped, si.wi, active)
    return dr.select(dr.isfinite(q), q, 0)


def leave(vertex: Vertex, bsdf, sample: mi.BSDFSample3f, active) -> tuple[mi.Vector3f, Partial]:
    """The direction of a sampled event, and what the path's end knows behind it."""
    si, d = vertex.si, vertex.si.to_world(sample.wo)
    smooth = event_kind(sample.sampled_type) == SMOOTH
    q = reverse_density(si, bsdf, sample.wo, active & smooth)
    return d, mis.leave(vertex.end, cosine(si, d), sample.pdf, q, ~smooth)


def adjoint(si, wo: mi.Vector3f) -> mi.Float:
    """What shading normals do to light that is not to radiance: cos_s(wi) cos_g(wo) / cos_g(wi) cos_s(wo) (Veach 1997,
    "Robust Monte Carlo Methods for Light Transport Simulation", eq. 5.19)."""
    wi_cos, wo_cos = dr.dot(si.to_world(si.wi), si.n), dr.dot(si.to_world(wo), si.n)
    factor = dr.abs((si.wi.z / wi_cos) * (wo_cos / wo.z))
    return dr.select(dr.isfinite(factor), factor, 0)


def cosine(si, d: mi.Vector3f) -> mi.Float:
    """Absolute, to the geometric normal, along which densities per area are converted."""
    return dr.abs(dr.dot(si.n, d))
