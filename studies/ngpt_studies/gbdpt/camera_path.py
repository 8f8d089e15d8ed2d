"""The camera path and its four copies, vertex by vertex. The same strategies complete all five."""

from __future__ import annotations

from typing import Protocol

import drjit as dr
import mitsuba as mi

from data_gen.paths.eye import Sight
from data_gen.samplers.bdpt import mis
from data_gen.samplers.bdpt.camera_path import choose
from data_gen.samplers.bdpt.light_path import LightPath
from data_gen.samplers.bdpt.vertex import Vertex, cosine, recall, scatters_smoothly
from ngpt_studies.gbdpt.base_path import Past, Plan, Step, base_step
from ngpt_studies.gbdpt.chain_shift import Chain, Course, along, completes, matters
from ngpt_studies.gbdpt.connected_offsets import connect
from ngpt_studies.gbdpt.offset_path import Offset, brightest, start, take_step, with_differences
from ngpt_studies.gbdpt.pairs import weighted


class MergesPairs(Protocol):
    """Gathers photons at camera paths and their copies, as the study ``gvcm`` does."""

    def differences(self, z: Vertex, bsdf: mi.BSDFPtr, active: mi.Bool, offsets: list[Offset]) -> tuple:
        """The weighted light of photons near the vertex ``z``, and Δ of the ``offsets`` with this light added."""


@dr.syntax
def shifted_camera_path(
    plan: Plan,
    sight: Sight,
    shifted: list[tuple],
    light_path: LightPath | None,
    merging: MergesPairs | None = None,
    bends: tuple[Course | None, Chain | None] = (None, None),
) -> tuple:
    """L and Le as in ``bdpt``'s ``camera_path``, Δ of the four offset paths, and the course at the end of the path.

    Offset paths begin with the ``shifted`` rays, each with its importance and whether it is on the film. ``bends``
    holds a course and a chain, either of which may be None. Without a course, Δ contains all paths, and bent ones are
    rejected. With a course, Δ leaves out bent paths. With a chain as well, Δ contains only bent paths, and their copies
    are followed.
    """
    course, chain = bends
    scene, limits, random = plan.scene, plan.limits, sight.random
    ray = mi.Ray3f(sight.ray)
    si = plan.first_hit(scene, ray).compute_surface_interaction(ray)
    offsets = [start(plan, sight.eye, si, one) for one in shifted]
    Le = sight.importance * si.emitter(scene).eval(si, mi.Bool(limits.shows))

    L = dr.zeros(mi.Spectrum, dr.width(ray))
    β = mi.Spectrum(sight.importance)  # throughput f / p up to the vertex si
    depth = mi.UInt32(1)  # edges of the path up to si
    past = Past.of_camera(plan)
    active = si.is_valid() & (depth < limits.max_depth) & matters(course, chain)
    toward, density = sight.eye.toward(si, sight.eye.lens, active)
    end = mis.begin_camera(density, cosine(si, ray.d))  # partial sums of the MIS weights, at si
    edge = plan.begins(si.p + toward.d * toward.dist)  # the edge that leads to si
    while dr.hint(active, label="camera path"):
        # ------- The base path: to a light, and to the next vertex -------
        z = Vertex(si, β, end, depth, edge)
        wanted = completes(course, chain)
        step, past = base_step(plan, random, z, past, active, brightest_offset=brightest(offsets), completed=wanted)
        L += weighted(step.C_light, step.others_light) + weighted(step.C_met, step.others_met)
        # ``step`` now has only the light that this kernel includes in Δ. ``came`` is the course at z.
        came, (step, course, chain) = course, along(plan, step, course, chain)

        # -------------- All five paths: to the light path ----------------
        if dr.hint(light_path is not None, mode="scalar"):
            joins = active & wanted & scatters_smoothly(si.bsdf()) & step.joins
            u = random.next_1d()
            light, Δ = shifted_connection(plan, step, joins, light_path, u, offsets)
            L, offsets = L + light, with_differences(offsets, Δ)

        # -------------- All five paths: to photons near by ---------------
        if dr.hint(merging is not None, mode="scalar"):
            gathers = active & scatters_smoothly(si.bsdf()) & step.joins
            light, Δ = merging.differences(z, si.bsdf(), gathers, offsets)
            L, offsets = L + light, with_differences(offsets, Δ)

        # ------ The copies: to the same light, and the next vertex -------
        offsets = take_step(plan, step, offsets, came, chain, sight.eye)
        si, β, end, edge = step.x1, step.β1, step.end1, step.edge
        depth += 1
        active = step.goes_on & si.is_valid() & (depth < limits.max_depth) & matters(course, chain)
    return L, Le, [offset.Δ for offset in offsets], course


@dr.syntax
def shifted_connection(plan: Plan, step: Step, active, light_path: LightPath, u: mi.Float, offsets: list[Offset]):
    """The light of a connection from the vertex of ``step`` to a light path, and the sums Δ with the connection added.

    ``u`` chooses the vertex of the light path. The base path makes this choice for its copies too, so the chosen vertex
    also stands for all vertices in differences.
    """
    z, L, Δ = step.z, dr.zeros(mi.Spectrum, dr.width(step.z.depth)), [offset.Δ for offset in offsets]
    chosen, times = choose(z, active, light_path, plan.longest, u)
    if active & (times > 0):
        y = recall(light_path.kept.read(chosen), z.si.time, z.si.wavelengths)
        C, others, Δ = connect(plan, step, y, dr.select(step.shared, times, 0), offsets, Δ)
        L = weighted(C, others) * times
    return L, Δ
