r"""Candidates: a random walk, and the choice of one of its paths for a reservoir.

A walk is that of Mitsuba's ``path``: emitter sampling and BSDF sampling at each vertex. Each emitter found ends a path.
One of these paths is chosen during the walk, with a probability in proportion to the luminance of f W, its contribution
C. Its W becomes the sum of these luminances over all paths, divided by the luminance of its own f. So the mean of C
over the choices is the radiance of the walk. [Lin et al. 2022; Chao 1982 for a choice in one pass]

    F       integrand of the walk up to vertex x, in the measures of ``ngpt_studies.restir.record``
    W       1 / density of the same, with Russian roulette
    B       f / p of all vertices after rc, a factor of ``L``
    phase   BEFORE rc; AT rc; BEHIND it

At joined events f and p are those of the whole material, not of the sampled lobe, since ``evaluate`` has no others.
This is unbiased for ``blendbsdf`` too, whose samples give the density of only one of its parts.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from data_gen.paths.camera import CameraSamples
from data_gen.paths.lights import emission
from data_gen.paths.mis import mis_weight
from data_gen.paths.streams import sample_streams
from data_gen.paths.vertex import DELTA, SMOOTH, evaluate, event_kind, seen_from
from data_gen.paths.walk import roulette
from data_gen.samplers.gpt.base_path import light_mis
from data_gen.samplers.gpt.plan import Plan
from ngpt_studies.restir.record import (
    HIT,
    LIGHT,
    RC_LIGHT,
    REPLAY,
    STUCK,
    SUFFIX,
    Record,
    empty,
    geometry_of,
    word_of,
)
from ngpt_studies.restir.stage import Stage

_BEFORE, _AT, _BEHIND = 0, 1, 2


@dataclass
class Candidate:
    """The path that was chosen: its record, its integrand ``f`` and its weight ``W``; f W estimates the radiance.

    ``W`` is 0 where the walk met no light. ``L`` is the sum over all paths of the walk, the estimate of ``path``. Both
    leave out emission that the camera sees directly.
    """

    record: Record
    f: mi.Spectrum
    W: mi.Float
    L: mi.Spectrum


@dataclass
class _Choice:
    """The fields of ``Record`` in which the paths of a walk differ. They share rc."""

    word: mi.UInt32
    f: mi.Spectrum  # integrand of the path
    w: mi.Vector3f
    L: mi.Spectrum
    p_light: mi.Float


@dataclass
class _Kept:
    """The path that is chosen from those found so far."""

    chosen: _Choice
    total: mi.Float  # Σ of the luminances of all paths
    L: mi.Spectrum  # Σ of their contributions f W

    def offered(self, new: _Choice, W: mi.Float, u: mi.Float, exists: mi.Bool | bool = True) -> _Kept:
        """The state after one more path: weighted reservoir sampling by a random number ``u``."""
        L = self.L + dr.select(exists, new.f * W, 0)
        weight = mi.luminance(new.f) * W
        weight = dr.select(dr.isfinite(weight) & (weight > 0), weight, 0)
        total = self.total + weight
        takes = u * total < weight
        return _Kept(dr.select(takes, new, self.chosen), total, L)


@dataclass
class _RC:
    """The vertex where copies of the path reconnect, and the direction from there. Names as in ``Record``."""

    P: mi.Point3f
    shape: mi.ShapePtr
    primitive: mi.UInt32
    uv: mi.Point2f
    geometry: mi.Float
    w: mi.Vector3f


@dataclass
class _State:
    x: mi.SurfaceInteraction3f
    depth: mi.UInt32  # number of x, from 1 on
    F: mi.Spectrum  # integrand up to x, or up to rc if that is before x
    W: mi.Float  # 1 / density of the same
    B: mi.Spectrum  # f / p of the vertices behind rc
    η: mi.Float  # product of the relative indices of refraction up to x, or since rc
    phase: mi.UInt32
    replayed: mi.UInt32  # vertices before rc that a copy leaves by replay
    stuck: mi.Bool  # rc was left by a Dirac delta or a hole
    rc: _RC
    walks: mi.Bool  # whether x was reached


def choices(seed: int, camera: CameraSamples, sample: mi.UInt32) -> mi.Sampler:
    """Random numbers for the choices of reservoirs, independent of those for paths."""
    own = int(np.random.SeedSequence([seed, 1]).generate_state(1, np.uint64)[0])
    return sample_streams(own, camera.pixel, sample)


def walk(stage: Stage, camera: CameraSamples, sample: mi.UInt32, choice) -> Candidate:
    """A candidate for each camera sample, of number ``sample``. ``choice`` has the random numbers for choices."""
    ray, importance, _ = camera.rays()
    none = empty(dr.width(camera.pixel))
    start = _State(
        x=stage.scene.ray_intersect(mi.Ray3f(ray)),
        depth=mi.UInt32(1),
        F=mi.Spectrum(importance),
        W=mi.Float(1),
        B=mi.Spectrum(1),
        η=mi.Float(1),
        phase=mi.UInt32(_BEFORE),
        replayed=mi.UInt32(0),
        stuck=mi.Bool(False),
        rc=_RC(none.P, none.shape, none.primitive, none.uv, none.geometry, none.w),
        walks=mi.Bool(True),
    )
    kept = _Kept(_Choice(none.word, none.L, none.w, none.L, none.p_light), mi.Float(0), mi.Spectrum(0))
    rc, kept = _walk(stage.scene, stage.plan, camera.random.clone(), choice, start, kept)
    chosen, weight = kept.chosen, mi.luminance(kept.chosen.f)
    record = Record(
        pixel=camera.pixel,
        sample=sample,
        place=camera.position,
        word=chosen.word,
        P=rc.P,
        shape=rc.shape,
        primitive=rc.primitive,
        uv=rc.uv,
        w=chosen.w,
        L=chosen.L,
        p_light=chosen.p_light,
        geometry=rc.geometry,
    )
    return Candidate(record, chosen.f, dr.select(weight > 0, kept.total / weight, 0), kept.L)


@dr.syntax
def _walk(scene, plan: Plan, random, choice, at: _State, kept: _Kept) -> tuple[_RC, _Kept]:
    """The whole walk: returns rc, where copies of its paths reconnect, and the chosen path."""
    active = at.x.is_valid() & (at.depth < plan.limits.max_depth)
    while active:
        numbers = draw(random)
        u_light, u_hit = choice.next_1d(), choice.next_1d()
        kept = kept.offered(_to_light(scene, plan, at, numbers), at.W, u_light)
        at, met = _onward(scene, plan, at, numbers, active)
        kept = kept.offered(met, at.W, u_hit, at.walks)
        active = at.walks & at.x.is_valid() & (at.depth < plan.limits.max_depth)
    return at.rc, kept


def _to_light(scene, plan: Plan, at: _State, numbers: Numbers) -> _Choice:
    """The path that ends at an emitter sampled at x."""
    x, bsdf = at.x, at.x.bsdf()
    before, at_rc, behind = at.phase == _BEFORE, at.phase == _AT, at.phase == _BEHIND
    lit = mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
    light, Le_p = plan.lights.seen(scene, x, numbers.light, lit)
    lit &= light.pdf != 0
    f, p = evaluate(bsdf, x, x.to_local(light.d), lit)
    fm = f * light_mis(light.delta, light.pdf, p)
    # The kind of path
    kind_at_rc = dr.select(light.delta, mi.UInt32(SUFFIX), mi.UInt32(RC_LIGHT))
    kind_behind = dr.select(at.stuck, mi.UInt32(STUCK), mi.UInt32(SUFFIX))
    kind = dr.select(before, mi.UInt32(LIGHT), dr.select(at_rc, kind_at_rc, kind_behind))
    replayed = dr.select(before, at.depth - 1, at.replayed)
    return _Choice(
        word=word_of(kind, replayed, dr.select(before, 0, at.depth - 2 - at.replayed), True),
        f=dr.select(lit, at.F * at.B * fm * Le_p, 0),
        w=dr.select(behind, at.rc.w, light.d),
        L=dr.select(behind, at.B * fm * Le_p, Le_p),
        p_light=dr.select(at_rc & ~light.delta, light.pdf, 0),
    )


def _onward(scene, plan: Plan, at: _State, numbers: Numbers, active: mi.Bool) -> tuple[_State, _Choice]:
    """A step along a sampled direction: the walk at its next vertex x1, and the path that ends at a lamp there."""
    x, before, at_rc, behind = at.x, at.phase == _BEFORE, at.phase == _AT, at.phase == _BEHIND

    # ------------------------- The event -------------------------
    event = sample_event(scene, plan, x, numbers, active)
    x1 = event.x1
    joins = before & event.joined  # whether x1 is rc,
    there = joins & x1.is_valid()  # and on a surface
    # A ray starts slightly off its surface, so the direction from x to its hit differs a bit from that of the ray.
    d = dr.select(there, dr.normalize(x1.p - x.p), event.ray.d)
    x1 = seen_from(x1, d)
    f, p = evaluate(x.bsdf(), x, dr.select(there, x.to_local(d), event.wo), event.kind == SMOOTH)
    follows = at_rc & (event.kind == SMOOTH) & (p > 0)  # whether a copy can leave rc along d
    stuck = at.stuck | (at_rc & ~follows)
    # The directions of these two steps have a density in solid angle. In other steps the integrand is f / p.
    density = joins | follows
    f_p = dr.select(density, f / p, event.f_p)
    η = dr.select(event.found, at.η * event.η, at.η)

    # ---------------------- Russian roulette ---------------------
    # Behind rc it depends only on the path behind rc, so that it can be repeated from there.
    throughput = dr.max(dr.select(behind, at.B, at.F * at.W) * f_p)
    q = roulette(throughput, at.depth >= plan.limits.rr_depth, η)
    # If a join has density 0 for the corrected direction, there is no such path.
    walks = (throughput > 0) & (numbers.survival < q) & event.found & (~joins | (p > 0))
    survival = dr.select(walks, dr.rcp(q), 0)
    # Up to rc, survival belongs to the density; behind it, to B.
    W = dr.select(behind, at.W, at.W * survival * dr.select(density, dr.rcp(p), 1))
    F = dr.select(behind, at.F, at.F * dr.select(density, f, event.f_p))
    B = dr.select(behind, at.B * f_p * survival, at.B)

    # ----------------------------- rc ----------------------------
    rc = _RC(
        P=dr.select(there, x1.p, at.rc.P),
        shape=dr.select(there, event.hit.shape, at.rc.shape),
        primitive=dr.select(there, event.hit.prim_index, at.rc.primitive),
        uv=dr.select(there, event.hit.prim_uv, at.rc.uv),
        geometry=dr.select(there, geometry_of(x1.n, x1.p, x.p), at.rc.geometry),
        w=dr.select(joins | at_rc, d, at.rc.w),
    )
    replayed = dr.select(joins, at.depth - 1, at.replayed)

    # ----------------------- Le that was met ---------------------
    Le, p_light = emission(scene, x1, x, walks, walks & (event.kind == SMOOTH), plan.lights)
    m = mis_weight(dr.select(density, p, event.p), p_light)
    kind_behind = dr.select(stuck, mi.UInt32(STUCK), mi.UInt32(SUFFIX))
    kind = dr.select(joins, mi.UInt32(HIT), dr.select(before, mi.UInt32(REPLAY), kind_behind))
    left = dr.select(before & ~joins, at.depth, replayed)
    met = _Choice(
        word=word_of(kind, left, dr.select(before, 0, at.depth - 1 - replayed), False),
        f=dr.select(walks, F * B * Le * m, 0),
        w=rc.w,
        # Behind rc, m is a factor of L. At rc it is not, since each copy computes its own m.
        L=dr.select(behind, B * Le * m, Le),
        p_light=dr.select(follows, p_light, 0),
    )
    phase = dr.select(joins | at_rc, at.phase + 1, at.phase)
    η = dr.select(at_rc, 1, η)
    return _State(x1, at.depth + 1, F, W, B, η, phase, replayed, stuck, rc, walks), met


# Random numbers of a vertex, in total
DRAWN = 6


@dataclass
class Numbers:
    """The random numbers of a vertex. All are drawn, used or not, so that a replay gets the same ones."""

    light: mi.Point2f
    lobe: mi.Float
    direction: mi.Point2f
    survival: mi.Float


def draw(random) -> Numbers:
    return Numbers(random.next_2d(), random.next_1d(), random.next_2d(), random.next_1d())


@dataclass
class Event:
    """A direction sampled at a vertex x, and the vertex x1 that it leads to."""

    found: mi.Bool
    kind: mi.UInt32
    wo: mi.Vector3f  # in the frame of x
    p: mi.Float
    η: mi.Float
    f_p: mi.Spectrum  # f / p
    ray: mi.Ray3f
    hit: mi.PreliminaryIntersection3f
    x1: mi.SurfaceInteraction3f
    joined: mi.Bool  # whether copies of the path reconnect at x1, unless they do so before


def sample_event(scene: mi.Scene, plan: Plan, x: mi.SurfaceInteraction3f, numbers: Numbers, active: mi.Bool) -> Event:
    """The event that these random ``numbers`` sample at ``x``, and the vertex to which it leads."""
    bsdf = x.bsdf()
    sample, f_p = bsdf.sample(mi.BSDFContext(), x, numbers.lobe, numbers.direction, active)
    found = active & (sample.pdf > 0) & (dr.max(f_p) > 0)
    kind = dr.select(found, event_kind(sample.sampled_type), DELTA)
    ray = x.spawn_ray(x.to_world(sample.wo))
    hit = scene.ray_intersect_preliminary(ray, active=found)
    x1 = hit.compute_surface_interaction(ray)
    rough = ~x1.is_valid() | plan.materials.connectable(x1.bsdf())
    # Both vertices count, so that a path and its copy agree on where to reconnect. A record has no room for the
    # instance of a shape, so vertices on instances are replayed.
    joined = (kind == SMOOTH) & plan.materials.connectable(bsdf) & rough
    joined &= hit.instance == None  # noqa: E711 - a comparison of arrays of pointers
    return Event(found, kind, sample.wo, sample.pdf, sample.eta, dr.select(found, f_p, 0), ray, hit, x1, joined)
