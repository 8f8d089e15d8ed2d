"""The path from a light, vertex by vertex: what is kept of it, and what a visitor makes of its ends at the camera."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import drjit as dr
import mitsuba as mi

from data_gen.paths.camera import CameraSamples
from data_gen.samplers.bdpt import mis
from data_gen.samplers.bdpt.lights import LightEnds, LightRay
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

    start: LightRay
    y: Vertex
    d: mi.Vector3f  # the direction in which the path came there
    C: mi.Spectrum  # 0 where the camera does not see it
    others: mi.Float
    uv: mi.Point2f  # its place on the film, in pixels
    lens: mi.Point2f
    pixel: mi.UInt32


class Visitor(Protocol):
    """What comes along on a light path; its state is part of the loop's."""

    def start(self) -> Any:
        """The state before the first vertex."""

    def sees(self, state: Any, seen: Seen) -> Any:
        """At each vertex; returns the next state."""

    def leaves(self, state: Any, depth: mi.UInt32, kept: Any, sample: mi.BSDFSample3f, survival: mi.Float) -> Any:
        """Where the path goes on from there, of which ``kept`` is what is kept; ``survival`` is 1 / probability."""


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
    lanes: mi.Bool | bool = True,
):
    """Traces a path from a light; returns its vertices, how many they are, ``random``, and the visitor's state.

    It has at most ``longest`` edges, and those of ``camera_ray`` are its time and wavelengths. ``occluded`` is asked
    for (si, toward the camera, active).
    """
    size, lens = camera.size, camera.sensor.needs_aperture_sample()
    start = lights.sample(scene, random, camera_ray.time, camera_ray.wavelengths)
    ray, β = start.ray, start.β
    active = (dr.max(β) > 0) & lanes
    brightest = dr.rcp(dr.max(β))
    hit = scene.ray_intersect_preliminary(ray, active=active)
    si = hit.compute_surface_interaction(ray)
    active &= si.is_valid()
    e, p_light = lights.densities(scene, start, si)
    end = mis.begin_light(e, p_light, start.delta, cosine(si, ray.d))
    depth, count = mi.UInt32(1), mi.UInt32(0)
    Record = record_class(mi.variant())
    kept = dr.alloc_local(Record, longest - 1, dr.zeros(Record))
    state = visitor.start()
    while dr.hint(active, label="light path"):
        y = Vertex(si, β, end, depth)
        bsdf = si.bsdf()
        smooth = active & scatters_smoothly(bsdf)
        # In the place of its depth, smooth or not: Dr.Jit 1.5 (LLVM) errs where the places of lanes differ, and where
        # this loop reads from such places.
        here = record(ray, hit, y, smooth)
        kept.write(here, depth - 1, active)
        count = dr.select(active, depth, count)

        # ------------------- To the camera -----------------------
        on_lens = mi.Point2f(0.5)
        if dr.hint(lens, mode="scalar"):
            on_lens = random.next_2d()
        C, others, uv = to_camera(camera.sensor, on_lens, y, bsdf, smooth, occluded)
        pixel = dr.minimum(mi.UInt32(uv.x), size.x - 1) + dr.minimum(mi.UInt32(uv.y), size.y - 1) * size.x
        state = visitor.sees(state, Seen(start, y, ray.d, C, others, uv, on_lens, pixel))

        # -------------------- Next vertex ------------------------
        u_lobe, u_direction, u_survival = random.next_1d(), random.next_2d(), random.next_1d()
        sample, f_p = bsdf.sample(context(IMPORTANCE), si, u_lobe, u_direction, active)
        d, f_p, end = light_leaves(y, bsdf, sample, f_p, active & (sample.pdf > 0))
        β *= dr.select(sample.pdf > 0, f_p, 0)
        # By what is left of the light that the path began with
        survival = dr.select(depth < rr_depth, 1, dr.fmin(dr.max(β) * brightest, 0.95))
        active &= (sample.pdf > 0) & (dr.max(β) > 0) & (u_survival < survival) & (depth + 1 < longest)
        β /= survival
        state = visitor.leaves(state, depth, here, sample, dr.rcp(survival))
        depth += 1
        ray = si.spawn_ray(d)
        hit = scene.ray_intersect_preliminary(ray, active=active)
        si = hit.compute_surface_interaction(ray)
        active &= si.is_valid()
        end = mis.arrive(end, cosine(si, d), dr.square(si.t))
    return kept, count, random, state
