"""The path from a light, vertex by vertex: what is kept of it, and what a visitor makes of its ends at the camera."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Protocol

import drjit as dr
import mitsuba as mi

from data_gen.paths.camera import CameraSamples
from data_gen.paths.light_ends import LightEnds, LightRay
from data_gen.samplers.bdpt import mis
from data_gen.samplers.bdpt.mis import Partial
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
    C: mi.Spectrum  # 0 where the camera does not see it
    others: mi.Float
    pixel: mi.UInt32
    kept: Any  # what is kept of it


class Visitor(Protocol):
    """What comes along on a light path; its state is part of the loop's."""

    def start(self) -> Any:
        """The state before the first vertex."""

    def sees(self, state: Any, seen: Seen) -> Any:
        """At each vertex; returns the next state."""


@dataclass
class End:
    """The last vertex of a light path, and how it came there."""

    ray: mi.Ray3f
    hit: mi.PreliminaryIntersection3f
    y: Vertex


def begin(scene, lights: LightEnds, random, camera_ray: mi.Ray3f) -> tuple[LightRay, End, mi.Bool]:
    """A path from a light up to its first vertex, and whether there is one; time and wavelengths are those of
    ``camera_ray``."""
    start = lights.sample(scene, random, camera_ray.time, camera_ray.wavelengths)
    active = dr.max(start.β) > 0
    hit = scene.ray_intersect_preliminary(start.ray, active=active)
    si = hit.compute_surface_interaction(start.ray)
    e, p_light = lights.densities(scene, start, si)
    end = mis.begin_light(e, p_light, start.delta, cosine(si, start.ray.d))
    return start, End(start.ray, hit, Vertex(si, start.β, end, mi.UInt32(1))), active & si.is_valid()


def go_on(scene, random, start: LightRay, y: Vertex, bsdf, rr_depth: int, active) -> tuple:
    """The next vertex behind ``y``, whether there is one, the event that leads there, and 1 / the probability to
    survive."""
    u_lobe, u_direction, u_survival = random.next_1d(), random.next_2d(), random.next_1d()
    sample, f_p = bsdf.sample(context(IMPORTANCE), y.si, u_lobe, u_direction, active)
    d, f_p, end = light_leaves(y, bsdf, sample, f_p, active & (sample.pdf > 0))
    β = y.β * dr.select(sample.pdf > 0, f_p, 0)
    # By what is left of the light that the path began with
    survives = dr.select(y.depth < rr_depth, 1, dr.fmin(dr.max(β) * dr.rcp(dr.max(start.β)), 0.95))
    active = active & (sample.pdf > 0) & (dr.max(β) > 0) & (u_survival < survives)
    ray = y.si.spawn_ray(d)
    hit = scene.ray_intersect_preliminary(ray, active=active)
    si = hit.compute_surface_interaction(ray)
    end = mis.arrive(end, cosine(si, d), dr.square(si.t))
    there = End(ray, hit, Vertex(si, β / survives, end, y.depth + 1))
    return there, active & si.is_valid(), sample, dr.rcp(survives)


def unmerged(end: Partial, bsdf: mi.BSDFPtr) -> Partial:
    """What an end knows at a vertex of that material where no photons are gathered."""
    return end


@dr.syntax
def light_path(
    scene,
    lights: LightEnds,
    camera: CameraSamples,
    random,
    camera_ray: mi.Ray3f,
    longest: int,
    rr_depth: int,
    occluded: Callable,
    visitor: Visitor,
    known: Callable[[Partial, mi.BSDFPtr], Partial] = unmerged,
):
    """Traces a path from a light; returns its vertices, how many they are, ``random``, and the visitor's state.

    It has at most ``longest`` edges, and those of ``camera_ray`` are its time and wavelengths. ``occluded`` is asked
    for (si, toward the camera, active), and ``known`` what an end knows at a vertex that it has come to.
    """
    size, lens = camera.size, camera.sensor.needs_aperture_sample()
    start, end, active = begin(scene, lights, random, camera_ray)
    count = mi.UInt32(0)
    Record = record_class(mi.variant())
    kept = dr.alloc_local(Record, longest - 1, dr.zeros(Record))
    state = visitor.start()
    while dr.hint(active, label="light path"):
        bsdf = end.y.si.bsdf()
        y = replace(end.y, end=known(end.y.end, bsdf))
        smooth = active & scatters_smoothly(bsdf)
        # In the place of its depth, smooth or not: Dr.Jit 1.5 (LLVM) errs where the places of lanes differ, and where
        # this loop reads from such places.
        here = record(end.ray, end.hit, y, smooth)
        kept.write(here, y.depth - 1, active)
        count = dr.select(active, y.depth, count)

        # ------------------- To the camera -----------------------
        on_lens = mi.Point2f(0.5)
        if dr.hint(lens, mode="scalar"):
            on_lens = random.next_2d()
        C, others, uv = to_camera(camera.sensor, on_lens, y, bsdf, smooth, occluded)
        pixel = pixel_at(uv, size)
        state = visitor.sees(state, Seen(y, C, others, pixel, here))

        # -------------------- Next vertex ------------------------
        end, active, _, _ = go_on(scene, random, start, y, bsdf, rr_depth, active & (y.depth + 1 < longest))
    return kept, count, random, state


def pixel_at(uv: mi.Point2f, size) -> mi.UInt32:
    """The number of the pixel at a place on the film."""
    return dr.minimum(mi.UInt32(uv.x), size.x - 1) + dr.minimum(mi.UInt32(uv.y), size.y - 1) * size.x
