"""Shifts light paths that end at the camera: the last vertex moves to the point that a neighbouring pixel sees.

The vertex before it stays. This is the shift of camera paths, seen from the other end. If mirrors or glass lie between
the two, the vertex before them stays, and the copy goes through the same mirrors and glass: see ``through_glass``.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from data_gen.film import SHIFTS
from data_gen.film.splats import Splats
from data_gen.paths.eye import Eye, Sight
from data_gen.paths.light_ends import LightRay
from data_gen.paths.spectrum import to_rgb
from data_gen.samplers.bdpt import mis
from data_gen.samplers.bdpt.mis import Partial
from data_gen.samplers.bdpt.strategies import to_camera
from data_gen.samplers.bdpt.vertex import IMPORTANCE, Vertex, cosine, evaluate, recall, scatters_smoothly
from ngpt_studies.gbdpt.base_path import Plan
from ngpt_studies.gbdpt.light_again import light_again
from ngpt_studies.gbdpt.manifold import Target, follow, walk
from ngpt_studies.gbdpt.pairs import difference, difference_of_one


@dataclass
class Splatted:
    """A light path that ends at the camera, with the data that a shift needs."""

    y: Vertex  # the last vertex
    d: mi.Vector3f  # the direction in which the path arrived there
    uv: mi.Point2f  # the place of ``y`` on the film, in pixels
    lens: mi.Point2f
    C: mi.Spectrum
    others: mi.Float
    first: mi.Bool  # whether the vertex before the last is the light's end, ``start``; else it is ``before``
    start: LightRay
    before: Vertex
    p: mi.Float  # density with which ``before`` was left
    survival: mi.Float  # 1 / probability to survive Russian roulette after ``before``
    events: mi.UInt32  # mirrors and glass between the two, of ``manifold``, the last one first
    allowed: mi.Bool  # whether both vertices are connectable and ``events`` holds all events
    # The number of holes between the two, and between the last vertex and the camera
    holes: mi.UInt32 | int = 0
    holes_seen: mi.UInt32 | int = 0


def splat_differences(
    plan: Plan,
    sight: Sight,
    depth: mi.UInt32,
    splats: dict[str, Splats],
    bent: bool = False,
    times: mi.Float | float = 1.0,
) -> mi.Bool:
    """Splats the differences of light paths that end at a vertex that the camera sees, one for each lane.

    This vertex is ``depth`` edges from the light, and the path counts ``times`` times. A path is bent if mirrors or
    glass lie before its last vertex. With ``bent`` only the differences of bent paths are splatted, otherwise only all
    others. Returns which paths are bent.
    """
    eye, ray, connectable = sight.eye, sight.ray, plan.materials.connectable
    again = light_again(plan, sight, depth)
    y, link = again.end.y, again.link
    bsdf = y.si.bsdf()
    joined = again.there & scatters_smoothly(bsdf)
    # The first kernel found the vertex visible, so only holes can be in between.
    T, holes_seen = 1, 0
    if plan.holes:
        T, holes_seen = plan.through_holes_to_camera(y, eye.toward(y.si, again.lens, joined)[0], joined)
    C, others, uv = to_camera(eye, again.lens, y, bsdf, joined, lambda *_: T)
    lit = dr.max(C) > 0

    # --------------------- Its four shifts -----------------------
    first, before = link.depth == 0, recall(again.left, ray.time, ray.wavelengths)
    path = Splatted(
        y=y,
        d=again.end.ray.d,
        uv=uv,
        lens=again.lens,
        C=C,
        others=others,
        first=first,
        start=again.start,
        before=before,
        p=link.p,
        survival=link.survival,
        events=link.events,
        allowed=link.whole & connectable(bsdf) & (first | connectable(before.si.bsdf())),
        holes=link.holes,
        holes_seen=holes_seen,
    )
    is_bent = lit & path.allowed & (link.events != 0)
    Δ = differences(plan, eye, path, is_bent if bent else lit & ~is_bent, bent)
    pixel = eye.pixel_at(uv)
    for name, (one, on_film) in Δ.items():
        splats[name].add(pixel, list(to_rgb(one * sight.importance * times, ray.wavelengths)), on_film)
    return is_bent


def differences(
    plan: Plan, eye: Eye, path: Splatted, lit: mi.Bool, bent: bool = False
) -> dict[str, tuple[mi.Spectrum, mi.Bool]]:
    """For each of SHIFTS: Δ of the path, and whether Δ exists, that is, light arrives and the pixel is on the film.

    Only paths that are ``lit`` count. With ``bent`` these are bent paths, otherwise all others.
    """
    shifts = list(SHIFTS.values())
    state = (mi.UInt32(0), *(mi.Spectrum(0) for _ in shifts))

    def one(i, *Δ):
        shift = mi.Vector2f(choose(i, [x for x, _ in shifts]), choose(i, [y for _, y in shifts]))
        uv = path.uv + shift
        active = lit & eye.shows(uv)

        def pair(_):
            C, r, others = shifted(plan, eye, path, uv, active & path.allowed, bent)
            weights = difference_of_one if bent else difference
            return weights(path.C, path.others, C, r, others)

        Δ1 = dr.if_stmt((mi.Spectrum(0),), active, pair, lambda none: none)
        return i + 1, *(dr.select(i == k, Δ1, old) for k, old in enumerate(Δ))

    Δ = dr.while_loop(state, lambda i, *_: lit & (i < len(shifts)), one, label="shifts to the camera")[1:]
    on_film = [lit & eye.shows(path.uv + mi.Vector2f(*shift)) for shift in shifts]
    return dict(zip(SHIFTS, zip(Δ, on_film, strict=True), strict=True))


def shifted(plan: Plan, eye: Eye, path: Splatted, uv: mi.Point2f, active, bent: bool = False) -> tuple:
    """f J / p, r and ``others`` of the copy that the camera sees at ``uv`` on the film; f is 0 if there is none."""
    # --------------------- The last vertex -----------------------
    scene, y = plan.scene, path.y
    ray = eye.ray(uv, path.lens)
    x = plan.first_hit(scene, ray, active).compute_surface_interaction(ray, active=active)
    T = mi.Spectrum(1)
    if plan.holes:
        x, T = plan.holes.through(scene, x, ray.d, path.holes_seen, active & x.is_valid())
    bsdf = x.bsdf()
    active = active & x.is_valid() & plan.materials.connectable(bsdf)
    toward, importance = eye.toward(x, path.lens, active)
    toward0, importance0 = eye.toward(y.si, path.lens, active)
    # Per area, the film's density at either vertex is importance times cosine: J is their ratio.
    J = importance0 * cosine(y.si, toward0.d) / (importance * cosine(x, toward.d))

    # ---------------- The edge to the one before -----------------
    edge = (mi.Vector3f(0), mi.Spectrum(0), mi.Float(0), mi.Float(0), mi.Float(0), mi.Ray3f(ray), mi.Point3f(0))

    def from_start(*_):
        moved, ratio, per_distance2 = plan.lights.redirected(scene, path.start, x)
        _, _, per_distance2_0 = plan.lights.redirected(scene, path.start, y.si)
        d = moved.ray.d
        e, p = plan.lights.densities(scene, moved, x)
        end = mis.begin_light(e, p, moved.delta, cosine(x, d))
        G = cosine(x, d) / cosine(y.si, path.d) * (per_distance2 / per_distance2_0)
        far = plan.lights.far(path.start.index)
        shadow = dr.select(far, x.spawn_ray(-d), x.spawn_ray_to(moved.end.p))
        target = dr.select(far, plan.outside(x.p, -d), moved.end.p)
        return d, moved.β * (G * path.survival), ratio * G, end.vcm, end.vc, shadow, target

    def from_before(*_):
        before = path.before
        to = mi.Vector3f(x.p - before.si.p)
        distance2 = dr.squared_norm(to)
        d = to * dr.rsqrt(distance2)
        f, p, q = evaluate(IMPORTANCE, before.si, before.si.bsdf(), before.si.to_local(d), active)
        end = mis.leave(before.end, cosine(before.si, d), p, q, mi.Bool(False))
        end = mis.arrive(end, cosine(x, d), distance2)
        G = cosine(x, d) / cosine(y.si, path.d) * (dr.squared_norm(y.si.p - before.si.p) / distance2)
        β = before.β * f * (G * path.survival / path.p)
        return d, β, p / path.p * G, end.vcm, end.vc, x.spawn_ray_to(before.si.p), mi.Point3f(before.si.p)

    if bent:
        d, β, r, vc = through_glass(plan, path, x, active)
        vcm = mi.Float(0)
    else:
        d, β, r, vcm, vc, shadow, target = dr.if_stmt(edge, path.first, from_start, from_before)

    # ----------------------- To the camera -----------------------
    x.wi = x.to_local(-d)
    f, _, q = evaluate(IMPORTANCE, x, bsdf, x.to_local(toward.d), active)
    C = β * f * importance * J
    if plan.holes:
        C *= T
    seen = active & (dr.max(C) > 0) & dr.isfinite(dr.sum(C))
    # A bent copy was traced through the mirrors and glass, so it needs no shadow ray.
    if not bent and plan.holes:
        T, holes = plan.holes.transmittance(scene, shadow, target, path.holes, seen)
        C *= dr.select(holes == path.holes, T, 0)
    elif not bent:
        seen &= ~scene.ray_test(shadow, seen)
    C = dr.select(seen, C, 0)
    end = plan.known(Partial(vcm, vc), bsdf)
    return C, r * J, mis.others_to_camera(end, importance, cosine(x, toward.d), q)


def through_glass(plan: Plan, path: Splatted, x, active) -> tuple:
    """The edge of the copy from ``x`` to the vertex before, through the same ``events`` as the path.

    Returns the direction in which light arrives at ``x``, its β there (0 if none arrives), r, and ``vc`` of ``mis``. ω
    is the direction at the last vertex, and c is the vertex before [Hua et al. 2019, section 3.4]:

        b' / b    f'_c F' / (f_c F) G              F of radiance that goes the other way
        r         p'_c P' / (p_c P) G η² / η'²     P of the events
        G         cos' cos_c / (cos cos'_c) dω' / dω: of the light's flux, from solid angles at c to areas at x

    Other strategies do not follow such paths in this way, so this one has separate weights (``pairs``).
    """
    scene, lights, y, before = plan.scene, plan.lights, path.y, path.before
    far = path.first & lights.far(path.start.index)
    # ------------------------- The chain -------------------------
    ω = -path.d
    beside = mi.Vector3f(dr.select(path.first, path.start.end.n, mi.Vector3f(before.si.n)))
    # Points have no normal: any plane that the light crosses will do.
    target = Target(dr.select(path.first, path.start.end.p, before.si.p), beside, far)
    point = path.first & path.start.delta & ~far
    target.n = dr.select(far, -path.start.ray.d, dr.select(point, path.start.ray.d, target.n))
    # The light path was traced from the other end, by rays with other origins, so its own direction needs a walk, too.
    ω, base, active = walk(scene, y.si, ω, path.events, target, active)
    ω1, shot, J, found = follow(scene, y.si, ω, base, x, path.events, target=target, active=active)
    away, away1 = dr.abs(dr.dot(target.n, base.ray.d)), dr.abs(dr.dot(target.n, shot.ray.d))
    G = J * cosine(x, ω1) / cosine(y.si, ω) * (away / away1)

    # --------------------- The end that stays --------------------
    last = mi.SurfaceInteraction3f(x)
    last.p = shot.ray.o
    moved, ratio, _ = lights.redirected(scene, path.start, last)
    e, p_connect = lights.densities(scene, moved, last)
    f, p, q = evaluate(IMPORTANCE, before.si, before.si.bsdf(), before.si.to_local(-shot.ray.d), found & ~path.first)
    end = mis.leave(before.end, cosine(before.si, shot.ray.d), p, q, mi.Bool(False))
    β = dr.select(path.first, moved.β, before.β * f * dr.rcp(path.p)) * path.survival
    ratio = dr.select(path.first, ratio, p / path.p)
    vc = dr.select(path.first, dr.select(moved.delta, 0, dr.rcp(e * p_connect)), end.vc)

    # ------------------------- The edge --------------------------
    β *= shot.weight * (shot.P / base.P * G * dr.square(base.η))
    r = ratio * shot.P / base.P * G * dr.square(base.η / shot.η)
    vc *= dr.rcp(shot.turns * cosine(x, ω1))
    found &= (ratio > 0) & dr.isfinite(dr.sum(β)) & dr.isfinite(r) & dr.isfinite(vc)
    return -ω1, dr.select(found, β, 0), dr.select(found, r, 0), dr.select(found, vc, 0)


def choose(i: mi.UInt32, values: list[float]) -> mi.Float:
    """Number ``i`` of the ``values``."""
    found = mi.Float(0)
    for k, value in enumerate(values):
        found = dr.select(i == k, mi.Float(value), found)
    return found
