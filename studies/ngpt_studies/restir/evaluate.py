r"""E(record, place): the contribution of a record's path at another place on the film. All reuse is computed from it.

The prefix is replayed from the record's random numbers through that place, with the current camera. Then the path goes
straight to rc, and on as before. The shift back must follow the same rules: no replayed vertex may be joined, and the
vertex before rc must be connectable. See ``ngpt_studies.restir.record`` for measures and kinds.

At its own place, with its own camera, E returns the recorded f, up to float32 rounding.

``P`` and ``shape`` of a record must belong to this scene. Records from another scene are carried here first, see
``ngpt_studies.restir.carry``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from data_gen.paths.camera import CameraSamples
from data_gen.paths.lights import emission, sample_light, shadowed
from data_gen.paths.mis import mis_weight
from data_gen.paths.vertex import SMOOTH, evaluate, seen_from
from data_gen.samplers.gpt.base_path import light_mis
from data_gen.samplers.gpt.plan import Plan
from ngpt_studies.restir.record import HIT, LIGHT, RC_LIGHT, REPLAY, STUCK, Record, gather, geometry_of
from ngpt_studies.restir.stage import Stage
from ngpt_studies.restir.walk import Numbers, draw, sample_event


@dataclass
class Shifted:
    """A path in another pixel: ``f`` in the measures of that pixel, 0 if it does not exist, and the Jacobian ``J``."""

    f: mi.Spectrum
    J: mi.Float
    geometry: mi.Float  # for Record.moved()


def evaluate_record(stage: Stage, seed: int, record: Record, place: mi.Point2f, active: mi.Bool) -> Shifted:
    """E(record, place): the paths of the records, shifted to the ``place`` on the film."""
    scene, plan = stage.scene, stage.plan
    camera = CameraSamples.replayed(stage.sensor, seed, record.pixel, record.sample, place)
    ray, importance, inside = camera.rays()
    y = scene.ray_intersect(mi.Ray3f(ray), active & inside)
    kind = record.kind
    good = y.is_valid() & (kind != STUCK)
    random = camera.random.clone()
    if plan.replays:
        y, β, good, L_replayed = _replay(scene, plan, random, record, y, good)
    else:
        β, L_replayed = mi.Spectrum(1), mi.Spectrum(0)
        # If all materials are connectable the first event is always joined.
        good &= record.replayed == 0
    lit = _lit(scene, plan, y, draw(random), good & (kind == LIGHT))
    joined, J, geometry = _connected(scene, plan, record, y, good & (kind != LIGHT) & (kind != REPLAY))
    replayed = dr.select(kind == REPLAY, L_replayed, β * dr.select(kind == LIGHT, lit, joined))
    f = importance * dr.select(good, replayed, 0)
    f = dr.select(dr.isfinite(dr.sum(f)) & dr.isfinite(J) & (J > 0), f, 0)
    return Shifted(f, J, geometry)


@dr.syntax
def _replay(scene, plan: Plan, random, record: Record, y, good):
    """The vertex behind the prefix, f / p up to it, whether the shift can be undone, and the radiance of REPLAY."""
    β = mi.Spectrum(1)  # f / p of the replayed vertices so far
    L = mi.Spectrum(0)  # radiance of REPLAY
    i = mi.UInt32(0)  # number of replayed vertices so far
    replayed, ends = record.replayed, record.kind == REPLAY
    active = good & (i < replayed)
    while active:
        event = sample_event(scene, plan, y, draw(random), active)
        last = ends & (i + 1 == replayed)
        Le, p_light = emission(scene, event.x1, y, last & event.found, last & (event.kind == SMOOTH), plan.lights)
        # If the event is joined here, the reverse shift would reconnect at it.
        good &= ~active | (event.found & ~event.joined & (last | event.x1.is_valid()))
        β *= event.f_p
        L = dr.select(last, β * Le * mis_weight(event.p, p_light), L)
        y = event.x1
        i += 1
        active = good & (i < replayed)
    return y, β, good, L


def _lit(scene: mi.Scene, plan: Plan, y: mi.SurfaceInteraction3f, numbers: Numbers, active: mi.Bool) -> mi.Spectrum:
    """f m Le V / p of the emitter that the ``numbers`` sample."""
    bsdf = y.bsdf()
    active = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
    light = sample_light(scene, y, numbers.light, active, plan.lights)
    f, p = evaluate(bsdf, y, y.to_local(light.d), active)
    return shadowed(scene, y, light, dr.select(active, f * light_mis(light.delta, light.p, p), 0))


def _connected(
    scene: mi.Scene, plan: Plan, record: Record, y: mi.SurfaceInteraction3f, active: mi.Bool
) -> tuple[mi.Spectrum, mi.Float, mi.Float]:
    """f of the path from ``y`` to rc, the Jacobian of this step, and its geometry. J is 1 where not ``active``."""
    hit, ray = record.hit(y.p)
    d, far, hits = ray.d, record.escapes(), record.kind == HIT
    x = hit.compute_surface_interaction(ray, active=active)
    geometry = dr.select(active & ~far, geometry_of(x.n, record.P, y.p), record.geometry)
    J = dr.select(active & ~far, geometry / record.geometry, 1)

    bsdf = y.bsdf()
    f1, p1 = evaluate(bsdf, y, y.to_local(d), active & plan.materials.connectable(bsdf))
    active = active & (dr.max(f1) > 0) & dr.isfinite(J) & (J > 0)
    # rc on a lamp: Le and the density of emitter sampling are evaluated again.
    Le, p_light = emission(scene, x, y, active & hits, active & hits, plan.lights)
    # rc on a surface
    behind = active & ~hits
    x = seen_from(x, d)
    f2, p2 = evaluate(x.bsdf(), x, x.to_local(record.w), behind)
    sampled = record.kind == RC_LIGHT
    m = dr.select(sampled, mis_weight(record.p_light, p2), mis_weight(p2, record.p_light))
    f = f1 * dr.select(hits, Le * mis_weight(p1, p_light), f2 * record.L * m)

    to_rc = y.spawn_ray_to(record.P)
    shadow = dr.select(far, y.spawn_ray(d), to_rc)
    active &= dr.max(f) > 0
    return dr.select(active & ~scene.ray_test(shadow, active), f, 0), J, geometry


# (lanes, number of the end: 0 or 1) -> which record, at which place on the film, and whether it exists
Request = Callable[["mi.UInt32", "mi.UInt32"], "tuple[mi.UInt32, mi.Point2f, mi.Bool]"]
_NONE = 0xFFFFFFFF


@dataclass
class Requests:
    """E for some of many lanes. ``slot`` is the index of each lane; results for the second end begin at ``count``."""

    slot: mi.UInt32
    count: mi.UInt32
    shifted: Shifted

    def at(self, lane: mi.UInt32, active: bool | mi.Bool = True, end: int = 0) -> Shifted:
        """The results of these lanes. Where nothing was requested, f is 0 and the Jacobian 1."""
        slot = dr.gather(mi.UInt32, self.slot, dr.select(active, lane, 0))
        asked, slot = (slot != _NONE) & active, slot + (self.count if end else 0)
        f = dr.gather(mi.Spectrum, self.shifted.f, slot, asked)
        J, geometry = (dr.gather(mi.Float, v, slot, asked) for v in (self.shifted.J, self.shifted.geometry))
        return Shifted(f, dr.select(asked, J, 1), geometry)

    def part(self, lane: mi.UInt32, active: bool | mi.Bool = True, end: int = 0) -> mi.Spectrum:
        """f |J|."""
        shifted = self.at(lane, active, end)
        return shifted.f * shifted.J


def evaluate_some(
    evaluate: Callable[[Record, mi.Point2f, mi.Bool], Shifted],
    pool: Record,
    lanes: int,
    ends: int,
    active: mi.Bool,
    request: Request,
) -> Requests:
    """E, computed by ``evaluate``, of records of the ``pool``, for the lanes whose request is ``active``."""
    slot = dr.full(mi.UInt32, _NONE, lanes)
    index = dr.compress(active)
    count = dr.width(index)
    if not count:
        none = dr.zeros(mi.Float, 1)
        return Requests(slot, mi.UInt32(0), Shifted(dr.zeros(mi.Spectrum, 1), none + 1, none))
    dr.scatter(slot, dr.arange(mi.UInt32, count), index)
    each = dr.opaque(mi.UInt32, count)
    number = dr.arange(mi.UInt32, count * ends)
    lane, end = dr.gather(mi.UInt32, index, number % each), number // each
    source, place, exists = request(lane, end)
    record = gather(pool, source, exists)
    shifted = evaluate(record, place, exists)
    dr.eval(slot, shifted)
    return Requests(slot, each, shifted)
