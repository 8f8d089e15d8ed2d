"""The offset paths of ``gpt``: how each of them follows the steps of its base path. Symbols as in ``gpt``."""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from data_gen.paths import caustic, media, shift
from data_gen.paths.holes import Aim
from data_gen.paths.lights import emission, replay_lamp, replay_light, shared_emission
from data_gen.paths.mis import gradient_weight, mis_weight
from data_gen.paths.segments import Segment
from data_gen.paths.vertex import DELTA, SMOOTH, event_kind, seen_from
from data_gen.paths.walk import Sky
from data_gen.samplers.gpt.base_path import Path, Step, light_mis
from data_gen.samplers.gpt.half_vector import Departure, copy_where_smooth
from data_gen.samplers.gpt.plan import Plan


@dataclass
class Offset:
    """The state of one offset path at the current vertex of its base path."""

    ray: mi.Ray3f  # to the path's own vertex while it is apart, to the shared vertex when it is joined
    hit: mi.PreliminaryIntersection3f  # while apart: the hit at its own vertex
    place: media.Place | None  # while apart: the place of its own vertex; None in scenes without media
    β: mi.Spectrum
    r: mi.Float
    apart: mi.Bool
    joined: mi.Bool
    sky: Sky  # whether the path sees the environment if it escapes
    rough: mi.Bool  # see data_gen.paths.caustic; an offset path is never late
    a: mi.Spectrum  # once settled: light C that the base path finds later adds a C to Δ
    Δ: mi.Spectrum  # 2 w (C(y) |J| - C(x)) / p(x), so far
    w2: mi.Float  # once settled: 2 w, the same for all later light
    A: mi.Spectrum  # 2 w C(x) / p(x), the base path's part of Δ, so far
    failed: mi.Bool  # whether the base path has taken a step to which no step of the offset path corresponds
    # In scenes with holes: the offset path's own aim (``data_gen.paths.holes``). Once the path is settled, only the
    # ``p`` of its aim counts, which is the base path's ``p`` from the next scattering on
    aim: Aim | None = None


@dataclass
class Own:
    """The vertex of an offset path that is apart from its base path."""

    y: mi.SurfaceInteraction3f
    place: media.Place | None
    bsdf: mi.BSDFPtr
    connectable: mi.Bool


@dataclass
class Move:
    """One step of an offset path that is apart from its base path. ``good`` is False where the shift is rejected."""

    ray: mi.Ray3f
    hit: mi.PreliminaryIntersection3f
    place: media.Place | None
    f_p: mi.Spectrum  # f |J| / p, with the p of the base path
    r: mi.Float  # p' |J| / p
    sky: Sky
    rough: mi.Bool
    aim: Aim | None
    L_bsdf: mi.Spectrum
    reaches: mi.Bool  # whether there is a next vertex
    good: mi.Bool


def start(plan: Plan, base: Path, first: Segment, importance: mi.Spectrum, inside: mi.Bool) -> Offset:
    """Returns an offset path after its ``first`` segment. ``inside`` says whether its pixel is on the film. An offset
    path that has found no vertex has ended.

    A base path that has ended walks on as a ghost if the kernel can replay. Without replay the shift is rejected.
    """
    hit, none = first.hit, dr.zeros(mi.Spectrum, dr.width(first.hit.t))
    lives = inside & hit.is_valid()
    ended = inside & ~hit.is_valid() & base.x.is_valid()
    # This is the weight of an offset path that has ended beside a living base path. The reverse shift, from the
    # neighbouring pixel, has the ended path as its base path, which walks on as a ghost while the living path is
    # replayed beside it. Both paths use the same random numbers, so r = 1 and w = 1/2. Without ghosts there is no
    # reverse shift, and w = 1 (survey, section 3.5).
    w2_ended = 1 if plan.replays else 2
    return Offset(
        ray=mi.Ray3f(first.ray),
        hit=hit,
        place=first.place,
        β=mi.Spectrum(importance * first.weight),
        r=mi.Float(1),
        apart=lives if plan.replays else lives & base.x.is_valid(),
        joined=mi.Bool(False),
        sky=Sky.from_camera(plan.hides),
        rough=mi.Bool(False),
        a=dr.select(ended, -base.β * w2_ended, 0),
        Δ=none,
        # From a pixel outside the film no path is sampled that could take the other part of the weight, so w = 1.
        w2=dr.select(ended, w2_ended, dr.select(inside, mi.Float(0), 2)),
        A=mi.Spectrum(none),
        failed=mi.Bool(False) if plan.replays else ended,
        aim=Aim.of_camera(base.x.p) if plan.space.holes else None,
    )


def next_steps(scene, plan: Plan, step: Step, offsets: list[Offset], first: bool = False) -> list[Offset]:
    """Takes all offset paths along a step. In the ``first`` step all of them are apart, and none is joined. In most
    later steps all of them are settled.

    Loops over the four paths keep the kernel small, and are recorded in a fraction of the time that unrolled code would
    need. The paths rotate in the state of a loop, so that the path whose turn it is stays in registers. Rare branches
    are real branches and not masks, which makes them 2.5 times cheaper.
    """
    if not offsets:
        return []
    count = len(offsets)
    joined, apart = (dr.any([getattr(y, where) for y in offsets]) for where in ("joined", "apart"))
    settle(step, offsets)

    def join(i, y, *others):
        return i + 1, *others, step_joined(step, y)

    def move(i, y, *others):
        y = dr.if_stmt((y,), y.apart, lambda y: step_apart(scene, plan, step, y), lambda y: y)
        return i + 1, *others, y

    if not first:
        # State that a step at a shared vertex does not use stays outside the loop, since moving it would cost time.
        some = (replace(y, hit=None, place=None, apart=None, sky=None, rough=None) for y in offsets)
        now = dr.while_loop((mi.UInt32(0), *some), lambda i, *_: joined & (i < count), join, label="joined paths")[1:]
        offsets = [
            replace(y, joined=z.joined, a=z.a, Δ=z.Δ, w2=z.w2, A=z.A, failed=z.failed, aim=z.aim)
            for y, z in zip(offsets, now, strict=True)
        ]
    if first or plan.replays:
        state = (mi.UInt32(0), *offsets)
        offsets = dr.while_loop(state, lambda i, *_: apart & (i < count), move, label="offset paths")[1:]
    return list(offsets)


def settle(step: Step, offsets: list[Offset]) -> None:
    """Adds the light that the base path finds in this step to Δ and A of settled paths."""
    # From here on the base path and a settled path are the same. Their difference up to here is in a = 2 w (β' - β). So
    # for emitter sampling and for BSDF sampling, the sample 2 w (C(y) |J| - C(x)) / p(x) is a times the light that the
    # base path finds (survey, eq. 4 and 16).
    C = step.L_light + step.f_p * step.L_bsdf
    for y in offsets:
        y.Δ = y.Δ + y.a * C
        y.A = y.A + y.w2 * step.β * C
        y.a = y.a * step.f_p
        if y.aim is not None:
            # Behind holes m may differ. Both paths have come straight on through holes from the same vertex. But the
            # offset path had arrived at this vertex from elsewhere, and so left it with another density.
            β1 = y.a + y.w2 * step.β1  # 2 w β'
            m = mis_weight(y.aim.p, step.p_light) - mis_weight(step.aim.p, step.p_light)
            y.Δ = y.Δ + dr.select(step.passed & (dr.max(dr.abs(β1)) > 0), β1 * step.Le * m, 0)
            y.aim = Aim(y.aim.o, dr.select(step.passed | y.apart | y.joined, y.aim.p, step.aim.p))


def step_apart(scene, plan: Plan, step: Step, path: Offset) -> Offset:
    # ----------------------- The vertex --------------------------
    # The state contains only the preliminary hit: whole interactions of four paths would make the state of every loop
    # much larger.
    y = media.vertex(path.ray, path.hit, path.place)
    bsdf, scatters = y.bsdf(), media.scatters(path.place)
    own = Own(y, path.place, bsdf, plan.materials.connectable(bsdf) | scatters)

    # ----------------- Emitter sampling: replay ------------------
    L_light, r_light = replayed_light(scene, plan, step, path, own)
    # Survey, eq. 16, with the weights of eq. 17. β' includes the |J| of all earlier steps.
    w2_light = gradient_weight(path.r * r_light, True)
    Δ = path.Δ + w2_light * (path.β * L_light - step.β * step.L_light)

    # ------------- BSDF sampling: reconnect, or part -------------
    joins = step.goes_on & shift.reconnects(step.kind, step.x_connectable, step.x1_connectable, own.connectable)
    # This includes paths beside a ghost: for a ghost, ``walks`` is true and ``goes_on`` is false.
    parts = step.walks & ~joins & ~step.ends_late
    move = dr.if_stmt((no_move(path),), joins, lambda move: reconnect(scene, plan, step, own, move), lambda move: move)
    if plan.replays:
        move = dr.if_stmt((move,), parts, lambda move: part(scene, plan, step, own, move), lambda move: move)

    # --------------------- Weight and gradient -------------------
    # r is a product of one ratio p' |J| / p for each step (survey, eq. 17), because products of densities would leave
    # the range of float32.
    β1, r1 = path.β * move.f_p, path.r * move.r
    good = move.good & dr.isfinite(r1) & dr.isfinite(dr.sum(β1))
    β1, r1 = dr.select(good, β1, 0), dr.select(good, r1, 0)
    apart, joined = good & parts & move.reaches, good & joins & move.reaches
    # This step has changed r, and with it the weight. Emission found at the end of the step has the new weight.
    w2 = gradient_weight(r1, good)
    return Offset(
        ray=move.ray,
        hit=move.hit,
        place=move.place,
        β=β1,
        r=r1,
        apart=apart,
        joined=joined,
        sky=move.sky,
        rough=move.rough,
        # An offset path that was rejected or has ended contributes 0 from now on. Only the base path's light remains in
        # Δ, with a minus sign.
        a=dr.select(apart | joined, 0, -w2 * step.β1),
        Δ=Δ + w2 * (β1 * move.L_bsdf - step.β1 * step.L_bsdf),
        w2=dr.select(apart | joined, 0, w2),
        A=path.A + w2_light * step.β * step.L_light + w2 * step.β1 * step.L_bsdf,
        failed=path.failed | (step.goes_on & ~step.ends_late & (r1 == 0)),
        aim=move.aim,
    )


def replayed_light(scene, plan: Plan, step: Step, path: Offset, own: Own) -> tuple[mi.Spectrum, mi.Float | int]:
    """Returns f m Le V / p of the emitter to which the base path's random numbers lead from y (V is its visibility),
    and a factor of r.

    From y the numbers lead to the same point of an emitter as from x, or to a point near it. The densities of the same
    random numbers cancel (survey, eq. 6 and 7), so the factor is 1. The shift is never rejected: an emitter that y does
    not see is a sample of value 0, also for the reverse shift. Where lamps are chosen by place, y takes the same lamp
    as x, but with another probability. The ratio of these probabilities does not cancel: it is the factor of r.
    """
    y, bsdf = own.y, own.bsdf
    lit = mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth) | media.scatters(own.place)
    lights, base, weight = plan.lights, step.light, step.light_weight
    if step.lamp is None:
        light, r = replay_light(scene, lights, base, weight, step.u_light, y, lit=lit), 1
    else:
        light, r = replay_lamp(lights, base, weight, step.lamp, step.x, y, lit=lit)
    f, p = media.evaluate_vertex(bsdf, y, own.place, y.to_local(light.d), lit)
    # A shadow ray is traced only where there is light to block.
    L_light = f * light.weight
    T, visible = plan.space.sees(y, own.place, light.target, step.drawn, dr.max(L_light) > 0, most=step.more)
    # Each path has its own m: from y, the emitter is found with other densities than from x.
    L_light = dr.select(visible, L_light, 0) * (T * light_mis(light.delta, light.p, p))
    if plan.caustic:
        L_light, _ = caustic.split(caustic.lit_late(path.rough, mi.Bool(False), own.connectable), L_light)
    return L_light, r


def no_move(path: Offset) -> Move:
    """Returns the move of a path that neither reconnects nor parts. The path is rejected, with β' = 0 and r = 0."""
    f_p, r, L_bsdf, none = mi.Spectrum(0), mi.Float(0), mi.Spectrum(0), mi.Bool(False)
    return Move(path.ray, path.hit, path.place, f_p, r, path.sky, path.rough, path.aim, L_bsdf, reaches=none, good=none)


def reconnect(scene, plan: Plan, step: Step, own: Own, move: Move) -> Move:
    """Connects straight to the base path's next vertex, or follows its direction if the base path escapes."""
    # ------------------------ The segment ------------------------
    # An escape is a vertex at infinity: the direction to it is the same from everywhere.
    x1, y = step.x1, own.y
    reaches = x1.is_valid()
    ray = dr.select(reaches, y.spawn_ray_to(x1.p), y.spawn_ray(step.x.to_world(step.wo)))
    direction = ray.d

    # ---------------------- Its throughput -----------------------
    # With densities per area J would be 1 (survey, section 3.3), but all densities here are per solid angle.
    in_medium = media.scatters(step.segment.place)
    # Rays begin a little above their surface. In a scene of millimetres, or far from the origin, this distance matters,
    # so J is computed from the points where the rays begin.
    origin = step.x.spawn_ray_to(x1.p).o
    J = dr.select(reaches, shift.reconnection_jacobian(origin, ray.o, x1.p, x1.n, in_medium), 1)
    f, p = media.evaluate_vertex(own.bsdf, y, own.place, y.to_local(direction))
    # If the segment is occluded, the shift is rejected: no path through an obstacle is ever sampled, so no such path
    # is shifted back. An occluded shadow ray, in contrast, is a sample of value 0. Moves with p = 0 have r = 0, as
    # rejected moves have, and are not tested.
    T, T_c, occluded = plan.space.reconnect(y, own.place, ray, x1, step.segment, step.drawn, active=p > 0)

    # ---------------------- Emission at x1 -----------------------
    # Le may depend on the direction of arrival, and p_light depends on the distance, so m differs from the base path's.
    y1 = seen_from(x1, direction)
    ratio = dr.squared_norm(x1.p - y.p) / dr.square(x1.t)
    Le, p_light = shared_emission(scene, plan.lights, x1, step.Le, step.p_light, x=step.x, y=y, y1=y1, J=ratio)
    return Move(
        ray=mi.Ray3f(y.p, direction, y.time, y.wavelengths),
        hit=move.hit,
        place=own.place,
        # f |J| over the density of the *base* path (survey, eq. 4): p' enters only through the weight.
        f_p=dr.select(p > 0, f * (J / step.p * step.survival), 0) * T,
        r=J * p / step.p * T_c,
        sky=Sky(mi.Bool(True)),
        rough=mi.Bool(plan.caustic),
        aim=move.aim and Aim(mi.Point3f(y.p), p),
        L_bsdf=Le * mis_weight(p, p_light),
        reaches=reaches,
        good=~occluded,
    )


def part(scene, plan: Plan, step: Step, own: Own, move: Move) -> Move:
    """Moves the offset path in a direction of its own. The direction has the base path's half-vector, or comes from the
    base path's random numbers.
    """
    # -------------------- Random sequence replay -----------------
    # |J| = p / p' (survey, eq. 6), hence f |J| / p = f / p', which is what sampling returns (eq. 7), and r = 1.
    y = own.y
    sample, f_p = media.sample_vertex(own.bsdf, y, own.place, step.u_lobe, step.u_direction)
    kind = dr.select(sample.pdf > 0, event_kind(sample.sampled_type), DELTA)
    leaves = Departure(sample.pdf > 0, sample.wo, sample.pdf, kind, f_p, mi.Float(1))
    if plan.half_vectors:
        leaves = copy_where_smooth(step, y, own.bsdf, leaves)
    found, kind, allowed = leaves.found, leaves.kind, leaves.allowed

    # --------------- Next vertex, and Le there -------------------
    sky = move.sky.behind(kind) if plan.hides else move.sky
    # The distance comes from the base path's random number, so the densities of both distances cancel, even if the
    # paths are in different media.
    segment = plan.space.fly(y, own.place, y.spawn_ray(y.to_world(leaves.wo)), step.drawn, found)
    y1 = plan.space.end(y, segment)
    reaches = found & y1.is_valid()
    seen, sampled = reaches | (found & sky.seen), found & (kind == SMOOTH)
    aim, seen_by, p_y1 = None, y, leaves.p
    if move.aim is not None:
        aim = move.aim.behind(plan.space.holes.passed(own.bsdf, kind), y, kind, leaves.p)
        seen_by, sampled, p_y1 = aim.seen_by(y), found & dr.isfinite(aim.p), aim.p
    Le, p_light = emission(scene, y1, seen_by, seen, sampled, plan.lights)

    # ----------------- Would it be shifted back? -----------------
    # If not, the move is rejected. Without this, the weights of the pair would not sum to 1 (survey, section 3.5).
    y1_connectable = ~reaches | plan.materials.connectable(y1.bsdf()) | media.scatters(segment.place)
    inverts = shift.replay_inverts(kind, own.connectable, y1_connectable, step.x_connectable)
    # Light of the layer ``caustic`` has no differences. So the shift is rejected if the offset path is late, or will be
    # late behind its next vertex. The reverse shift rejects late paths in the same way. If the base path is late, or
    # will be, this code is not reached.
    rough = move.rough
    if plan.caustic:
        rough, late = caustic.classes(rough, mi.Bool(False), found, kind, own.connectable)
        sharp = plan.materials.sharp(y1, scene) & ~media.scatters(segment.place)
        allowed &= ~(late | caustic.ends_late(kind == SMOOTH, own.connectable, sharp))
    return Move(
        ray=segment.ray,
        hit=segment.hit,
        place=segment.place,
        f_p=dr.select(found, leaves.f_p * segment.weight * step.survival, 0),
        r=leaves.r,
        sky=sky,
        rough=rough,
        aim=aim,
        L_bsdf=Le * mis_weight(p_y1, p_light),
        reaches=reaches,
        good=allowed & inverts,
    )


def step_joined(step: Step, path: Offset) -> Offset:
    """Takes a step with a joined offset path, which has come to the shared vertex x from elsewhere. After this step the
    path is settled.
    """
    y = seen_from(step.x, path.ray.d)
    bsdf = y.bsdf()

    # --------------- Emitter sampling: the same sample -----------
    # Vertex, emitter and shadow ray are shared. Only f and m depend on where the path has come from.
    f, p = media.evaluate_vertex(bsdf, y, step.place, y.to_local(step.light.d), step.lit)
    L_light = dr.select(step.lit, f * step.light_weight * light_mis(step.light.delta, step.light.pdf, p), 0)
    L_light *= step.T_light
    w2_light = gradient_weight(path.r, True)
    Δ = path.Δ + w2_light * (path.β * L_light - step.β * step.L_light)

    # -------------- BSDF sampling: the same direction ------------
    # J = 1, since both paths leave the same vertex in the same direction. But p' differs from p, since the offset path
    # has arrived from elsewhere. p' / p is the last factor of r that is not 1.
    f, p = media.evaluate_vertex(bsdf, y, step.place, step.wo, step.goes_on)
    β1 = path.β * dr.select(p > 0, f * (step.survival / step.p), 0) * step.segment.weight
    r1 = path.r * p / step.p
    # Where the base path has ended, r1 is not finite. There both paths find no more light, so w does not matter.
    good = shift.keeps_joined(step.kind) & dr.isfinite(r1) & dr.isfinite(dr.sum(β1))
    β1 = dr.select(good, β1, 0)
    L_bsdf = step.Le * mis_weight(p, step.p_light)
    w2 = gradient_weight(r1, good)
    # All later factors of both paths are the same. So r and w do not change any more, and only a depends on y.
    a, Δ = w2 * (β1 - step.β1), Δ + w2 * (β1 * L_bsdf - step.β1 * step.L_bsdf)
    A = path.A + w2_light * step.β * step.L_light + w2 * step.β1 * step.L_bsdf
    return replace(
        path,
        joined=mi.Bool(False),
        a=dr.select(path.joined, a, path.a),
        Δ=dr.select(path.joined, Δ, path.Δ),
        w2=dr.select(path.joined, w2, path.w2),
        A=dr.select(path.joined, A, path.A),
        failed=path.failed | (path.joined & step.goes_on & ~(good & (r1 > 0))),
        aim=path.aim and Aim(path.aim.o, dr.select(path.joined, p, path.aim.p)),
    )
