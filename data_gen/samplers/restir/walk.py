r"""Candidates: one random walk, and of all its paths the one that a reservoir keeps.

A walk is Mitsuba's ``path``: emitter sampling and BSDF sampling at each vertex. Each emitter found is a path. One of
them is chosen as the walk goes on, with probability in proportion to the luminance of its contribution C = f W, and
its W becomes the sum of all these luminances over the luminance of its own f: C's mean over the choices is the walk's
radiance. [Lin et al. 2022; Chao 1982 for the choice in one go]

    F       integrand of the walk up to vertex x, in the measures of ``data_gen.samplers.restir.record``
    W       1 / density of the same, Russian roulette included
    B       radiance behind rc, as part of ``L``: f / p of all vertices since
    phase   BEFORE rc; AT rc; BEHIND it

At joined events f and p are those of the material as a whole, not of the lobe that was sampled: ``evaluate`` knows no
other, and the mixture of both is unbiased for ``blendbsdf`` too, whose samples tell the density of one part alone.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import drjit as dr
import mitsuba as mi
import numpy as np

from data_gen.paths.camera import CameraSamples
from data_gen.paths.lights import emission
from data_gen.paths.shift import mis_weight
from data_gen.paths.streams import sample_streams
from data_gen.paths.vertex import SMOOTH, evaluate, seen_from
from data_gen.paths.walk import roulette
from data_gen.samplers.gpt.base_path import light_mis
from data_gen.samplers.gpt.plan import Plan
from data_gen.samplers.restir.events import draw, sample_event
from data_gen.samplers.restir.record import (
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

_BEFORE, _AT, _BEHIND = 0, 1, 2


@dataclass
class Candidate:
    """The path that was chosen: its record, its integrand ``f`` and its weight ``W``; f W estimates the radiance.

    ``W`` is 0 where the walk met no light. ``L`` is the sum over all paths of the walk: what ``path`` would have given.
    Emission that the camera sees directly is in neither.
    """

    record: Record
    f: mi.Spectrum
    W: mi.Float
    L: mi.Spectrum


@dataclass
class _Choice:
    """What differs between the paths of a walk; rc they share."""

    word: mi.UInt32
    f: mi.Spectrum
    w: mi.Vector3f
    L: mi.Spectrum
    p_light: mi.Float


def choices(seed: int, camera: CameraSamples, sample: mi.UInt32) -> mi.Sampler:
    """Random numbers by which reservoirs choose. They are none of those that a replay must find in their place."""
    own = int(np.random.SeedSequence([seed, 1]).generate_state(1, np.uint64)[0])
    return sample_streams(own, camera.pixel, sample)


def walk(scene: mi.Scene, plan: Plan, camera: CameraSamples, sample: mi.UInt32, choice) -> Candidate:
    """A candidate for each camera sample, which has number ``sample``; ``choice`` draws what chooses among paths."""
    ray, importance, _ = camera.rays()
    x = scene.ray_intersect(mi.Ray3f(ray))
    return _walk(scene, plan, camera.random.clone(), choice, camera.pixel, sample, camera.position, x, importance)


@dr.syntax
def _walk(scene, plan, random, choice, pixel, sample, place, x, importance):
    lanes = dr.width(pixel)
    record = empty(lanes)
    chosen = _Choice(record.word, record.L, record.w, record.L, record.p_light)
    F, W, B = mi.Spectrum(importance), mi.Float(1), mi.Spectrum(1)
    L, total, η, phase, depth = mi.Spectrum(0), mi.Float(0), mi.Float(1), mi.UInt32(_BEFORE), mi.UInt32(1)
    # rc, and how the walk goes on from there
    P, shape, primitive, uv, w, geometry = (
        *(record.P, record.shape, record.primitive, record.uv),
        *(record.w, record.geometry),
    )
    replayed, stuck = mi.UInt32(0), mi.Bool(False)
    active = x.is_valid() & (depth < plan.limits.max_depth)
    while active:
        numbers = draw(random)
        u_light, u_hit = choice.next_1d(), choice.next_1d()
        before, at, behind = phase == _BEFORE, phase == _AT, phase == _BEHIND

        # ---------------------- Emitter sampling ---------------------
        bsdf = x.bsdf()
        lit = mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        light, Le_p = scene.sample_emitter_direction(x, numbers.light, True, lit)
        lit &= light.pdf != 0
        f, p = evaluate(bsdf, x, x.to_local(light.d), lit)
        fm = f * light_mis(light.delta, light.pdf, p)
        at_rc = dr.select(light.delta, mi.UInt32(SUFFIX), mi.UInt32(RC_LIGHT))
        ends = dr.select(stuck, mi.UInt32(STUCK), mi.UInt32(SUFFIX))
        found = _Choice(
            word_of(
                dr.select(before, mi.UInt32(LIGHT), dr.select(at, at_rc, ends)),
                dr.select(before, depth - 1, replayed),
                dr.select(before, 0, depth - 2 - replayed),
                True,
            ),
            dr.select(lit, F * B * fm * Le_p, 0),
            dr.select(behind, w, light.d),
            dr.select(behind, B * fm * Le_p, Le_p),
            dr.select(at & ~light.delta, light.pdf, 0),
        )
        L += found.f * W
        chosen, total = _stream(chosen, total, found, W, u_light)

        # ----------------------- BSDF sampling -----------------------
        event = sample_event(scene, plan, x, numbers, active)
        x1 = event.x1
        there = before & event.joined & x1.is_valid()
        # A ray starts beside its surface, to leave it: what it meets is seen from x in a direction that differs a bit.
        d = dr.select(there, dr.normalize(x1.p - x.p), event.ray.d)
        x1 = seen_from(x1, d)
        f, p = evaluate(bsdf, x, dr.select(there, x.to_local(d), event.wo), event.kind == SMOOTH)
        joins = before & event.joined
        # The two steps whose directions have a density in solid angle
        follows = at & (event.kind == SMOOTH) & (p > 0)
        stuck |= at & ~follows
        density = joins | follows
        f_p = dr.select(density, f / p, event.f_p)
        η = dr.select(event.found, η * event.η, η)
        # Behind rc it goes by what is behind rc alone, so that it can be played again from there.
        β1 = dr.select(behind, B, F * W) * f_p
        q = roulette(dr.max(β1), depth >= plan.limits.rr_depth, η)
        survival, walks = dr.rcp(q), (dr.max(β1) > 0) & (numbers.survival < q)
        # Where a join has no density, after that correction, there is no such path.
        walks &= event.found & (~joins | (p > 0))
        survival = dr.select(walks, survival, 0)
        W = dr.select(behind, W, W * survival * dr.select(density, dr.rcp(p), 1))
        F = dr.select(behind, F, F * dr.select(density, f, event.f_p))
        B = dr.select(behind, B * f_p * survival, B)

        # ----------------------------- rc ----------------------------
        P, shape = dr.select(there, x1.p, P), dr.select(there, event.hit.shape, shape)
        primitive, uv = dr.select(there, event.hit.prim_index, primitive), dr.select(there, event.hit.prim_uv, uv)
        geometry = dr.select(there, geometry_of(x1.n, x1.p, x.p), geometry)
        replayed = dr.select(joins, depth - 1, replayed)
        w = dr.select(joins | at, d, w)

        # ----------------------- Le that was met ---------------------
        Le, p_light = emission(scene, x1, x, walks, walks & (event.kind == SMOOTH))
        m = mis_weight(dr.select(density, p, event.p), p_light)
        # Behind rc m is a part of L; at rc it is the other paths' own.
        ends = dr.select(stuck, mi.UInt32(STUCK), mi.UInt32(SUFFIX))
        met = _Choice(
            word_of(
                dr.select(joins, mi.UInt32(HIT), dr.select(before, mi.UInt32(REPLAY), ends)),
                dr.select(before & ~joins, depth, replayed),
                dr.select(before, 0, depth - 1 - replayed),
                False,
            ),
            dr.select(walks, F * B * Le * m, 0),
            w,
            dr.select(behind, B * Le * m, Le),
            dr.select(follows, p_light, 0),
        )
        L += dr.select(walks, met.f * W, 0)
        chosen, total = _stream(chosen, total, met, W, u_hit)

        η = dr.select(at, 1, η)
        phase = dr.select(joins | at, phase + 1, phase)
        x = x1
        depth += 1
        active = walks & x.is_valid() & (depth < plan.limits.max_depth)
    record = Record(
        pixel=pixel,
        sample=sample,
        place=place,
        word=chosen.word,
        P=P,
        shape=shape,
        primitive=primitive,
        uv=uv,
        w=chosen.w,
        L=chosen.L,
        p_light=chosen.p_light,
        geometry=geometry,
    )
    weight = mi.luminance(chosen.f)
    return Candidate(record, chosen.f, dr.select(weight > 0, total / weight, 0), L)


def _stream(chosen: _Choice, total: mi.Float, new: _Choice, W: mi.Float, u: mi.Float) -> tuple[_Choice, mi.Float]:
    """Weighted reservoir sampling of one more path."""
    weight = mi.luminance(new.f) * W
    weight = dr.select(dr.isfinite(weight) & (weight > 0), weight, 0)
    total = total + weight
    takes = u * total < weight
    values = {f.name: dr.select(takes, getattr(new, f.name), getattr(chosen, f.name)) for f in fields(_Choice)}
    return _Choice(**values), total
