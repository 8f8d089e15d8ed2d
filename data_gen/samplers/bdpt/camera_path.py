"""The path from the camera, vertex by vertex. Each vertex is joined to lamps, to a light path, and to nearby photons.

Each vertex of the camera path is connected to one vertex of the light path, chosen by its estimated contribution.

Connections to all vertices of the light path would take half the time of a sample, most of it for little light. The
light of the single connection is divided by the probability of the choice, so its mean is the light of all connections,
and the MIS weights of strategies stay the same. The choice adds little noise if the contributions are estimated well.
This estimate reads only the records of the light path: it evaluates no material and traces no ray.
"""

from __future__ import annotations

from typing import Any, Protocol

import drjit as dr
import mitsuba as mi

from data_gen.paths.eye import Sight
from data_gen.paths.vertex import event_kind
from data_gen.paths.walk import Sky, roulette
from data_gen.samplers.bdpt import mis
from data_gen.samplers.bdpt.light_path import LightPath
from data_gen.samplers.bdpt.mis import Partial
from data_gen.samplers.bdpt.plan import Plan
from data_gen.samplers.bdpt.strategies import connected, emission_at, to_light
from data_gen.samplers.bdpt.vertex import (
    RADIANCE,
    Vertex,
    context,
    cosine,
    leave,
    recall,
    reverse_density,
    scatters_smoothly,
)


class Merges(Protocol):
    """Gathers photons at the vertices of camera paths, see ``vcm.merging``."""

    def light(self, z: Vertex, bsdf: mi.BSDFPtr, active: mi.Bool) -> mi.Spectrum:
        """The weighted light of the photons near the vertex ``z``."""


@dr.syntax
def camera_path(plan: Plan, sight: Sight, light_path: LightPath | None, merging: Merges | None = None) -> tuple:
    """Returns L, Le and L_merged of a path from the camera, joined to a ``light_path`` and to photons, if given.

    Le is the emission that the camera sees directly, L_merged is the light of photons, and L is all other light.
    """
    scene, lights, limits, random = plan.scene, plan.lights, plan.limits, sight.random
    ray = mi.Ray3f(sight.ray)
    si = plan.first_hit(scene, ray).compute_surface_interaction(ray)
    Le = sight.importance * si.emitter(scene).eval(si, mi.Bool(limits.shows))

    L, L_merged = dr.zeros(mi.Spectrum, dr.width(ray)), dr.zeros(mi.Spectrum, dr.width(ray))
    β = mi.Spectrum(sight.importance)  # throughput f / p up to the vertex si
    η = mi.Float(1)  # product of the relative indices of refraction
    depth = mi.UInt32(1)  # edges of the path up to si
    sky = Sky.from_camera(limits.hide_emitters)
    active = si.is_valid() & (depth < limits.max_depth)
    toward, density = sight.eye.toward(si, sight.eye.lens, active)
    end = mis.begin_camera(density, cosine(si, ray.d))  # partial sums of the MIS weights, at si
    edge = plan.begins(si.p + toward.d * toward.dist)  # the edge that leads to si
    while dr.hint(active, label="camera path"):
        z = Vertex(si, β, end, depth, edge)
        bsdf = si.bsdf()
        smooth = active & scatters_smoothly(bsdf)
        joined = depth + 1 <= plan.longest

        # ---------------------- To a light -----------------------
        u_light, u_lobe, u_direction = random.next_2d(), random.next_1d(), random.next_2d()
        u_survival = random.next_1d()
        light, weight = lights.connect(scene, si, u_light, smooth)[:2]
        lit = smooth & (light.pdf > 0)
        wo = si.to_local(light.d)
        # A single call evaluates the material toward the light and samples the next direction.
        f, p, sample, f_p = bsdf.eval_pdf_sample(context(RADIANCE), si, wo, u_lobe, u_direction)
        f = dr.select(dr.isfinite(dr.sum(f)) & dr.isfinite(p), f, 0)
        lit &= dr.max(f * weight) > 0
        q = reverse_density(si, bsdf, wo, lit)
        T, holes = plan.sees(si, light.p, limits.max_depth - (depth + 1), lit)
        z.end = known(end, depth + 1 + holes <= plan.longest)
        C, others = to_light(lights, z, light, weight, f, p=p, q=q)
        L += dr.select(lit, C * T / (1 + others), 0)
        z.end = known(end, joined)

        # ------------------- To the light path -------------------
        if dr.hint(light_path is not None, mode="scalar"):
            u_connection = random.next_1d()
            L += connection(plan, z, bsdf, smooth & joined, light_path, u_connection)

        # ------------------- To photons near by ------------------
        if dr.hint(merging is not None, mode="scalar"):
            L_merged += merging.light(z, bsdf, smooth & joined)

        # ---------------------- Next vertex ----------------------
        found = active & (sample.pdf > 0)
        sky = sky.behind(event_kind(sample.sampled_type), found)
        η = dr.select(found, η * sample.eta, η)
        d, end = leave(z, bsdf, sample, found, plan.merged(bsdf, joined))
        end, edge = plan.onward(z, bsdf, sample, end)
        β *= f_p
        survival = roulette(dr.max(β), depth >= limits.rr_depth, η)
        active = found & (dr.max(β) > 0) & (u_survival < survival)
        β /= survival
        depth += 1
        reached = scene.ray_intersect(si.spawn_ray(d), active)

        # ----------------- Emission met by chance ----------------
        met = active & sky.meets(reached)
        Le_met, p, e = emission_at(scene, lights, reached, si if edge is None else edge.seen_by(si), met)
        if dr.hint(edge is not None, mode="scalar"):
            # The first edge begins at the camera, and no emitter is sampled from the camera itself.
            p, e = dr.select(edge.first, 0, p), dr.select(edge.first, 0, e)
        # Light paths find no path of more than ``longest`` edges.
        end.vc = dr.select(depth <= plan.longest, end.vc, 0)
        L += dr.select(met, β * Le_met / (1 + mis.others_emitted(end, e, p)), 0)
        si = reached
        active &= si.is_valid() & (depth < limits.max_depth)
        end = plan.arrives(end, edge, si, d)
    return L, Le, L_merged


def known(end: Partial, joined: mi.Bool) -> Partial:
    """Returns the partial sums at a vertex. Where the path is too long to be ``joined`` to light paths, it is weighted
    as if there were no light paths.
    """
    return Partial(dr.select(joined, end.vcm, 0), dr.select(joined, end.vc, 0), end.waiting)


@dr.syntax
def connection(plan: Plan, z: Vertex, bsdf, active, light_path: LightPath, u: mi.Float) -> Any:
    """Estimates the light of all connections of ``z`` to a light path from one connection, which ``u`` chooses."""
    L = dr.zeros(mi.Spectrum, dr.width(z.depth))
    chosen, times = choose(z, active, light_path, plan.longest, u)
    if active & (times > 0):
        y = recall(light_path.kept.read(chosen), z.si.time, z.si.wavelengths)
        C, others = connected(plan, z, bsdf, y, mi.Bool(True))
        L = dr.select(dr.max(C) > 0, C * (times / (1 + others)), 0)
    return L


# Added to cosines, because a shading normal may face light when the geometric normal does not, and because glossy
# materials do not scatter like matte ones
_LEAST_COSINE = 0.1


@dr.syntax
def choose(z: Vertex, active, light: LightPath, longest: int, u: mi.Float):
    """Returns the number of the chosen vertex of ``light``, and 1 / the probability of the choice (0: no vertex).

    The random number ``u`` chooses among vertices whose connection makes a path of at most ``longest`` edges.
    """
    kept, end = light.kept, dr.minimum(light.count, longest - 1 - z.depth)
    come_from = cosine(z.si, z.si.to_world(z.si.wi))
    i = mi.UInt32(0)  # the current vertex
    chosen = mi.UInt32(0)  # a vertex before i, chosen in proportion to its worth
    total, own = mi.Float(0), mi.Float(0)  # the worth of all vertices before i, and of the chosen one
    while dr.hint(active & (i < end), label="choice"):
        w = worth(z, come_from, kept.read(i))
        total += w
        share = w / total
        taken = (w > 0) & (u < share)
        # Rescales the random number to [0, 1), so that it can be used again.
        u = dr.select(taken, u / share, (u - share) / (1 - share))
        u = dr.select(dr.isfinite(u), u, 0)
        chosen = dr.select(taken, i, chosen)
        own = dr.select(taken, w, own)
        i += 1
    return chosen, dr.select(own > 0, total / own, 0)


def worth(z: Vertex, come_from: mi.Float, y) -> mi.Float:
    """Estimates the light of the connection from ``z`` to the record ``y``, times the MIS weight of this connection.

    The estimate takes both vertices for white and matte. ``come_from`` is the cosine of the direction from ``z`` to its
    previous vertex.
    """
    to = mi.Vector3f(y.o + y.d * y.t - z.si.p)
    distance2 = dr.squared_norm(to)
    d = to * dr.rsqrt(distance2)
    cos_z, cos_y = cosine(z.si, d), dr.abs(dr.dot(y.n, d))
    side_z = mis.Side(cos_z, cos_z / dr.pi, come_from / dr.pi)
    side_y = mis.Side(cos_y, cos_y / dr.pi, dr.abs(dr.dot(y.n, y.d)) / dr.pi)
    others = mis.others_connected(z.end, Partial(y.vcm, y.vc), mis.Connection(side_z, side_y, distance2))
    w = dr.max(y.β) * (cos_z + _LEAST_COSINE) * (cos_y + _LEAST_COSINE) / (distance2 * (1 + others))
    return dr.select((y.depth > 0) & dr.isfinite(w), w, 0)
