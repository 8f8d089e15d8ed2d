r"""Camera paths that go through mirrors or glass directly after the vertex x1 below, and their copies.

    x1, x1'   the first vertex of each path that it leaves by a smooth event, at a connectable material
    ω, ω'     the directions there; k = 1 .. 6 specular events later both paths meet
    y         the next vertex at a connectable material, or a lamp
    F, P      products of the events' reflectances, and of the probabilities to sample them
    J         dω' / dω at a fixed y

The copy walks to y (``ngpt_studies.gbdpt.manifold``) and shares all vertices behind y, whichever strategy completes the
path there. For each path that ends at y or goes on from there:

    b' / b    f'(ω') F' J / (f(ω) F)
    r         p'(ω') P' J / (p(ω) P)

Only one strategy traces the edges from x1 to y from the light's end: the one that joins x1 to the camera. It
contributes ``vc`` of ``mis`` there, and shifts such paths by its own walk (``light_shift``). Each strategy has separate
weights for pairs, so strategies need not agree on which walks succeed.

Paths that have both holes and mirrors or glass between x1 and y are rejected.

A path is *bent* from the first of those events on. The kernel of all paths leaves the light of bent paths out of the
differences, and marks lanes with a bent path. A second kernel traces the paths of these lanes again, and computes the
differences of bent paths only. There, bent paths that cannot be followed are rejected.

[Hua et al. 2019, "A Survey on Gradient-Domain Rendering", sections 3.4 and 4.2]
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi

from data_gen.paths.vertex import SMOOTH, seen_from
from data_gen.samplers.bdpt import mis
from data_gen.samplers.bdpt.mis import Partial
from data_gen.samplers.bdpt.strategies import emission_at
from data_gen.samplers.bdpt.vertex import RADIANCE, cosine, evaluate
from ngpt_studies.gbdpt.base_path import Plan, Step, known_met
from ngpt_studies.gbdpt.manifold import Target, add_event, follow, shoot


@dataclass
class Course:
    """The state of a base path at its current vertex, with regard to bends."""

    ahead: mi.Bool  # no smooth event so far
    second: mi.Bool  # the first smooth event was at the last vertex, which was connectable
    bent: mi.Bool  # all light that it finds from here on belongs to bent paths


def straight(exists: mi.Bool | bool = True) -> Course:
    """The course of a path at the first vertex that the camera sees."""
    return Course(mi.Bool(exists), mi.Bool(False), mi.Bool(False))


def next_course(course: Course, step: Step) -> Course:
    """The course at the next vertex; emission met by chance at that vertex already belongs to it."""
    smooth = step.kind == SMOOTH
    # This depends on the sampled event, not on whether the path survives Russian roulette, so that both kernels agree.
    bends = course.second & ~smooth & (step.p > 0) & ~mi.Bool(step.passed)
    second = (course.ahead & smooth & step.connectable) | (course.second & step.passed)
    return Course(course.ahead & ~smooth, second, course.bent | bends)


def along(
    plan: Plan, step: Step, course: Course | None, chain: Chain | None
) -> tuple[Step, Course | None, Chain | None]:
    """``step`` with only the light that belongs in Δ, and the next ``course`` and ``chain``.

    Without a ``course`` this is all light. With a ``chain`` it is the light of bent paths, without one all other light.
    """
    if course is None or plan.materials.all_connectable:
        return step, course, chain
    behind = next_course(course, step)
    now, then = course.bent, behind.bent
    if chain is None:
        now, then = ~now, ~then
    else:
        chain = next_chain(plan, chain, course, step)
    C_light, C_met = dr.select(now, step.C_light, 0), dr.select(then, step.C_met, 0)
    return replace(step, shared=now, C_light=C_light, C_met=C_met), behind, chain


def matters(course: Course | None, chain: Chain | None) -> mi.Bool:
    """Whether the path may still contribute to Δ or to the image. The kernel with a ``chain`` renders only Δ."""
    if course is None or chain is None:
        return mi.Bool(True)
    return course.ahead | course.second | course.bent


def completes(course: Course | None, chain: Chain | None) -> mi.Bool:
    """Whether a connection of the path to light, at the current vertex, contributes to Δ or to the image."""
    return mi.Bool(True) if course is None or chain is None else course.bent


@dataclass
class Chain:
    """The part of a base path from x1 to y."""

    x1: mi.SurfaceInteraction3f
    ω: mi.Vector3f
    p: mi.Float
    survival: mi.Float  # 1 / probability to survive Russian roulette after x1
    events: mi.UInt32  # of ``manifold``
    open: mi.Bool  # whether y has not been reached yet
    arrives: mi.Bool  # whether the last step has reached y


def no_chain(lanes: int) -> Chain:
    """Empty chains, one for each of the ``lanes``."""
    return Chain(
        x1=dr.zeros(mi.SurfaceInteraction3f, lanes),
        ω=mi.Vector3f(0),
        p=mi.Float(1),
        survival=mi.Float(1),
        events=mi.UInt32(0),
        open=mi.Bool(False),
        arrives=mi.Bool(False),
    )


def ends(plan: Plan, y: mi.SurfaceInteraction3f) -> mi.Bool:
    """Whether a chain ends at ``y``, whatever is sampled there. A copy must also end at such a vertex."""
    return ~y.is_valid() | plan.materials.connectable(y.bsdf()) | (y.emitter(plan.scene) != None)  # noqa: E711 - pointers


def next_chain(plan: Plan, chain: Chain, course: Course, step: Step) -> Chain:
    """The chain behind ``step``; ``course`` is the one before it."""
    begins = course.ahead & (step.kind == SMOOTH) & step.connectable & step.goes_on
    events, fits = add_event(chain.events, step.event)
    longer = chain.open & step.goes_on & (step.kind != SMOOTH) & (step.event != 0) & fits & ~mi.Bool(step.passed)
    lit = (step.x1.is_valid() & step.x1_connectable) | (dr.max(step.C_met) > 0)
    return Chain(
        x1=dr.select(begins, step.z.si, chain.x1),
        ω=dr.select(begins, step.d, chain.ω),
        p=dr.select(begins, step.p, chain.p),
        survival=dr.select(begins, 1, chain.survival) * step.survival,
        events=dr.select(begins, 0, dr.select(longer, events, chain.events)),
        open=begins | (longer & ~ends(plan, step.x1)),
        arrives=longer & lit,
    )


def follow_chain(plan: Plan, step: Step, chain: Chain, start: Any, own: mi.SurfaceInteraction3f, active) -> tuple:
    """Follows the copy from its ``own`` vertex x1' to y, the vertex to which ``step`` leads.

    ``start`` has β, r and ``end`` at x1', as an offset path does. Returns the ray that arrives at y, β, r and ``end``
    there, and f J / p and ``others`` of the emission at y.
    """
    # -------------------------- The walk -------------------------
    scene, y, reached = plan.scene, step.x1, step.x1.is_valid()
    target = Target(y.p, dr.select(reached, mi.Vector3f(y.n), step.d), ~reached)
    base = shoot(scene, chain.x1, chain.ω, chain.events, target, active)
    ω, shot, J, found = follow(
        scene, chain.x1, chain.ω, base, own, chain.events, target=target, active=active, ends=partial(ends, plan)
    )
    f, p, q = evaluate(RADIANCE, own, own.bsdf(), own.to_local(ω), found)

    # ------------------------ Throughput -------------------------
    J *= shot.P / (chain.p * base.P)
    β, r = start.β * f * shot.weight * (J * chain.survival), start.r * p * J
    found &= (p > 0) & dr.isfinite(dr.sum(β)) & dr.isfinite(r)
    β, r = dr.select(found, β, 0), dr.select(found, r, 0)
    end = mis.leave(start.end, cosine(own, ω), p, q, mi.Bool(False))
    end = Partial(mi.Float(0), end.vc * shot.turns)

    # ----------------------- Emission at y -----------------------
    last = mi.SurfaceInteraction3f(y)
    last.p = shot.ray.o
    met = found & step.met
    Le, p_met, e = emission_at(scene, plan.lights, seen_from(y, shot.ray.d), last, met)
    others = mis.others_emitted(known_met(end, step.counted), e, p_met)
    return shot.ray, β, r, Partial(end.vcm, end.vc / cosine(y, shot.ray.d)), β * Le, others
