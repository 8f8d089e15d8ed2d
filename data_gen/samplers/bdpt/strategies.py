"""The four ways to complete a path with s vertices from the light and t from the camera, each with its MIS weight.

    emitted     s = 0: the camera path has met an emitter
    to_light    s = 1: the last vertex of the camera path is connected to a sampled point of an emitter
    connected   s, t > 1: the last vertex of the camera path is connected to a vertex of the light path
    to_camera   t = 1: a vertex of the light path is connected to the camera

Each returns f / p of the path that it completes, and ``others`` of ``mis``: the path's weight is 1 / (1 + others).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi

from data_gen.paths.eye import Eye
from data_gen.paths.light_ends import LightEnds
from data_gen.samplers.bdpt import mis
from data_gen.samplers.bdpt.mis import Connection, Side
from data_gen.samplers.bdpt.plan import Plan
from data_gen.samplers.bdpt.vertex import IMPORTANCE, RADIANCE, Vertex, cosine, evaluate


def emission_at(scene, lights: LightEnds, si, ref, active) -> tuple[mi.Spectrum, mi.Float, mi.Float]:
    """Returns Le at ``si`` toward ``ref`` where ``active``, the density of connecting ``ref`` to ``si``, and ``e`` of
    ``mis``.
    """
    light, p = lights.met(scene, si, ref, active)
    Le = light.emitter.eval(si, active)
    cos = dr.abs(dr.dot(light.n, light.d))
    e = lights.emission(lights.index_of(light.emitter, active), p, cos, dr.square(light.dist))
    return Le, p, dr.select(p > 0, e, 0)


def to_light(lights: LightEnds, z: Vertex, light, weight, f, *, p, q) -> tuple[mi.Spectrum, mi.Float]:
    """s = 1. ``light`` and its ``weight`` Le / p come from Mitsuba. f, p and q are as from ``evaluate``, for the
    direction to the light.
    """
    cos = dr.abs(dr.dot(light.n, light.d))
    e = lights.emission(lights.index_of(light.emitter), light.pdf, cos, dr.square(light.dist))
    p_light = dr.select(light.delta, 0, light.pdf)
    return z.β * f * weight, mis.others_to_light(z.end, e, p_light, cosine(z.si, light.d), p, q)


def connected(plan: Plan, z: Vertex, z_bsdf, y: Vertex, active) -> tuple[mi.Spectrum, mi.Float]:
    """s, t > 1, with occlusion."""
    C, edge, _ = connection(plan, z, z_bsdf, y, active)
    return z.β * C, mis.others_connected(z.end, y.end, edge)


def connection(
    plan: Plan, z: Vertex, z_bsdf, y: Vertex, active, sees: Callable | None = None
) -> tuple[mi.Spectrum, Connection, tuple[Any, Any]]:
    """Returns f / p without the camera path's throughput; the edge, for the MIS weight; and a pair (T, number of
    holes), where T is the transmittance of the holes between the vertices.

    ``sees(z, y, active)``, if given, replaces ``plan.sees`` to find T and the number of holes.
    """
    to = mi.Vector3f(y.si.p - z.si.p)
    distance2 = dr.squared_norm(to)
    d = to * dr.rsqrt(distance2)
    f, p_z, q_z = evaluate(RADIANCE, z.si, z_bsdf, z.si.to_local(d), active)
    g, p_y, q_y = evaluate(IMPORTANCE, y.si, y.si.bsdf(), y.si.to_local(-d), active)
    C = y.β * f * g / distance2
    # Two vertices at the same place make no path: its density would be infinite.
    lit = active & (dr.max(z.β * C) > 0) & (distance2 > 0)
    T, holes = sees(z, y, lit) if sees else plan.sees(z.si, y.si.p, plan.longest - 1 - z.depth - y.depth, lit)
    C = dr.select(lit, C * T, 0)
    return C, Connection(Side(cosine(z.si, d), p_z, q_z), Side(cosine(y.si, d), p_y, q_y), distance2), (T, holes)


def to_camera(eye: Eye, lens: mi.Point2f, y: Vertex, bsdf, active, seen) -> tuple[mi.Spectrum, mi.Float, mi.Point2f]:
    """t = 1; the third value is the place on the film, in pixels. ``seen`` (y, camera, active) is the transmittance."""
    camera, importance = eye.toward(y.si, lens, active)
    active = active & (camera.pdf > 0)
    f, _, q = evaluate(IMPORTANCE, y.si, bsdf, y.si.to_local(camera.d), active)
    C = y.β * f * importance
    lit = active & (dr.max(C) > 0)
    C = dr.select(lit, C * seen(y, camera, lit), 0)
    return C, mis.others_to_camera(y.end, importance, cosine(y.si, camera.d), q), camera.uv
