r"""Camera paths that go through mirrors or glass right behind the vertex that is the copy's own, and their copies.

    x1, x1'   the first vertices of both that are left by a smooth event, at connectable materials
    ω, ω'     directions there; k = 1 .. 6 specular events further on both paths meet
    y         the next vertex at a connectable material, or a lamp
    F, P      products of the events' reflectances, and of the probabilities to take them
    J         dω' / dω at a fixed y

The copy walks to y (``data_gen.paths.manifold``) and shares everything behind y, whichever strategy completes the path
there. For every path that ends at y or goes on from there:

    b' / b    f'(ω') F' J / (f(ω) F)
    r         p'(ω') P' J / (p(ω) P)

Only one strategy builds the path beyond x1 from the light's end: the one that joins x1 to the camera. It is ``vc`` of
``mis`` there, and shifts such paths by a walk of its own (``light_shift``). Each strategy has
weights of its own, so that they need not agree which walks succeed.

Paths with mirrors or glass and holes between x1 and y are rejected.

A path is *bent* from the first of those events on. The kernel of all paths leaves out the differences of what bent
paths bring, and marks lanes that have one; in a second kernel these lanes trace the same paths again, and there all
else is left out. What is bent and cannot be followed is rejected there.

[Hua et al. 2019, "A Survey on Gradient-Domain Rendering", sections 3.4 and 4.2]
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi

from data_gen.paths.manifold import Target, add_event, follow, shoot
from data_gen.paths.vertex import SMOOTH, seen_from
from data_gen.samplers.bdpt import mis
from data_gen.samplers.bdpt.mis import Partial
from data_gen.samplers.bdpt.strategies import emission_at
from data_gen.samplers.bdpt.vertex import RADIANCE, cosine, evaluate
from data_gen.samplers.gbdpt.base_path import Plan, Step, known_met


@dataclass
class Course:
    """Where a base path is, at its current vertex."""

    ahead: mi.Bool  # no smooth event so far
    second: mi.Bool  # right behind the first one, which was at a connectable vertex
    bent: mi.Bool  # all light that it brings from here on belongs to bent paths


def straight(exists: mi.Bool | bool = True) -> Course:
    """The course of a path at the first vertex that the camera sees."""
    return Course(mi.Bool(exists), mi.Bool(False), mi.Bool(False))


def next_course(course: Course, step: Step) -> Course:
    """The course at the next vertex; emission met by chance at that vertex already belongs to it."""
    smooth = step.kind == SMOOTH
    # This depends on the sampled event, not on whether the path survives it, so that both kernels agree.
    bends = course.second & ~smooth & (step.p > 0) & ~mi.Bool(step.passed)
    second = (course.ahead & smooth & step.connectable) | (course.second & step.passed)
    return Course(course.ahead & ~smooth, second, course.bent | bends)


def along(
    plan: Plan, step: Step, course: Course | None, chain: Chain | None
) -> tuple[Step, Course | None, Chain | None]:
    """``step`` with only the light that counts in Δ, and the next ``course`` and ``chain``.

    With a ``chain`` only the light of bent paths counts, without one all other light; without a ``course`` all light.
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
    """Whether the path may still contribute to Δ or to the image; without a ``chain`` it contributes to the image."""
    if course is None or chain is None:
        return mi.Bool(True)
    return course.ahead | course.second | course.bent


def completes(course: Course | None, chain: Chain | None) -> mi.Bool:
    """Whether a connection of the path to light, at the current vertex, contributes to Δ or to the image."""
    return mi.Bool(True) if course is None or chain is None else course.bent


@dataclass
class Chain:
    """The way of a base path from x1 on, up to y."""

    x1: mi.SurfaceInteraction3f
    ω: mi.Vector3f
    p: mi.Float
    survival: mi.Float  # 1 / probability to survive Russian roulette, from x1 on
    events: mi.UInt32  # of ``manifold``
    open: mi.Bool  # y has not been reached
    arrives: mi.Bool  # y is where the last step has led


def no_chain(lanes: int) -> Chain:
    """The chains of base paths that have none yet, one for each of the ``lanes``."""
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
    """Whether a chain ends at ``y`` because of that vertex; its copies do not go on there either."""
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
    """The copy's way from its ``own`` x1' to y, the vertex that ``step`` has led to.

    ``start`` has β, r and ``end`` at x1', as an offset path does. Returned are the ray that arrives at y, β, r and
    ``end`` behind it, and what it meets at y: f J / p and ``others``.
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
