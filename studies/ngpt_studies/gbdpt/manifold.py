"""Walks on the manifold of specular paths, which lead a copy of a path through the same mirrors and glass to one point.

A path leaves a rough vertex z in direction ω, meets k specular events, and arrives at x_c. From another vertex z' the
same events may lead to the same x_c along another direction ω'. To arrive at x_c is two equations for the two unknowns
of ω'. Newton's method solves them. [Hanika et al. 2015, "Manifold next event estimation"; Hua et al. 2019, "A Survey on
Gradient-Domain Rendering", section 3.4]

    B     dx_c/dω, a 2x2 matrix, by ray differentials [Igehy 1999, "Tracing ray differentials"]; x_c moves on the
          tangent plane of its surface or, at infinity, on a plane normal to its direction
    J     dω'/dω at a fixed x_c, |det B| / |det B'|

There may be several solutions, and a walk may end at another one, or at none. The shift from z to z' is an involution
only if a walk back from z' to z arrives at ω: ``follow()`` rejects all others. All functions here are pure.

Chains over bump and normal maps are rejected, since Mitsuba does not expose the derivatives of these maps.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

# Events of a chain, two bits each, the first one in the lowest bits; 0 ends the chain.
REFLECT, REFRACT, PASS = 1, 2, 3
MAX_EVENTS = 6
# Measured: 95 % of the walks that arrive at all need at most 6 to 10 steps (meshes, spheres, waves).
MAX_STEPS = 12
# The largest distance from x_c at which a walk may end, as a share of the chain's length (at infinity: an angle).
TOLERANCE = 1e-4
# The largest distance from ω at which the walk back may end.
RETURNS = 1e-3


# Called at each event except the first. It says whether a chain would have ended there, whichever event is sampled.
Ends = Callable[["mi.SurfaceInteraction3f"], "mi.Bool"]


def nowhere(si: mi.SurfaceInteraction3f) -> mi.Bool:
    """False everywhere: a chain ends only behind its last event."""
    return mi.Bool(False)


@dataclass
class Target:
    """Where a chain ends: at the point ``p`` of a surface with geometric normal ``n``; ``far``: in direction ``n``."""

    p: mi.Point3f
    n: mi.Vector3f
    far: mi.Bool


@dataclass
class Shot:
    """A chain of events from a vertex z in some direction, up to the plane of the target."""

    good: mi.Bool  # whether it has met all its events and arrives from the front of the plane
    miss: mi.Vector2f  # the vector on the plane from the target to the point of arrival
    reach: mi.Float  # the length that ``miss`` is compared with
    B0: mi.Vector2f  # columns of B, for two orthogonal changes of ω
    B1: mi.Vector2f
    first: mi.Point3f  # point of the first event
    weight: mi.Spectrum  # product of f / P over the events
    P: mi.Float  # product of the probabilities with which the events are sampled
    η: mi.Float  # product of the events' relative indices of refraction
    turns: mi.Float  # product over the events of |cos| after / |cos| before, to the geometric normal
    ray: mi.Ray3f  # from the last event

    @property
    def det(self) -> mi.Float:
        return self.B0.x * self.B1.y - self.B0.y * self.B1.x


def event(sampled_type: mi.UInt32) -> mi.UInt32:
    """REFLECT, REFRACT or PASS, given the ``sampled_type`` of a BSDF sample; 0 if it is not specular."""
    code = dr.select(mi.has_flag(sampled_type, mi.BSDFFlags.DeltaReflection), mi.UInt32(REFLECT), 0)
    code = dr.select(mi.has_flag(sampled_type, mi.BSDFFlags.DeltaTransmission), REFRACT, code)
    return dr.select(mi.has_flag(sampled_type, mi.BSDFFlags.Null), PASS, code)


def has_room(events: mi.UInt32) -> mi.Bool:
    return events < (1 << (2 * MAX_EVENTS - 2))


def add_event(events: mi.UInt32, code: mi.UInt32) -> tuple[mi.UInt32, mi.Bool]:
    """The chain with one more event at its end, and whether there is room for it."""
    fits = has_room(events)
    # The place behind the highest event
    place = (34 - dr.lzcnt(events) - 1) & ~mi.UInt32(1)
    return events | (code << place), fits


def shoot(
    scene,
    z: mi.SurfaceInteraction3f,
    ω: mi.Vector3f,
    events: mi.UInt32,
    target: Target,
    active=True,
    *,
    ends: Ends = nowhere,
) -> Shot:
    """Follows the ``events``, and the ray differentials, from ``z`` in direction ``ω`` (world space)."""
    return _shoot(scene, z, ω, events, target, active=active, ends=ends)


# ``dr.syntax`` forgets the defaults of keywords.
@dr.syntax
def _shoot(scene, z, ω, events, target: Target, *, active, ends: Ends) -> Shot:
    # ------------------------ Loop state -------------------------
    ray = z.spawn_ray(ω)
    frame = mi.Frame3f(ω)
    dp0, dp1 = mi.Vector3f(0), mi.Vector3f(0)  # differentials of the ray's origin
    dd0, dd1 = mi.Vector3f(frame.s), mi.Vector3f(frame.t)  # and of its direction
    weight = mi.Spectrum(1)  # product of f / P
    P = mi.Float(1)  # product of the probabilities
    η = mi.Float(1)  # product of the relative indices of refraction
    turns = mi.Float(1)  # product of the quotients of cosines
    length = mi.Float(0)  # of the way so far
    first = mi.Point3f(z.p)  # point of the first event
    left = mi.UInt32(events)  # events to come
    good = mi.Bool(active)  # all events were met so far
    while dr.hint(good & (left != 0), label="chain"):
        # ------------------------ Event --------------------------
        si = scene.ray_intersect(ray, mi.RayFlags.All | mi.RayFlags.dNSdUV, False, good)
        code = left & 3
        # The smallest random number samples a reflection in all of Mitsuba's materials, the largest one a hole or
        # refraction.
        u = dr.select(code == REFLECT, mi.Float(0), 1 - dr.epsilon(mi.Float))
        sample, f_P = si.bsdf().sample(mi.BSDFContext(), si, u, mi.Point2f(0.5), good)
        good &= si.is_valid() & (sample.pdf > 0) & (event(sample.sampled_type) == code)
        good &= (left == events) | ~ends(si)
        # --------------------- Differentials ---------------------
        dp0, dn0 = on_surface(si, ray.d, dp0 + dd0 * si.t)
        dp1, dn1 = on_surface(si, ray.d, dp1 + dd1 * si.t)
        d, dd0, dd1 = turn(code, sample.eta, si.sh_frame.n, ray.d, (dn0, dn1), (dd0, dd1))
        wo = si.to_world(sample.wo)
        # A surface with a bump or normal map turns rays in a direction that the shape does not explain.
        good &= dr.squared_norm(wo - d) < 1e-6
        first = dr.select(left == events, si.p, first)
        weight *= f_P
        P *= sample.pdf
        η *= sample.eta
        turns *= dr.abs(dr.dot(wo, si.n) / dr.dot(ray.d, si.n))
        length += si.t
        ray = si.spawn_ray(wo)
        left >>= 2
    end = Shot(good, mi.Vector2f(0), length, mi.Vector2f(0), mi.Vector2f(0), first, weight, P, η, turns, ray)
    return arrive(target, end, (dp0, dp1), (dd0, dd1))


def arrive(target: Target, shot: Shot, dp: tuple, dd: tuple) -> Shot:
    """Continues ``shot`` from its last event, where its ``reach`` ends, to the plane of the target."""
    ray, good = shot.ray, shot.good
    plane = mi.Frame3f(target.n)
    cos = dr.dot(ray.d, target.n)
    t = dr.select(target.far, 0, dr.dot(target.p - ray.o, target.n) / cos)
    good &= dr.select(target.far, cos > 0, (t > 0) & dr.isfinite(t))
    miss = dr.select(target.far, ray.d - target.n, mi.Vector3f(ray.o + ray.d * t - target.p))
    columns = []
    for p, d in zip(dp, dd, strict=True):
        # Moves the differential along the ray until it is on the plane.
        move = p + d * t
        columns.append(dr.select(target.far, d, move - ray.d * (dr.dot(move, target.n) / cos)))
    B0, B1, miss = (mi.Vector2f(dr.dot(v, plane.s), dr.dot(v, plane.t)) for v in (*columns, miss))
    reach = dr.select(target.far, 1, shot.reach + t)
    return replace(shot, good=good & dr.isfinite(dr.squared_norm(miss)), miss=miss, reach=reach, B0=B0, B1=B1)


def on_surface(si: mi.SurfaceInteraction3f, d: mi.Vector3f, dp: mi.Vector3f) -> tuple[mi.Vector3f, mi.Vector3f]:
    """The differentials of the point where a ray meets the surface, and of the shading normal there."""
    dp = dp - d * (dr.dot(dp, si.n) / dr.dot(d, si.n))
    # Its coordinates (u, v), by the normal equations
    uu, uv, vv = dr.squared_norm(si.dp_du), dr.dot(si.dp_du, si.dp_dv), dr.squared_norm(si.dp_dv)
    u, v = dr.dot(dp, si.dp_du), dr.dot(dp, si.dp_dv)
    scale = dr.rcp(uu * vv - uv * uv)
    return dp, si.dn_du * ((vv * u - uv * v) * scale) + si.dn_dv * ((uu * v - uv * u) * scale)


def turn(code, η, n, d, dn: tuple, dd: tuple) -> tuple[mi.Vector3f, mi.Vector3f, mi.Vector3f]:
    """The direction ``d`` after an event, and its two differentials (Igehy 1999, eq. 14-18). ``η`` is n_t / n_i."""
    back = dr.dot(d, n) > 0
    N = mi.Vector3f(dr.select(back, -n, n))
    cos = dr.dot(d, N)
    e = dr.rcp(η)
    cos_t = -dr.safe_sqrt(1 - dr.square(e) * (1 - dr.square(cos)))
    # d' = a d + b N with a = e, b = cos' - e cos for refractions, a = 1, b = -2 cos for mirrors, b = 0 for holes
    refracts, reflects = code == REFRACT, code == REFLECT
    a = dr.select(refracts, e, 1)
    b = dr.select(refracts, cos_t - e * cos, dr.select(reflects, -2 * cos, 0))
    slope = dr.select(refracts, dr.square(e) * cos / cos_t - e, dr.select(reflects, mi.Float(-2), 0))
    changes = []
    for dn_i, dd_i in zip(dn, dd, strict=True):
        dN = dr.select(back, -dn_i, dn_i)
        dcos = dr.dot(dd_i, N) + dr.dot(d, dN)
        changes.append(a * dd_i + b * dN + (slope * dcos) * N)
    return a * d + b * N, *changes


def walk(
    scene, z, ω: mi.Vector3f, events: mi.UInt32, target: Target, active=True, *, ends: Ends = nowhere
) -> tuple[mi.Vector3f, Shot, mi.Bool]:
    """Newton's method, started at ``ω``: the direction from ``z`` to the target, its shot, and whether it was found.

    A step that breaks the chain, or does not come nearer, is halved.
    """
    return _walk(scene, z, ω, events, target, active=active, ends=ends)


@dr.syntax
def _walk(scene, z, ω, events, target: Target, *, active, ends: Ends) -> tuple[mi.Vector3f, Shot, mi.Bool]:
    best_ω, best = mi.Vector3f(ω), shoot(scene, z, ω, events, target, active, ends=ends)
    error = dr.norm(best.miss)
    found = best.good & (error < TOLERANCE * best.reach)
    active = best.good & ~found
    part, steps = mi.Float(1), mi.UInt32(0)
    while dr.hint(active, label="walk"):
        # ω' = ω - part B⁻¹ miss
        turns = mi.Frame3f(best_ω)
        scale = -part / best.det
        s = (best.B1.y * best.miss.x - best.B1.x * best.miss.y) * scale
        t = (best.B0.x * best.miss.y - best.B0.y * best.miss.x) * scale
        next_ω = dr.normalize(best_ω + turns.s * s + turns.t * t)
        shot = shoot(scene, z, next_ω, events, target, active & dr.isfinite(s + t), ends=ends)
        nearer = shot.good & (dr.norm(shot.miss) < error)
        part = dr.select(nearer, dr.fmin(1, 2 * part), part / 2)
        if nearer:
            best_ω, best, error = mi.Vector3f(next_ω), shot, dr.norm(shot.miss)
        found |= nearer & (error < TOLERANCE * best.reach)
        steps += 1
        active &= ~found & (steps < MAX_STEPS) & dr.isfinite(s + t)
    return best_ω, best, found


def follow(
    scene, z, ω, base: Shot, z1, events, *, target: Target, active=True, ends: Ends = nowhere
) -> tuple[mi.Vector3f, Shot, mi.Float, mi.Bool]:
    """Copies to vertex ``z1`` the chain that the ``base`` shot took from ``z`` in direction ``ω``.

    Returns the direction ω' of the copy, its shot, J = dω'/dω, and whether it exists. It exists if the walk arrives,
    the walk back returns to ω, and nothing is between the last event and the target.
    """
    # A walk starts toward the first event of the other chain. With that chain's direction it would miss small or near
    # objects.
    ω1, shot, found = walk(scene, z1, dr.normalize(base.first - z1.p), events, target, active & base.good, ends=ends)
    J = dr.abs(base.det / shot.det)
    found &= dr.isfinite(J) & (J > 0)
    back, _, returned = walk(scene, z, dr.normalize(shot.first - z.p), events, target, found, ends=ends)
    found &= returned & (dr.squared_norm(back - ω) < RETURNS**2)
    ray = mi.Ray3f(shot.ray)
    ray.maxt = dr.select(target.far, dr.largest(mi.Float), dr.norm(target.p - ray.o) * (1 - mi.math.ShadowEpsilon))
    found &= ~scene.ray_test(ray, found)
    return ω1, shot, J, found
