"""The base path of ``gpt``, vertex by vertex: the path of Mitsuba's ``path``, and the values that offset paths need."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from data_gen.paths import caustic, media
from data_gen.paths.holes import Aim
from data_gen.paths.lights import emission
from data_gen.paths.mis import mis_weight
from data_gen.paths.segments import Segment
from data_gen.paths.space import Drawn
from data_gen.paths.vertex import DELTA, SMOOTH, event_kind
from data_gen.paths.walk import Sky, roulette
from data_gen.samplers.gpt.plan import Plan
from data_gen.scenes.lamps import Chosen
from data_gen.tails import matt
from data_gen.tails.cache import Trail


@dataclass
class Path:
    """A base path at its current vertex x: the state of the loop. Symbols as in ``gpt``."""

    x: mi.SurfaceInteraction3f
    place: media.Place | None  # where x is; None in scenes without media
    channel: mi.UInt32 | None  # colour by which distances are sampled; None in scenes without media
    β: mi.Spectrum  # throughput up to x; 0 for a ghost
    η: mi.Float  # product of the relative indices of refraction up to x
    depth: mi.UInt32  # number of x, from 1 on
    sky: Sky  # whether the path sees the environment if it escapes
    # Whether the path has scattered smoothly (not specularly) at a connectable vertex: see data_gen.paths.caustic
    rough: mi.Bool
    late: mi.Bool  # whether the path was rough and has later left a vertex by a mirror, glass or sharp gloss
    walks: mi.Bool  # whether any of the five paths may go on from x
    aim: Aim | None = None  # the aim of the edge that has led to x; None in scenes without holes
    # If paths may end in the cache: how far this path has come, and the reflectance ρ of the matt part of x whose light
    # the cache has supplied (0: no light)
    trail: Trail | None = None
    ρ: mi.Color3f | None = None

    def goes_on(self, plan: Plan, offsets: list) -> mi.Bool:
        """Whether there is another step: the base path lives, or it is a ghost and offset paths are apart from it."""
        company = dr.any([y.apart for y in offsets])
        return self.walks & (self.x.is_valid() | company) & (self.depth < plan.limits.max_depth)


@dataclass
class Recording:
    """The records of a path that feeds the cache."""

    any: mi.Bool  # whether the path has a record; light that it finds before its first record is not used
    here: mi.Bool  # whether the newest record is at the current vertex


@dataclass
class Step:
    """A step of the base path from its vertex x to the next vertex x1."""

    x: mi.SurfaceInteraction3f
    x_connectable: mi.Bool
    place: media.Place | None
    β: mi.Spectrum
    # Random numbers, which offset paths replay
    u_light: mi.Point2f
    u_lobe: mi.Float
    u_direction: mi.Point2f
    drawn: Drawn | None  # in media
    # Emitter sampling
    light: mi.DirectionSample3f
    light_weight: mi.Spectrum  # Le / p
    lamp: Chosen | None  # None where lamps are not chosen by place
    T_light: mi.Spectrum | int  # transmittance
    lit: mi.Bool  # whether the sample is visible from x; says nothing where no path uses the sample
    L_light: mi.Spectrum  # f m Le V / p, where V is the visibility
    # BSDF sampling
    wo: mi.Vector3f
    η: mi.Float  # relative index of refraction along the sampled direction
    kind: mi.UInt32
    p: mi.Float
    f_p: mi.Spectrum  # f / p, survival included
    survival: mi.Float  # 1 / probability to survive Russian roulette
    goes_on: mi.Bool  # whether the base path goes on: to a next vertex, or out of the scene
    walks: mi.Bool  # whether any of the five paths may go on
    β1: mi.Spectrum
    segment: Segment  # from x to x1
    x1: mi.SurfaceInteraction3f
    x1_connectable: mi.Bool
    Le: mi.Spectrum  # emitted at x1 toward x
    p_light: mi.Float  # density with which emitter sampling would have found x1
    L_bsdf: mi.Spectrum  # m Le
    # The layer ``caustic``, see data_gen.paths.caustic; L_light and L_bsdf contain none of its light
    L_caustic: mi.Spectrum  # f m Le / p of both techniques
    ends_late: mi.Bool  # whether the path is late behind x, or will be late behind x1
    more: mi.UInt32 | int  # number of edges that may follow after x1
    # In scenes with holes: whether the path has passed a hole at x, and its aim behind x
    passed: mi.Bool | None = None
    aim: Aim | None = None
    # f m Le V / p and f / p (survival included), as they would be if x were a matt surface of reflectance 1. None if no
    # path may end in the cache
    E_light: mi.Spectrum | None = None
    E_p: mi.Float | None = None


def begin(plan: Plan, x: mi.SurfaceInteraction3f, place, channel, β: mi.Spectrum) -> Path:
    """Returns a base path at its first vertex. A path that has found no vertex has throughput 0, but may walk on as a
    ghost.
    """
    return Path(
        x=x,
        place=place,
        channel=channel,
        β=dr.select(x.is_valid(), β, 0),
        η=mi.Float(1),
        depth=mi.UInt32(1),
        sky=Sky.from_camera(plan.hides),
        rough=mi.Bool(False),
        late=mi.Bool(False),
        walks=mi.Bool(True),
        aim=Aim.of_camera(x.p) if plan.space.holes else None,
    )


def base_step(
    scene, plan: Plan, random, path: Path, offsets: list, recording: Recording | None = None
) -> tuple[Step, Path]:
    """Samples an emitter and the next vertex from the ``path``'s vertex. Returns that step, and the path after it.

    All random numbers are drawn, even those that the base path does not use: offset paths replay the same numbers, and
    may need them for what they meet. A path that is ``recording`` leaves the vertex of its newest record as if the
    surface were also matt and white: see ``data_gen.samplers.gpt.tails``.
    """
    x, place, space = path.x, path.place, plan.space

    # ---------------------- Random numbers -----------------------
    u_light, u_lobe, u_direction = random.next_2d(), random.next_1d(), random.next_2d()
    u_survival = random.next_1d()
    drawn = space.draw(random, path.channel)

    # --------------------- Emitter sampling ----------------------
    bsdf = x.bsdf()
    lit = mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth) | media.scatters(place)
    # Offset paths use the same point on the emitter, with their own shadow rays. So Le / p must not include V.
    light, light_weight, lamp = plan.lights.sample(scene, x, u_light, lit)
    lit &= light.pdf != 0
    if recording:
        lit &= recording.any
    # One call evaluates the direction to the emitter and samples a new direction.
    to_light = x.to_local(light.d)
    E_light: Any = None
    E_p: Any = None
    both = matt_too(plan, path, recording)
    if both is None:
        f, p, sample, f_p = media.evaluate_and_sample(bsdf, x, place, to_light, u_lobe, u_direction)
    else:
        f, p, sample, f_p = matt.evaluate_and_sample(bsdf, x, place, to_light, (u_lobe, u_direction), both)
    survival_of_rest = mi.Float(1)
    if path.ρ is not None:
        E_light, smooth = matt.matt_lobe(x, place, to_light), event_kind(sample.sampled_type) == SMOOTH
        E_p = dr.select(smooth & (sample.pdf > 0), matt.matt_lobe(x, place, sample.wo) / sample.pdf, 0)
        # Light that the cache has already supplied is left out. Where little light may remain, few paths continue.
        f, survival_of_light = rest(f, path.ρ * E_light)
        f_p, survival_of_rest = rest(f_p, path.ρ * E_p)
        followed = u_survival < survival_of_light
        f = dr.select(followed, f * dr.rcp(dr.maximum(survival_of_light, 1e-20)), 0)
    # No shadow ray is traced where f is 0, for example behind the surface. A joined path is an exception: it arrives
    # from elsewhere, so its f may not be 0.
    asked = dr.max(dr.abs(f)) > 0
    if recording:
        asked |= recording.here & (E_light > 0)
    asked = lit & (asked | dr.any([y.joined for y in offsets]))
    more = plan.limits.max_depth - path.depth - 1
    T_light, visible = space.sees(x, place, light.p, drawn, asked, most=more)
    lit &= visible
    # The contribution of the sample to L (survey, eq. 2), with its MIS weight m. BSDF sampling finds it with density p.
    Le_light = light_weight * light_mis(light.delta, light.pdf, p)
    L_light = dr.select(lit, f * Le_light, 0) * T_light
    if path.ρ is not None:
        E_light = dr.select(lit, E_light * Le_light, 0) * T_light

    # ----------------------- BSDF sampling -----------------------
    found = sample.pdf > 0
    # Where a base path ends, there is nothing to reconnect to. The kind DELTA makes offset paths replay beside the
    # ghost.
    kind = dr.select(found, event_kind(sample.sampled_type), DELTA)
    sky = path.sky.behind(kind)
    η = dr.select(found, path.η * sample.eta, path.η)

    # ---------------------- Russian roulette ---------------------
    # Roulette uses the brightness that the rest has if it is followed. With its own brightness, a faint rest would have
    # to survive twice.
    whole = f_p * dr.rcp(dr.maximum(survival_of_rest, 1e-20))
    largest = brightest(path.β * whole, whole, offsets)
    if recording:
        largest = dr.maximum(largest, dr.select(recording.here, E_p, 0))
    q = roulette(largest, path.depth >= plan.limits.rr_depth, η) * survival_of_rest
    survival, walks = dr.rcp(q), (largest > 0) & (u_survival < q)
    goes_on = walks & found
    # All five paths survive together: 1 / q is a factor of each throughput, and cancels in r (survey, eq. 17).
    f_p = dr.select(goes_on, f_p * survival, 0)

    # ------------------- Next vertex, and Le there ---------------
    ray = x.spawn_ray(x.to_world(sample.wo))
    segment = space.fly(x, place, ray, drawn, goes_on)
    x1 = space.end(x, segment)
    f_p *= segment.weight
    β1 = path.β * f_p
    if path.ρ is not None:
        E_p = dr.select(goes_on, E_p * survival, 0)
    if recording:
        # All later light belongs to the record at x, however dark the surface is. After a mirror event, later light
        # belongs only to earlier records, and E_p is 0.
        β1 = dr.select(recording.here, dr.maximum(β1, E_p * segment.weight), β1)
    # After a mirror event, emitter sampling could not have found x1. So p_light = 0, and m = 1.
    aim, passed, seen_by, sampled, p_x1 = None, None, x, kind == SMOOTH, sample.pdf
    if path.aim is not None:
        passed = space.holes.passed(bsdf, kind)
        aim = path.aim.behind(passed, x, kind, sample.pdf)
        seen_by, sampled, p_x1 = aim.seen_by(x), dr.isfinite(aim.p), aim.p
    Le, p_light = emission(scene, x1, seen_by, goes_on & sky.meets(x1), goes_on & sampled, plan.lights)
    L_bsdf = Le * mis_weight(p_x1, p_light)

    # ------------------- The layer ``caustic`` -------------------
    x_connectable = plan.materials.connectable(bsdf) | media.scatters(place)
    rough, late, ends_late, L_caustic = path.rough, path.late, mi.Bool(False), mi.Spectrum(0)
    if plan.caustic:
        L_light, caustic_light = caustic.split(caustic.lit_late(rough, late, x_connectable), L_light)
        rough, late = caustic.classes(rough, late, found, kind, x_connectable)
        L_bsdf, caustic_bsdf = caustic.split(late, L_bsdf)
        L_caustic = caustic_light + f_p * caustic_bsdf
        sharp = plan.materials.sharp(x1, scene) & ~media.scatters(segment.place)
        ends_late = late | caustic.ends_late(kind == SMOOTH, x_connectable, sharp)

    step = Step(
        x=x,
        x_connectable=x_connectable,
        place=place,
        β=path.β,
        u_light=u_light,
        u_lobe=u_lobe,
        u_direction=u_direction,
        drawn=drawn,
        light=light,
        light_weight=light_weight,
        lamp=lamp,
        T_light=T_light,
        lit=lit,
        L_light=L_light,
        wo=sample.wo,
        η=sample.eta,
        kind=kind,
        p=sample.pdf,
        f_p=f_p,
        survival=survival,
        goes_on=goes_on,
        walks=walks,
        β1=β1,
        segment=segment,
        x1=x1,
        x1_connectable=~x1.is_valid() | plan.materials.connectable(x1.bsdf()) | media.scatters(segment.place),
        Le=Le,
        p_light=p_light,
        L_bsdf=L_bsdf,
        L_caustic=L_caustic,
        ends_late=ends_late,
        more=more,
        passed=passed,
        aim=aim,
        E_light=E_light,
        E_p=E_p,
    )
    behind = Path(
        x=x1,
        place=segment.place,
        channel=path.channel,
        β=dr.select(x1.is_valid(), β1, 0),
        η=η,
        depth=path.depth + 1,
        sky=sky,
        rough=rough,
        late=late,
        walks=walks,
        aim=aim,
        trail=path.trail and path.trail.on(x1, media.scatters(segment.place), kind == SMOOTH, sample.pdf, goes_on),
        ρ=None if path.ρ is None else mi.Color3f(0),
    )
    return step, behind


def brightest(β1: mi.Spectrum, f_p: mi.Spectrum, offsets: list) -> mi.Float:
    """Returns the throughput of the brightest of the five paths after a step. Russian roulette uses it, so that no path
    is starved.
    """
    largest = dr.max(dr.abs(β1))
    for y in offsets:
        # The most that an offset path can still contribute to Δ / 2. Until the path is settled, this is w β', with β'
        # from before this step, because the path's f is not known yet. Once settled, it is w |β' - β| = |a| / 2.
        ahead = dr.select(y.apart | y.joined, dr.max(y.β) / (1 + y.r), 0)
        largest = dr.fmax(largest, dr.fmax(ahead, dr.max(dr.abs(y.a * f_p)) / 2))
    return largest


def matt_too(plan: Plan, path: Path, recording: Recording | None) -> mi.Bool | None:
    """Returns the lanes in which all directions of a matt surface must be sampled, even those that the material does
    not sample. None stands for no lane.

    A record needs these directions, because it holds the light that arrives at a matt surface. They are also needed
    where the cache has supplied the matt part of a vertex and a bump or normal map tilts the material. There, in
    directions into which the material scatters nothing, the rest is negative and not 0.
    """
    x, both = path.x, None
    if path.ρ is not None and plan.matt.any_tilted:
        both = plan.matt.tilted(x, (dr.max(path.ρ) > 0) & ~media.scatters(path.place))
    if recording:
        here = recording.here & ~plan.matt.lambertian(x, path.place, recording.here)
        both = here if both is None else here | both
    return both


def rest(f: mi.Spectrum, ended: mi.Spectrum) -> tuple[mi.Spectrum, mi.Float]:
    """Returns the rest of ``f`` after the cache has supplied ``ended``, and the probability of following the rest. This
    probability is the size of the rest relative to f, so that a path that follows the rest has the brightness of f."""
    left = f - ended
    size = dr.max(dr.abs(left)) / dr.maximum(dr.max(dr.abs(f)), 1e-20)
    return left, dr.select(dr.max(ended) > 0, dr.minimum(size, 1), 1)


def light_mis(delta: mi.Bool, p_light: mi.Float, p: mi.Float) -> mi.Float:
    """MIS weight of a sampled emitter whose direction BSDF sampling finds with density ``p``."""
    # BSDF sampling never meets a lamp that is a point or has a single direction, so m = 1.
    return dr.select(delta, 1, mis_weight(p_light, p))
