r"""The gradient-domain path tracer: one base path and four offset paths that join it as early as they can.

Each base path is Mitsuba's ``path``: emitter sampling and BSDF sampling combined by the power heuristic, Russian
roulette by throughput. Its four offset paths go through the neighbours of its pixel with the same sub-pixel, lens, time
and wavelength samples. An offset path goes straight to the base path's next vertex where materials allow it, and
replays the base path's random numbers where not (mirrors, glass). Past the vertex they share, both are one path, so
four offsets cost about as much as the base path and not four times that.

    x, y              base path, offset path y = T(x); x1 is the base path's next vertex
    L, Le             radiance of the base path without, and of only, the emission that the camera sees directly
    β, β'             throughput f |J| / p of either path, both divided by the density of the *base* path
    J                 |dT/dx|, the Jacobian of the shift
    p, p'             densities of BSDF sampling, in solid angle
    r                 p(y) |J| / p(x), the product of the ratios of each step (survey, eq. 17); 1 while replaying
    w                 1 / (1 + r), or 1 where the shift is rejected: see data_gen.shift.gradient_weight()
    m                 MIS weight of emitter against BSDF sampling, each path's own
    Δ                 gradient sample 2 w (C(y) |J| - C(x)) / p(x), the sum over all lengths of paths and over the two
                      techniques, which are shifted separately: C is the contribution f m of one
    a                 once a path is settled, all that follows in Δ is a times the radiance that reaches the base path

An offset path is *apart* from its base path, then *joined* to it for one step (it shares the vertex, but arrives there
from elsewhere), then *settled*: joined for longer, ended, or rejected. A base path that ends while offset paths are
apart walks on as a ghost. Its offset paths replay numbers that it has no use for, so that what their pixels see serves
this pixel too, with w = 1/2, as it does in random sequence replay; to reject them would double their variance.

Russian roulette looks at all five paths, so that none is starved. It leaves r as it is: the weights of the two
directions of a difference sum to one whatever paths survive.

[Kettunen et al. 2015, "Gradient-Domain Path Tracing"; Hua et al. 2019, "A Survey on Gradient-Domain Rendering",
sections 3 and 4.1]
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from data_gen.camera import CameraSamples, render_passes
from data_gen.features import features
from data_gen.film import SHIFTS, GradientFilm
from data_gen.integrators.common import GradientIntegrator
from data_gen.shift import gradient_weight, mis_weight, reconnection_jacobian, reconnects, replay_inverts
from data_gen.spectrum import to_rgb
from data_gen.vertex import DELTA, NULL, SMOOTH, Materials, evaluate, event_kind, seen_from
from ngpt.errors import NgptError

# α of Beckmann and GGX above which a material is connectable.
ROUGHNESS_THRESHOLD = 0.05


@dataclass
class Offset:
    """The state of one offset path at the current vertex of its base path."""

    ray: mi.Ray3f  # apart: led to the offset path's own vertex; joined: to the shared one
    hit: mi.PreliminaryIntersection3f  # apart: that vertex
    β: mi.Spectrum
    r: mi.Float
    apart: mi.Bool
    joined: mi.Bool
    seen: mi.Bool  # an escape sees the environment
    a: mi.Spectrum
    Δ: mi.Spectrum


@dataclass
class Step:
    """What the base path does at its current vertex x: all that offset paths need to know of it."""

    x: mi.SurfaceInteraction3f
    x_connectable: mi.Bool
    β: mi.Spectrum
    # Emitter sampling
    u_light: mi.Point2f
    light: mi.DirectionSample3f
    light_weight: mi.Spectrum  # Le V / p
    lit: mi.Bool  # whether there is a sample
    L_light: mi.Spectrum  # f m Le V / p
    # BSDF sampling
    u_lobe: mi.Float
    u_direction: mi.Point2f
    wo: mi.Vector3f
    kind: mi.UInt32
    p: mi.Float
    f_p: mi.Spectrum  # f / p, survival included
    survival: mi.Float  # 1 / probability to survive Russian roulette
    goes_on: mi.Bool  # there is a next vertex, or an escape
    walks: mi.Bool  # some path of the five may go on
    seen: mi.Bool  # an escape sees the environment
    β1: mi.Spectrum
    x1: mi.SurfaceInteraction3f
    x1_connectable: mi.Bool
    Le: mi.Spectrum  # emitted at x1 toward x
    p_light: mi.Float  # density with which emitter sampling would have found x1
    L_bsdf: mi.Spectrum  # m Le


@dataclass
class Move:
    """One step of an offset path apart from its base path; ``good`` is False where the shift is rejected."""

    ray: mi.Ray3f
    hit: mi.PreliminaryIntersection3f
    f_p: mi.Spectrum  # f |J| / p, with the p of the base path
    r: mi.Float  # p' |J| / p
    seen: mi.Bool
    L_bsdf: mi.Spectrum
    reaches: mi.Bool  # there is a next vertex
    good: mi.Bool


class GPT(GradientIntegrator):
    """Gradient-domain path tracing with reconnection and random sequence replay, for surfaces.

    Plugin ``gpt``. Parameters, the first three as for Mitsuba's ``path``: ``max_depth`` (default: -1, no limit),
    ``rr_depth`` (5), ``hide_emitters`` (false), and ``roughness_threshold``, the microfacet roughness above which
    materials are connectable.

    Not handled: media (they are not seen), and polarised variants, for which rendering raises NgptError.
    """

    def __init__(self, props: mi.Properties):
        super().__init__(props)
        max_depth = props.get("max_depth", -1)
        self.max_depth = max_depth if 0 <= max_depth < 0xFFFFFFFF else 0xFFFFFFFF
        self.rr_depth = props.get("rr_depth", 5)
        self.roughness_threshold = props.get("roughness_threshold", ROUGHNESS_THRESHOLD)

    def sample(self, scene, sampler, ray, medium=None, active=True):
        """The primal estimate alone, by Mitsuba's ``path``."""
        depths = {"max_depth": self.max_depth if self.max_depth < 0xFFFFFFFF else -1, "rr_depth": self.rr_depth}
        path = mi.load_dict({"type": "path", "hide_emitters": self.hide_emitters, **depths})
        return path.sample(scene, sampler, ray, medium, active)

    def render_film(self, scene, sensor, seed: int, spp: int, **progress) -> GradientFilm:
        """Renders pass by pass: see ``data_gen.camera.render_passes()``."""
        if mi.is_polarized:
            raise NgptError(
                f"sampler 'gpt' does not follow polarised light (variant '{mi.variant()}'); "
                f"use variant '{mi.variant().removesuffix('_polarized')}', or sampler 'gpt-basic'"
            )
        materials = Materials(scene, self.roughness_threshold)
        return render_passes(
            lambda camera, film: self.sample_pass(scene, materials, camera, film), sensor, seed, spp, **progress
        )

    def sample_pass(self, scene, materials: Materials, camera: CameraSamples, film: GradientFilm) -> None:
        """Takes one base path and its four offset paths for each camera sample."""
        ray, importance, _ = camera.rays()
        shifted = [camera.rays(shift) for shift in SHIFTS.values()]
        L, Le, Δ = self.trace(scene, materials, camera.random.clone(), ray, importance, shifted)
        L, Le, *Δ = (to_rgb(value, ray.wavelengths) for value in (L, Le, *Δ))
        values = {"primal": L + Le, "direct": Le}
        values |= features(scene, camera.sensor, camera.random.clone(), ray)
        inside = [inside for _, _, inside in shifted]
        dr.eval(values, Δ, inside)
        for name, value in values.items():
            film.put(name, value)
        for name, value, active in zip(SHIFTS, Δ, inside, strict=True):
            film.put(name, value, active)

    @dr.syntax
    def trace(self, scene, materials, random, ray, importance, shifted):
        """L, Le and the four Δ, in the order of SHIFTS, of base paths that begin with ``ray``."""
        x = self.first_hit(scene, ray).compute_surface_interaction(mi.Ray3f(ray))
        seen = mi.Bool(not self.hide_emitters)
        Le = importance * x.emitter(scene).eval(x, (x.is_valid() | seen) & (self.max_depth > 0))
        L = mi.Spectrum(0)
        β = dr.select(x.is_valid(), importance, 0)
        η = mi.Float(1)
        depth = mi.UInt32(1)
        offsets = [self.offset_path(scene, x, importance, *shift) for shift in shifted]
        active = (x.is_valid() | dr.any([y.apart for y in offsets])) & (depth < self.max_depth)
        while dr.hint(active, label="gpt"):
            step, η = self.base_step(scene, materials, random, x, β, η, depth, seen, offsets)
            L += β * step.L_light + step.β1 * step.L_bsdf
            offsets = self.offset_steps(scene, materials, step, offsets)
            x = step.x1
            β = dr.select(x.is_valid(), step.β1, 0)
            seen = step.seen
            depth += 1
            active = step.walks & (x.is_valid() | dr.any([y.apart for y in offsets])) & (depth < self.max_depth)
        return L, Le, [offset.Δ for offset in offsets]

    def first_hit(self, scene, ray) -> mi.PreliminaryIntersection3f:
        """Where a camera ray leads, through lamps that hide from the camera."""
        ray = mi.Ray3f(ray)
        hit = scene.ray_intersect_preliminary(ray, coherent=True)
        if self.hide_emitters:
            lamp = hit.is_valid() & (hit.shape.emitter() != None)  # noqa: E711 - a comparison of arrays of pointers
            si = hit.compute_surface_interaction(ray, mi.RayFlags.Minimal, lamp)
            hit = dr.select(lamp, self.skip_area_emitters(scene, si.spawn_ray(ray.d), True, lamp), hit)
        return hit

    def offset_path(self, scene, x, importance, ray, offset_importance, inside) -> Offset:
        """An offset path up to its first vertex; it has ended where it finds none."""
        hit = self.first_hit(scene, ray)
        ended = inside & ~hit.is_valid()
        return Offset(
            ray=mi.Ray3f(ray),
            hit=hit,
            β=mi.Spectrum(offset_importance),
            r=mi.Float(1),
            apart=inside & hit.is_valid(),
            joined=mi.Bool(False),
            seen=mi.Bool(not self.hide_emitters),
            a=dr.select(ended & x.is_valid(), -importance, 0),
            Δ=mi.Spectrum(0),
        )

    def base_step(self, scene, materials, random, x, β, η, depth, seen, offsets) -> tuple[Step, mi.Float]:
        """Samples an emitter and the next vertex from vertex x, the ``depth``-th, as Mitsuba's ``path`` does."""
        # Drawn whether used or not: a replay needs the same numbers, whatever its path meets.
        u_light, u_lobe, u_direction = random.next_2d(), random.next_1d(), random.next_2d()
        u_survival = random.next_1d()
        bsdf = x.bsdf()
        lit = mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        light, light_weight = scene.sample_emitter_direction(x, u_light, True, lit)
        lit &= light.pdf != 0
        f, p, sample, f_p = bsdf.eval_pdf_sample(mi.BSDFContext(), x, x.to_local(light.d), u_lobe, u_direction)
        L_light = dr.select(lit, f * light_weight * light_mis(light, p), 0)

        found = sample.pdf > 0
        kind = dr.select(found, event_kind(sample.sampled_type), DELTA)
        seen = seen | (kind != NULL)
        η = dr.select(found, η * sample.eta, η)
        largest = dr.max(β * f_p)
        for y in offsets:
            ahead = dr.select(y.apart | y.joined, dr.max(y.β) / (1 + y.r), 0)
            largest = dr.fmax(largest, dr.fmax(ahead, dr.max(dr.abs(y.a * f_p)) / 2))
        q = dr.fmin(largest * dr.square(η), 0.95)
        roulette = depth >= self.rr_depth
        survival = dr.select(roulette, dr.rcp(q), 1)
        walks = (largest > 0) & (~roulette | (u_survival < q))
        goes_on = walks & found
        f_p = dr.select(goes_on, f_p * survival, 0)

        x1 = scene.ray_intersect(x.spawn_ray(x.to_world(sample.wo)), goes_on)
        light1 = mi.DirectionSample3f(scene, x1, x)
        p_light = scene.pdf_emitter_direction(x, light1, goes_on & (kind == SMOOTH))
        Le = light1.emitter.eval(x1, goes_on & (x1.is_valid() | seen))
        step = Step(
            x=x,
            x_connectable=materials.connectable(bsdf),
            β=β,
            u_light=u_light,
            light=light,
            light_weight=light_weight,
            lit=lit,
            L_light=L_light,
            u_lobe=u_lobe,
            u_direction=u_direction,
            wo=sample.wo,
            kind=kind,
            p=sample.pdf,
            f_p=f_p,
            survival=survival,
            goes_on=goes_on,
            walks=walks,
            seen=seen,
            β1=β * f_p,
            x1=x1,
            x1_connectable=~x1.is_valid() | materials.connectable(x1.bsdf()),
            Le=Le,
            p_light=p_light,
            L_bsdf=Le * mis_weight(sample.pdf, p_light),
        )
        return step, η

    def offset_steps(self, scene, materials, step: Step, offsets: list[Offset]) -> list[Offset]:
        """Takes all offset paths along one step of their base path."""
        busy = mi.Bool(False)
        for y in offsets:
            y.Δ = y.Δ + y.a * (step.L_light + step.f_p * step.L_bsdf)
            y.a = y.a * step.f_p
            busy |= y.apart | y.joined

        # A loop keeps the kernel small; its state rotates, so that each path stays in registers when its turn comes.
        # Most of the steps of a base path find all offset paths settled.
        def rotate(i, y, *others):
            y = dr.if_stmt((y,), y.apart | y.joined, lambda y: self.offset_step(scene, materials, step, y), lambda y: y)
            return i + 1, *others, y

        state = (mi.UInt32(0), *offsets)
        return list(dr.while_loop(state, lambda i, *_: busy & (i < len(offsets)), rotate, label="offset paths")[1:])

    def offset_step(self, scene, materials, step: Step, y: Offset) -> Offset:
        """Takes one offset path along one step; rare branches are real ones, not masks: they cost 2.5 times less."""
        joined = y.joined
        y = dr.if_stmt((y,), y.apart, lambda y: self.step_apart(scene, materials, step, y), lambda y: y)
        return dr.if_stmt((y,), joined, lambda y: self.step_joined(step, y), lambda y: y)

    def step_apart(self, scene, materials, step: Step, path: Offset) -> Offset:
        """A step from the offset path's own vertex y."""
        y = path.hit.compute_surface_interaction(path.ray)
        bsdf = y.bsdf()
        connectable = materials.connectable(bsdf)
        # Emitter sampling is replayed: densities cancel in r, and the same numbers lead to, or near, the same point.
        lit = mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        light, light_weight = scene.sample_emitter_direction(y, step.u_light, True, lit)
        lit &= light.pdf != 0
        f, p = evaluate(bsdf, y, y.to_local(light.d), lit)
        L_light = dr.select(lit, f * light_weight * light_mis(light, p), 0)
        Δ = path.Δ + gradient_weight(path.r, True) * (path.β * L_light - step.β * step.L_light)

        joins = step.goes_on & reconnects(step.kind, step.x_connectable, step.x1_connectable, connectable)
        replays = step.walks & ~joins
        none = mi.Bool(False)
        move = Move(path.ray, path.hit, mi.Spectrum(0), mi.Float(0), path.seen, mi.Spectrum(0), none, none)
        move = dr.if_stmt((move,), joins, lambda move: self.reconnect(scene, step, y, bsdf, move), lambda move: move)
        move = dr.if_stmt(
            (move,),
            replays,
            lambda move: self.replay(scene, materials, step, y, bsdf, connectable, move),
            lambda move: move,
        )
        β1, r1 = path.β * move.f_p, path.r * move.r
        good = move.good & dr.isfinite(r1) & dr.isfinite(dr.sum(β1))
        β1, r1 = dr.select(good, β1, 0), dr.select(good, r1, 0)
        apart, joined = good & replays & move.reaches, good & joins & move.reaches
        w2 = gradient_weight(r1, good)
        return Offset(
            ray=move.ray,
            hit=move.hit,
            β=β1,
            r=r1,
            apart=apart,
            joined=joined,
            seen=move.seen,
            # Rejected or at its end, it has nothing to set against the rest of the base path.
            a=dr.select(apart | joined, 0, -w2 * step.β1),
            Δ=Δ + w2 * (β1 * move.L_bsdf - step.β1 * step.L_bsdf),
        )

    def reconnect(self, scene, step: Step, y, bsdf, move: Move) -> Move:
        """Straight to the base path's next vertex, or, where it escapes, along with it."""
        x1 = step.x1
        reaches = x1.is_valid()
        direction = dr.select(reaches, dr.normalize(x1.p - y.p), step.x.to_world(step.wo))
        occluded = scene.ray_test(dr.select(reaches, y.spawn_ray_to(x1.p), y.spawn_ray(direction)))
        J = dr.select(reaches, reconnection_jacobian(step.x.p, y.p, x1.p, x1.n), 1)
        f, p = evaluate(bsdf, y, y.to_local(direction))
        y1 = seen_from(x1, direction)
        light = mi.DirectionSample3f(scene, y1, y)
        Le = light.emitter.eval(y1)
        return Move(
            ray=mi.Ray3f(y.p, direction, y.time, y.wavelengths),
            hit=move.hit,
            f_p=dr.select(p > 0, f * (J / step.p * step.survival), 0),
            r=J * p / step.p,
            seen=mi.Bool(True),
            L_bsdf=Le * mis_weight(p, scene.pdf_emitter_direction(y, light)),
            reaches=reaches,
            good=~occluded,
        )

    def replay(self, scene, materials, step: Step, y, bsdf, connectable, move: Move) -> Move:
        """Along the direction that the base path's random numbers give here, if any."""
        sample, f_p = bsdf.sample(mi.BSDFContext(), y, step.u_lobe, step.u_direction)
        found = sample.pdf > 0
        kind = dr.select(found, event_kind(sample.sampled_type), DELTA)
        seen = move.seen | (kind != NULL)
        ray = y.spawn_ray(y.to_world(sample.wo))
        hit = scene.ray_intersect_preliminary(ray, active=found)
        y1 = hit.compute_surface_interaction(ray)
        reaches = found & y1.is_valid()
        light = mi.DirectionSample3f(scene, y1, y)
        p_light = scene.pdf_emitter_direction(y, light, kind == SMOOTH)
        Le = light.emitter.eval(y1, reaches | (found & seen))
        return Move(
            ray=ray,
            hit=hit,
            f_p=dr.select(found, f_p * step.survival, 0),
            r=mi.Float(1),
            seen=seen,
            L_bsdf=Le * mis_weight(sample.pdf, p_light),
            reaches=reaches,
            good=replay_inverts(kind, connectable, ~reaches | materials.connectable(y1.bsdf()), step.x_connectable),
        )

    def step_joined(self, step: Step, path: Offset) -> Offset:
        """A step from the shared vertex x, to which the offset path has come from elsewhere; settles it."""
        y = seen_from(step.x, path.ray.d)
        bsdf = y.bsdf()
        f, p = evaluate(bsdf, y, y.to_local(step.light.d), step.lit)
        L_light = dr.select(step.lit, f * step.light_weight * light_mis(step.light, p), 0)
        Δ = path.Δ + gradient_weight(path.r, True) * (path.β * L_light - step.β * step.L_light)

        f, p = evaluate(bsdf, y, step.wo, step.goes_on)
        β1 = path.β * dr.select(p > 0, f * (step.survival / step.p), 0)
        r1 = path.r * p / step.p
        # A mirror or a hole sends light from elsewhere elsewhere.
        good = (step.kind == SMOOTH) & dr.isfinite(r1) & dr.isfinite(dr.sum(β1))
        β1 = dr.select(good, β1, 0)
        L_bsdf = step.Le * mis_weight(p, step.p_light)
        w2 = gradient_weight(r1, good)
        return Offset(
            ray=path.ray,
            hit=path.hit,
            β=β1,
            r=r1,
            apart=mi.Bool(False),
            joined=mi.Bool(False),
            seen=path.seen,
            a=w2 * (β1 - step.β1),
            Δ=Δ + w2 * (β1 * L_bsdf - step.β1 * step.L_bsdf),
        )


def light_mis(light: mi.DirectionSample3f, p: mi.Float) -> mi.Float:
    """MIS weight of a sampled emitter whose direction BSDF sampling finds with density ``p``."""
    return dr.select(light.delta, 1, mis_weight(light.pdf, p))


mi.register_integrator("gpt", lambda props: GPT(props))
