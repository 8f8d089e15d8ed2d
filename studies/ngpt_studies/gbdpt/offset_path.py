"""The four offset paths of a camera sample: how each is shifted, and completed by every strategy.

An offset path is *apart* while it has its own vertices. It is *joined* at the first shared vertex, at which it arrives
from another direction. It is *settled* after that: it differs from its base path only by β, r and the partial sums of
its weights. A path with β = 0 has ended. Symbols are as in ``gbdpt.integrator``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from data_gen.paths.eye import Eye
from data_gen.paths.shift import reconnection_jacobian
from data_gen.paths.vertex import SMOOTH, event_kind, seen_from
from data_gen.samplers.bdpt import mis
from data_gen.samplers.bdpt.mis import Partial
from data_gen.samplers.bdpt.strategies import emission_at
from data_gen.samplers.bdpt.vertex import RADIANCE, context, cosine, evaluate
from ngpt_studies.gbdpt.base_path import Plan, Step, known_end, known_met
from ngpt_studies.gbdpt.chain_shift import Chain, Course, follow_chain
from ngpt_studies.gbdpt.same_light import seen_from_elsewhere


@dataclass
class Offset:
    """The state of one offset path at the current vertex of its base path."""

    ray: mi.Ray3f  # apart: leads to the offset path's own vertex; joined: to the shared one
    hit: mi.PreliminaryIntersection3f  # apart: that vertex
    β: mi.Spectrum  # f J / p, with p of the base path
    r: mi.Float
    end: Partial  # of the offset path, as if it were a base path
    apart: mi.Bool
    joined: mi.Bool
    Δ: mi.Spectrum
    own: Own | None = None  # None in scenes without holes


@dataclass
class Own:
    """The state of an offset path at its last own vertex, which is the path's ``hit``; ``ray`` leads there. The offset
    path returns to it if its base path passes a hole at the vertex where both meet. β is 0 if there is no such vertex.
    """

    ray: mi.Ray3f
    β: mi.Spectrum
    r: mi.Float
    end: Partial


def start(plan: Plan, eye: Eye, x, shifted: tuple) -> Offset:
    """Returns an offset path up to its first vertex, with β = 0 where there is no base path.

    ``shifted`` is the camera ray, its importance, and whether it is on the film.
    """
    ray, importance, inside = shifted
    hit = plan.first_hit(plan.scene, ray)
    y = hit.compute_surface_interaction(ray)
    lives = inside & hit.is_valid() & x.is_valid()
    _, density = eye.toward(y, eye.lens, lives)
    end = mis.begin_camera(density, cosine(y, ray.d))
    n = dr.width(hit.t)
    return Offset(
        ray=mi.Ray3f(ray),
        hit=hit,
        β=dr.select(lives, mi.Spectrum(importance), 0),
        r=mi.Float(1),
        end=Partial(dr.select(lives, end.vcm, 0), mi.Float(0)),
        apart=lives,
        joined=mi.Bool(False),
        Δ=dr.zeros(mi.Spectrum, n),
        own=Own(mi.Ray3f(ray), mi.Spectrum(0), mi.Float(1), Partial(mi.Float(0), mi.Float(0))) if plan.holes else None,
    )


def own_vertex(offset: Offset, x: mi.SurfaceInteraction3f) -> mi.SurfaceInteraction3f:
    """Returns the vertex of an offset path that is not settled. ``x`` is the base path's vertex."""
    own = offset.hit.compute_surface_interaction(offset.ray, active=offset.apart)
    return dr.select(offset.apart, own, seen_from(x, offset.ray.d))


def brightest(offsets: list[Offset]) -> mi.Float:
    """Returns the largest throughput with which any offset path may still contribute to Δ."""
    largest = mi.Float(0)
    for y in offsets:
        largest = dr.fmax(largest, dr.max(y.β) / (1 + y.r))
    return largest


def with_differences(offsets: list[Offset], Δ: list[mi.Spectrum]) -> list[Offset]:
    """The offset paths, with their sums replaced by ``Δ``."""
    return [replace(offset, Δ=total) for offset, total in zip(offsets, Δ, strict=True)]


def take_step(
    plan: Plan,
    step: Step,
    offsets: list[Offset],
    course: Course | None = None,
    chain: Chain | None = None,
    eye: Eye | None = None,
) -> list[Offset]:
    """Shifts a step of the base path for all offset paths, except the connections to the light path. ``course`` is from
    before the step. ``chain`` is from after the step; with it, only bent paths are shifted. ``eye`` gives the MIS
    weights of vertices behind holes in front of the camera.
    """
    busy = mi.Bool(False)
    for offset in offsets:
        busy |= offset.apart | offset.joined
    offsets = [settled(plan, step, offset) for offset in offsets]

    # A step takes long to compile, so one copy of it is in a loop over the four paths. Each round steps the first path
    # and moves it behind the others. After four rounds they are in their order again.
    def rotate(i, y, *others):
        own = y.apart | y.joined
        y = dr.if_stmt((y,), own, lambda y: step_own(plan, step, y, course, chain, eye), lambda y: y)
        return i + 1, *others, y

    state = (mi.UInt32(0), *offsets)
    return list(dr.while_loop(state, lambda i, *_: busy & (i < len(offsets)), rotate, label="offset steps")[1:])


def settled(plan: Plan, step: Step, y: Offset) -> Offset:
    """The step of a settled offset path, which is the same as its base path's. Other offset paths stay as they are."""
    here = ~(y.apart | y.joined)
    x = step.z.si
    # ------------------------ To a light -------------------------
    end = known_end(y.end, step.joins_light)
    cos = cosine(x, step.light.d)
    p_light = dr.select(step.light.delta, 0, step.light.pdf)
    others = mis.others_to_light(end, step.e_light, p_light, cos, step.p_light, step.q_light)
    Δ = plan.pair(step.C_light, step.others_light, y.β * step.f_light * step.weight, y.r, others)
    # ----------------------- Next vertex -------------------------
    β = y.β * step.f_p
    end = mis.leave(y.end, cosine(x, step.d), step.p, step.q, step.kind != SMOOTH, step.η)
    if plan.holes:
        end = plan.carried(step.passed, replace(step.z, end=y.end), end)
    # ------------------ Emission met by chance -------------------
    others = mis.others_emitted(known_met(end, step.counted), step.e_met, step.p_met)
    Δ += plan.pair(step.C_met, step.others_met, β * step.Le, y.r, others)
    end = plan.arrives(end, step.edge, step.x1, step.d)
    return Offset(
        ray=y.ray,
        hit=y.hit,
        β=dr.select(here, dr.select(step.goes_on, β, 0), y.β),
        r=y.r,
        end=dr.select(here, end, y.end),
        apart=y.apart,
        joined=y.joined,
        Δ=y.Δ + dr.select(here, Δ, 0),
        own=y.own,
    )


def step_own(
    plan: Plan,
    step: Step,
    y: Offset,
    course: Course | None = None,
    chain: Chain | None = None,
    eye: Eye | None = None,
) -> Offset:
    """The step from an offset path's own vertex, or from the shared vertex at which it is joined."""
    # --------------- The vertex: apart, or just joined ---------------
    si = own_vertex(y, step.z.si)
    bsdf = si.bsdf()
    connectable = plan.materials.connectable(bsdf)

    # ------------------------ To a light -------------------------
    lit = (dr.max(step.C_light) > 0) & step.connectable & connectable
    C, r, others = to_same_light(plan, step, y, si, bsdf, lit)
    Δ = y.Δ + plan.pair(step.C_light, step.others_light, C, y.r * r, others)

    # ------------- Next vertex: reconnect, or replay -------------
    smooth = step.kind == SMOOTH
    joins = step.goes_on & smooth & step.connectable & connectable
    replays = step.goes_on & ~smooth & y.apart
    # If it does neither it is rejected: β = 0.
    nothing = y.own and replace(y.own, β=mi.Spectrum(0))
    none = Offset(y.ray, y.hit, mi.Spectrum(0), y.r, y.end, mi.Bool(False), mi.Bool(False), Δ, nothing)
    state = (none, mi.Spectrum(0), mi.Float(0))
    if chain is not None:
        # The offset path waits at its own vertex until the chain has reached y.
        waits = y.apart & connectable & (chain.open | chain.arrives)
        joins &= y.joined
        replays &= course.ahead
        state = dr.select(waits, (replace(y, Δ=Δ), *state[1:]), state)
        walks = waits & chain.arrives
        state = dr.if_stmt(state, walks, lambda *_: bend(plan, step, chain, y, none, si), lambda *old: old)
    state = dr.if_stmt(state, joins, lambda *_: reconnect(plan, step, y, none, si), lambda *old: old)
    if plan.holes:
        passes = step.goes_on & step.passed
        back, through = passes & y.joined & (dr.max(y.own.β) > 0), passes & replays
        replays &= ~passes
        ahead = replace(y, ray=y.own.ray, β=y.own.β, r=y.own.r, end=y.own.end, apart=back, joined=mi.Bool(False))
        before = own_vertex(ahead, step.z.si)
        state = dr.if_stmt(state, back, lambda *_: reconnect(plan, step, ahead, none, before), lambda *old: old)
        state = dr.if_stmt(state, through, lambda *_: go_through(plan, step, y, none, si, eye), lambda *old: old)
    # A scene with only smooth events needs no replay.
    if not plan.materials.all_connectable:
        state = dr.if_stmt(state, replays, lambda *_: replay(plan, step, y, none, si, bsdf), lambda *old: old)
    moved, C, others = state

    # ------------------ Emission met by chance -------------------
    moved.Δ = moved.Δ + plan.pair(step.C_met, step.others_met, C, moved.r, others)
    return moved


def reconnect(plan: Plan, step: Step, y: Offset, none: Offset, si) -> tuple[Offset, mi.Spectrum, mi.Float]:
    """Connects ``si`` straight to the base path's next vertex, or takes the base path's direction if that escapes. Also
    returns f J / p and ``others`` of the emission there.

    If the base path has passed holes on its way there, the copy must pass the same number of holes.
    """
    # ------------------------ The segment ------------------------
    way, x1 = step.way, step.x1
    reaches = x1.is_valid()
    to = mi.Vector3f(x1.p - si.p)
    distance2 = dr.squared_norm(to)
    d = dr.select(reaches, to * dr.rsqrt(distance2), step.d)
    J = dr.select(reaches, reconnection_jacobian(way.o, si.p, x1.p, x1.n), 1)
    f, p, q = evaluate(RADIANCE, si, si.bsdf(), si.to_local(d))
    ray = dr.select(reaches, si.spawn_ray_to(x1.p), si.spawn_ray(d))
    good = (p > 0) & dr.isfinite(J) & (dr.max(f) > 0)
    # A joined path takes the direction of its base path.
    T = mi.Spectrum(1)
    if plan.holes:
        target = dr.select(reaches, x1.p, plan.outside(si.p, d))
        T = mi.Spectrum(plan.sees_alike(si, target, (1, way.holes), good & y.apart))
        good &= dr.max(T) > 0
    else:
        good &= ~plan.scene.ray_test(ray, good & y.apart)
    β, r = y.β * f * (J / way.p * way.weight), y.r * (J * p / way.p)
    if plan.holes:
        β *= T
    good &= dr.isfinite(dr.sum(β)) & dr.isfinite(r)
    β, r = dr.select(good, β, 0), dr.select(good, r, 0)
    end = mis.leave(y.end, cosine(si, d), p, q, mi.Bool(False), way.η)

    # ----------------------- Emission at x1 ----------------------
    y1 = seen_from(x1, d)
    Le, p_met, e = emission_at(plan.scene, plan.lights, y1, si, good & step.met)
    others = mis.others_emitted(known_met(end, step.counted), e, p_met)
    end = mis.arrive(end, cosine(x1, d), distance2)
    # If the next vertex is not connectable the shift is rejected there, but emission at this vertex counts.
    lives = good & reaches & (y.joined | step.x1_connectable)
    joined, own = lives & y.apart, none.own
    if plan.holes:
        # The path may have to return to this vertex.
        waits = y.apart & reaches & plan.holes.known.of(x1.bsdf(), reaches)[1]
        joined, own = joined | waits, Own(y.ray, dr.select(waits, y.β, 0), y.r, y.end)
    ray = mi.Ray3f(si.p, d, si.time, si.wavelengths)
    moved = Offset(ray, none.hit, dr.select(lives, β, 0), r, end, mi.Bool(False), joined, none.Δ, own)
    return moved, β * Le, others


def go_through(plan: Plan, step: Step, y: Offset, none: Offset, si, eye: Eye) -> tuple[Offset, mi.Spectrum, mi.Float]:
    """Passes the hole at ``si``, as the base path has passed one. Both are before the first smooth event."""
    T, d = plan.holes.share(si, mi.Bool(True)), mi.Vector3f(y.ray.d)
    β = y.β * T * (step.survival / step.p)
    good = (dr.max(T) > 0) & dr.isfinite(dr.sum(β))
    ray = si.spawn_ray(d)
    hit = plan.scene.ray_intersect_preliminary(ray, active=good)
    y1 = hit.compute_surface_interaction(ray)
    Le, p_met, e = emission_at(plan.scene, plan.lights, y1, si, good & step.met)
    # Behind mirrors vcm is 0, so lengths do not matter.
    end = mis.passed(y.end, cosine(si, d), mi.Float(1))
    others = dr.select(step.edge.first, 0, mis.others_emitted(known_met(end, step.counted), e, p_met))
    end = mis.arrive(end, cosine(y1, d), mi.Float(1))
    seen = mis.begin_camera(eye.toward(y1, eye.lens)[1], cosine(y1, d))
    end = Partial(dr.select(step.edge.first, seen.vcm, end.vcm), dr.select(step.edge.first, seen.vc, end.vc))
    β, lives = dr.select(good, β, 0), good & y1.is_valid() & step.x1.is_valid()
    return Offset(ray, hit, dr.select(lives, β, 0), y.r, end, lives, mi.Bool(False), none.Δ, none.own), β * Le, others


def replay(plan: Plan, step: Step, y: Offset, none: Offset, si, bsdf) -> tuple[Offset, mi.Spectrum, mi.Float]:
    """Replays an event at a mirror or glass with the base path's random numbers; includes emission at the next vertex.

    Only camera paths sample such events, which are before the first smooth event. So for every strategy their random
    numbers belong to the path: r = 1, and the shift depends on the path only.
    """
    sample, f_p = bsdf.sample(context(RADIANCE), si, step.u_lobe, step.u_direction)
    good = (sample.pdf > 0) & (event_kind(sample.sampled_type) == step.kind)
    d = si.to_world(sample.wo)
    ray = si.spawn_ray(d)
    hit = plan.scene.ray_intersect_preliminary(ray, active=good)
    y1 = hit.compute_surface_interaction(ray)
    β = dr.select(good, y.β * f_p * step.survival, 0)
    β = dr.select(dr.isfinite(dr.sum(β)), β, 0)
    end = mis.leave(y.end, cosine(si, d), sample.pdf, mi.Float(0), mi.Bool(True))
    Le, p_met, e = emission_at(plan.scene, plan.lights, y1, si, good & step.met)
    others = mis.others_emitted(known_met(end, step.counted), e, p_met)
    end = mis.arrive(end, cosine(y1, d), dr.square(y1.t))
    lives = good & y1.is_valid() & step.x1.is_valid()
    return Offset(ray, hit, dr.select(lives, β, 0), y.r, end, lives, mi.Bool(False), none.Δ, none.own), β * Le, others


def bend(plan: Plan, step: Step, chain: Chain, y: Offset, none: Offset, si) -> tuple:
    """Walks through the mirrors and glass of the base path to its next vertex; includes emission there."""
    ray, β, r, end, C, others = follow_chain(plan, step, chain, y, si, mi.Bool(True))
    lives = step.x1.is_valid() & step.x1_connectable & (dr.max(β) > 0)
    return Offset(ray, none.hit, dr.select(lives, β, 0), r, end, mi.Bool(False), lives, none.Δ, none.own), C, others


def to_same_light(plan: Plan, step: Step, y: Offset, si, bsdf, active):
    """f J / p, a factor of r, and ``others`` of the copy that ends at the same point of an emitter."""
    base = step.light
    light, weight, r = seen_from_elsewhere(plan.lights, plan.scene, base, step.weight, si, active, front=step.front)
    f, p, q = evaluate(RADIANCE, si, bsdf, si.to_local(light.d), active)
    C = y.β * f * weight
    lit = active & (dr.max(C) > 0)
    C = dr.select(lit, C * plan.sees_alike(si, light.p, step.through, lit & y.apart), 0)
    cos = dr.abs(dr.dot(light.n, light.d))
    e = plan.lights.emission(plan.lights.index_of(light.emitter), light.pdf, cos, dr.square(light.dist))
    p_light = dr.select(light.delta, 0, light.pdf)
    return C, r, mis.others_to_light(known_end(y.end, step.joins_light), e, p_light, cosine(si, light.d), p, q)
