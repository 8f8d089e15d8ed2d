"""The base path of ``gpt``, vertex by vertex: Mitsuba's ``path``, and what offset paths need to know of it."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from data_gen.paths import caustic, media, segments
from data_gen.paths.lights import emission
from data_gen.paths.shift import mis_weight
from data_gen.paths.vertex import DELTA, NULL, SMOOTH, event_kind
from data_gen.samplers.gpt.manifold_shift import Chain, advance
from data_gen.samplers.gpt.plan import Plan


@dataclass
class Step:
    """What the base path does at its current vertex x; x1 is the next one. Symbols as in ``gpt``."""

    x: mi.SurfaceInteraction3f
    x_connectable: mi.Bool
    β: mi.Spectrum
    # Emitter sampling
    u_light: mi.Point2f
    light: mi.DirectionSample3f
    light_weight: mi.Spectrum  # Le / p
    T_light: mi.Spectrum | None  # transmittance
    lit: mi.Bool  # the sample is seen from x, or is of no use
    L_light: mi.Spectrum  # f m Le V / p
    # BSDF sampling
    u_lobe: mi.Float
    u_direction: mi.Point2f
    wo: mi.Vector3f
    η: mi.Float  # relative index of refraction along the sampled direction
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
    # See data_gen.paths.caustic; L_light and L_bsdf hold nothing of that layer
    L_caustic: mi.Spectrum  # f m Le / p of both techniques
    rough: mi.Bool  # behind x
    late: mi.Bool  # behind x
    ends_late: mi.Bool  # or behind x1 at the latest
    # See data_gen.samplers.gpt.manifold_shift; L_bsdf and L_caustic hold nothing of that light
    L_followed: mi.Spectrum  # m Le
    chain: Chain | None  # behind x
    # See data_gen.paths.media and segments; None in scenes without media
    place: media.Place | None
    channel: mi.UInt32 | None
    numbers: segments.Numbers | None  # of the segment
    light_key: mi.UInt32 | None  # of the random numbers on the way to the emitter
    segment: segments.Segment | None


def base_step(
    scene, plan: Plan, random, x, place, channel, β, η, depth, seen, rough, late, chain, offsets
) -> tuple[Step, mi.Float]:
    """Samples an emitter and the next vertex from vertex x, the ``depth``-th; returns the step and the product of η.

    Random numbers are drawn whether used or not: a replay needs the same ones, whatever its path meets.
    """
    # ---------------------- Random numbers -----------------------
    u_light, u_lobe, u_direction = random.next_2d(), random.next_1d(), random.next_2d()
    u_survival = random.next_1d()
    numbers = segments.draw(random, plan.media) if plan.media else None
    light_key = random.next_key() if plan.media and plan.media.grids else None

    # --------------------- Emitter sampling ----------------------
    bsdf = x.bsdf()
    lit = mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
    if plan.media:
        lit |= place.scatters
    # Offset paths take over the point on a shared emitter, with shadow rays of their own: Le / p must come without V.
    light, light_weight = scene.sample_emitter_direction(x, u_light, False, lit)
    lit &= light.pdf != 0
    # Toward the emitter and along a new direction at once
    f, p, sample, f_p = media.evaluate_and_sample(bsdf, x, place, x.to_local(light.d), u_lobe, u_direction)
    # No shadow ray toward what lies behind the surface, but for those who arrive from elsewhere.
    shadow_ray, T_light = x.spawn_ray_to(light.p), None
    asked = lit & ((dr.max(f) > 0) | dr.any([y.joined for y in offsets]))
    if plan.media:
        T_light = segments.transmittance(scene, plan.media, x, place, shadow_ray, light.p, channel, light_key, asked)
        lit &= dr.max(T_light) > 0
    else:
        lit &= ~scene.ray_test(shadow_ray, asked)
    # The sample's share of L (survey, eq. 2), weighted by m against the density p of finding it by BSDF sampling
    L_light = dr.select(lit, f * light_weight * light_mis(light.delta, light.pdf, p), 0)
    if plan.media:
        L_light *= T_light

    # ----------------------- BSDF sampling -----------------------
    found = sample.pdf > 0
    # At its end a base path reconnects to nothing: with DELTA its offset paths are sent to replay, beside a ghost.
    kind = dr.select(found, event_kind(sample.sampled_type), DELTA)
    # An environment that hides from the camera hides as well behind holes, where nothing has been scattered yet.
    seen = seen | (kind != NULL)
    η = dr.select(found, η * sample.eta, η)

    # ---------------------- Russian roulette ---------------------
    survival, walks = roulette(plan, depth, β * f_p, f_p, η, u_survival, offsets)
    goes_on = walks & found
    # All five paths survive together: 1 / q is a factor of each throughput, and cancels in r (survey, eq. 17).
    f_p = dr.select(goes_on, f_p * survival, 0)

    # ------------------- Next vertex, and Le there ---------------
    ray, segment = x.spawn_ray(x.to_world(sample.wo)), None
    if plan.media:
        trace, medium = segments.next_surface(scene), place.toward(x, ray.d)
        segment = segments.fly(plan.media, trace, ray, medium, channel, numbers, goes_on)
        x1 = media.vertex(segment.ray, segment.hit, segment.place)
        # Of the whole segment
        x1.t = dr.select(x1.is_valid(), dr.norm(x1.p - x.p), x1.t)
        f_p *= segment.weight
    else:
        x1 = scene.ray_intersect(ray, goes_on)
    x_connectable = plan.materials.connectable(bsdf)
    if plan.media:
        x_connectable |= place.scatters
    # After a mirror or a hole emitter sampling could not have found x1: p_light = 0, and m = 1.
    Le, p_light = emission(scene, x1, x, goes_on & (x1.is_valid() | seen), goes_on & (kind == SMOOTH))
    L_bsdf, ends_late = Le * mis_weight(sample.pdf, p_light), mi.Bool(False)
    L_caustic, L_followed = mi.Spectrum(0), mi.Spectrum(0)

    # ------------------- The layer ``caustic`` -------------------
    if plan.caustic:
        L_light, caustic_light = caustic.split(caustic.lit_late(rough, late, x_connectable), L_light)
        rough, late = caustic.classes(rough, late, found, kind, x_connectable)
        L_bsdf, caustic_bsdf = caustic.split(late, L_bsdf)
        if plan.manifold:
            event = sample.sampled_type
            chain, follows = advance(chain, depth, event, goes_on, x_connectable, survival, late, x1, Le)
            caustic_bsdf, L_followed = caustic.split(follows, caustic_bsdf)
        L_caustic = caustic_light + f_p * caustic_bsdf
        smooth, sharp = kind == SMOOTH, plan.materials.sharp(x1, scene)
        if plan.media:
            sharp &= ~segment.place.scatters
        ends_late = late | caustic.ends_late(smooth, x_connectable, sharp)
    step = Step(
        x=x,
        x_connectable=x_connectable,
        β=β,
        u_light=u_light,
        light=light,
        light_weight=light_weight,
        T_light=T_light,
        lit=lit,
        L_light=L_light,
        u_lobe=u_lobe,
        u_direction=u_direction,
        wo=sample.wo,
        η=sample.eta,
        kind=kind,
        p=sample.pdf,
        f_p=f_p,
        survival=survival,
        goes_on=goes_on,
        walks=walks,
        seen=seen,
        β1=β * f_p,
        x1=x1,
        x1_connectable=~x1.is_valid() | plan.materials.connectable(x1.bsdf()),
        Le=Le,
        p_light=p_light,
        L_bsdf=L_bsdf,
        L_caustic=L_caustic,
        rough=rough,
        late=late,
        ends_late=ends_late,
        L_followed=L_followed,
        chain=chain,
        place=place,
        channel=channel,
        numbers=numbers,
        light_key=light_key,
        segment=segment,
    )
    if plan.media:
        step.x1_connectable |= segment.place.scatters
    return step, η


def roulette(plan: Plan, depth, β1, f_p, η, u, offsets) -> tuple[mi.Float, mi.Bool]:
    """Russian roulette: 1 / probability to survive, and whether the path does.

    By the throughput of the brightest of all five paths, so that none is starved.
    """
    largest = dr.max(β1)
    for y in offsets:
        # What an offset path may yet bring to Δ / 2: w β' until it is settled, with its β' of before this step, since
        # its f is not known yet; then w |β' - β|, which is |a| / 2.
        ahead = dr.select(y.apart | y.joined, dr.max(y.β) / (1 + y.r), 0)
        largest = dr.fmax(largest, dr.fmax(ahead, dr.max(dr.abs(y.a * f_p)) / 2))
    # As in ``path``: η² undoes what refraction does to radiance, and none survives for ever, were it a perfect mirror.
    q = dr.fmin(largest * dr.square(η), 0.95)
    plays = depth >= plan.rr_depth
    return dr.select(plays, dr.rcp(q), 1), (largest > 0) & (~plays | (u < q))


def light_mis(delta: mi.Bool, p_light: mi.Float, p: mi.Float) -> mi.Float:
    """MIS weight of a sampled emitter whose direction BSDF sampling finds with density ``p``."""
    # No direction that is sampled ever meets a point or a single direction.
    return dr.select(delta, 1, mis_weight(p_light, p))
