"""The path from a light: the records of its vertices, and a visitor that receives its connections to the camera."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Protocol

import drjit as dr
import mitsuba as mi

from data_gen.paths.eye import Sight
from data_gen.paths.light_ends import LightRay
from data_gen.paths.walk import roulette
from data_gen.samplers.bdpt import mis
from data_gen.samplers.bdpt.plan import Plan
from data_gen.samplers.bdpt.strategies import to_camera
from data_gen.samplers.bdpt.vertex import (
    IMPORTANCE,
    Vertex,
    context,
    cosine,
    light_leaves,
    record,
    record_class,
    scatters_smoothly,
)


@dataclass
class Seen:
    """A light path up to a vertex, joined to the camera."""

    y: Vertex
    C: mi.Spectrum  # f / p of the whole path; 0 where the camera does not see ``y``
    others: mi.Float
    pixel: mi.UInt32
    kept: Any  # the record of ``y``


class Visitor(Protocol):
    """Functions that are called at each vertex of a light path. Their state is part of the state of the loop."""

    def start(self) -> Any:
        """The state before the first vertex."""

    def sees(self, state: Any, seen: Seen) -> Any:
        """Called at each vertex; returns the next state."""


@dataclass
class End:
    """The last edge of a light path, and the vertex ``y`` at its end."""

    ray: mi.Ray3f
    hit: mi.PreliminaryIntersection3f
    y: Vertex


@dataclass
class LightPath:
    """The records of the vertices of a path from a light."""

    kept: Any  # ``read(i)`` is the ``record`` of the vertex that is i + 1 edges from the light
    count: mi.UInt32  # how many vertices it has


def begin(plan: Plan, random, camera_ray: mi.Ray3f) -> tuple[LightRay, End, mi.Bool]:
    """Returns the start and the first vertex of a light path, and whether this vertex exists. The path has the time and
    the wavelengths of ``camera_ray``."""
    scene, lights = plan.scene, plan.lights
    start = lights.sample(scene, random, camera_ray.time, camera_ray.wavelengths)
    active = dr.max(start.β) > 0
    hit = scene.ray_intersect_preliminary(start.ray, active=active)
    si = hit.compute_surface_interaction(start.ray)
    y = Vertex(si, start.β, lit(plan, start, si), mi.UInt32(1), plan.begins(start.ray.o))
    return start, End(start.ray, hit, y), active & si.is_valid()


def lit(plan: Plan, start: LightRay, si: mi.SurfaceInteraction3f) -> mis.Partial:
    """The partial sums of MIS weights at the first vertex."""
    e, p_light = plan.lights.densities(plan.scene, start, si)
    return mis.begin_light(e, p_light, start.delta, cosine(si, start.ray.d))


def go_on(plan: Plan, random, start: LightRay, y: Vertex, bsdf, active) -> tuple:
    """Returns the next vertex after ``y`` with the edge to it, whether this vertex exists, the event at ``y`` that
    leads to it, and 1 / the survival probability.
    """
    u_lobe, u_direction, u_survival = random.next_1d(), random.next_2d(), random.next_1d()
    sample, f_p = bsdf.sample(context(IMPORTANCE), y.si, u_lobe, u_direction, active)
    known = replace(y, end=plan.known(y.end, bsdf))
    d, f_p, end = light_leaves(known, bsdf, sample, f_p, active & (sample.pdf > 0))
    # The partial sums behind a hole must not include photons gathered at the hole. So this call gets ``y``, and not
    # ``known``.
    end, edge = plan.onward(y, bsdf, sample, end)
    β = y.β * dr.select(sample.pdf > 0, f_p, 0)
    # Russian roulette depends on the share of the path's initial light that is left.
    survives = roulette(dr.max(β) * dr.rcp(dr.max(start.β)), y.depth >= plan.limits.rr_depth)
    active = active & (sample.pdf > 0) & (dr.max(β) > 0) & (u_survival < survives)
    ray = y.si.spawn_ray(d)
    hit = plan.scene.ray_intersect_preliminary(ray, active=active)
    si = hit.compute_surface_interaction(ray)
    end = plan.arrives(end, edge, si, d)
    if edge is not None:
        # The partial sums behind the first edge depend on its whole length, even if it leads through holes.
        first = lit(plan, start, si)
        end = mis.Partial(dr.select(edge.first, first.vcm, end.vcm), dr.select(edge.first, first.vc, end.vc))
    there = End(ray, hit, Vertex(si, β / survives, end, y.depth + 1, edge))
    return there, active & si.is_valid(), sample, dr.rcp(survives)


@dr.syntax
def light_path(plan: Plan, sight: Sight, visitor: Visitor) -> tuple[LightPath, Any, Any]:
    """Traces a path from a light. Returns its vertices, the remaining random numbers, and the visitor's state.

    The path has at most ``plan.longest`` edges, including the edge to the camera.
    """
    eye, random = sight.eye, sight.random.clone()
    start, end, active = begin(plan, random, sight.ray)
    count = mi.UInt32(0)  # vertices so far
    Record = record_class(mi.variant())
    kept = dr.alloc_local(Record, plan.longest - 1, dr.zeros(Record))  # by depth
    state = visitor.start()
    while dr.hint(active, label="light path"):
        bsdf = end.y.si.bsdf()
        y = replace(end.y, end=plan.known(end.y.end, bsdf))
        smooth = active & scatters_smoothly(bsdf)

        # ------------------------- Keep --------------------------
        # Each vertex is kept at an index that is its depth - 1, even if nothing can be connected to it. Dr.Jit 1.5
        # (LLVM) gives wrong results if the indices of lanes differ, or if this loop reads the array.
        here = record(end.ray, end.hit, y, smooth)
        kept.write(here, y.depth - 1, active)
        count = dr.select(active, y.depth, count)

        # --------------------- To the camera ---------------------
        on_lens = eye.place_on_lens(random)
        C, others, uv = to_camera(eye, on_lens, y, bsdf, smooth, plan.seen_by_camera)
        state = visitor.sees(state, Seen(y, C, others, eye.pixel_at(uv), here))

        # ---------------------- Next vertex ----------------------
        end, active, _, _ = go_on(plan, random, start, end.y, bsdf, active & (y.depth + 1 < plan.longest))
    return LightPath(kept, count), random, state
