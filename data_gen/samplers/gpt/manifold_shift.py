"""The shift "manifold": light that comes to the first rough vertex through mirrors and glass, in a kernel of its own.

Replay loses such light: from beside z_b, the same direction does not lead to the same small lamp. Here the offset path
goes through the same events to the same point x_c of the lamp, by the walks of ``data_gen.paths.manifold``.

    z_b, z_b'   the first vertices that the paths leave by a smooth event, after equally many specular events
    ω, ω'       directions there; after k further specular events, k = 1 .. 6, both paths meet the lamp at x_c
    F           product of the reflectances of the k events; P: product of the probabilities to take them
    b, b'       f(x) / p(x) and f(y) |J| / p(x); p, p' densities of ω at z_b, ω' at z_b'
    r           p' P' J / (p P)
    Δ           2 (b' - b) / (1 + r), or -2 b where no walk leads there and back

Up to z_b' the offset path replays the base path's random numbers, with r = 1. Only BSDF sampling finds this light,
since emitter sampling finds no lamp behind glass. These paths are a class of their own, so they are shifted separately
from all other light. The kernel of ``gpt`` leaves one record in each lane that has found such a path. Such paths are
rare, so a second kernel runs only for lanes with a record. It has four lanes for each record, one for each offset path.

[Hua et al. 2019, sections 3.4 and 3.5]
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from data_gen.paths.camera import CameraSamples, in_packets
from data_gen.paths.manifold import MAX_EVENTS, Target, add_event, event, follow, shoot
from data_gen.paths.mis import gradient_weight
from data_gen.paths.spectrum import to_rgb
from data_gen.paths.vertex import SMOOTH, evaluate, event_kind, seen_from
from data_gen.samplers.gpt.plan import Plan

# States of a chain, in its highest bits: no rough vertex so far; a rough vertex, with the events after it in the lower
# bits; a chain that is not followed.
_BEFORE, _OPEN, _LOST = 0, 1 << 31, 1 << 30
_EVENT_BITS = 2 * MAX_EVENTS
_EVENTS = (1 << _EVENT_BITS) - 1


@dataclass
class Chain:
    """What a base path remembers of its earlier vertices.

    ``record``    number of steps before z_b and, in the lowest bits, the events after it; 0 if no lamp is found there
    ``survival``  product of the factors of Russian roulette, up to that lamp
    """

    state: mi.UInt32
    record: mi.UInt32
    survival: mi.Float

    def end(self, depth, survival, late, x1, Le) -> tuple[Chain, mi.Bool]:
        """The chain after the ``depth``-th vertex, with a record if it ends at ``x1``, and whether it ends there.

        It ends where it finds ``Le``. Only ``late`` light is followed: replay is as good for a lamp behind panes only.
        """
        # A lane has room for one record. From a lamp that is also a mirror, the path could go on to another lamp.
        sharp = mi.has_flag(x1.bsdf().flags(), mi.BSDFFlags.Delta) | mi.has_flag(x1.bsdf().flags(), mi.BSDFFlags.Null)
        ends = late & (self.state > _OPEN) & ~(x1.is_valid() & sharp) & (dr.max(Le) > 0)
        events = self.state & _EVENTS
        k = (33 - dr.lzcnt(events)) >> 1
        record = dr.select(ends, ((depth - 1 - k) << _EVENT_BITS) | events, self.record)
        # Roulette after the record does not belong to it.
        return Chain(self.state, record, dr.select(self.record == 0, self.survival * survival, self.survival)), ends


def no_chain(lanes: int) -> Chain:
    """The chains of paths at their first vertices."""
    return Chain(dr.zeros(mi.UInt32, lanes), dr.zeros(mi.UInt32, lanes), dr.full(mi.Float, 1, lanes))


def advance(chain: Chain, sampled_type, goes_on, connectable) -> Chain:
    """The chain after an event at a vertex that is ``connectable`` or not."""
    code = event(sampled_type)
    before, open_ = chain.state == _BEFORE, chain.state >= _OPEN
    longer, fits = add_event(chain.state & _EVENTS, code)
    state = dr.select(before & (code == 0) & connectable, mi.UInt32(_OPEN), _LOST)
    state = dr.select(before & (code != 0), _BEFORE, state)
    state = dr.select(open_ & (code != 0) & fits, longer | _OPEN, state)
    return Chain(dr.select(goes_on, state, _LOST), chain.record, chain.survival)


@dataclass
class Recorded:
    """The record of each lane, and the offset path that the lane shifts."""

    shift: mi.Vector2f  # of the offset path, in pixels
    word: mi.UInt32  # the ``record`` of ``Chain``
    survival: mi.Float
    exists: mi.Bool  # False in lanes that only fill up a packet


def add_followed(plan: Plan, first_hit, camera: CameraSamples, shifts, chain: Chain, Δ: list) -> list:
    """``Δ``, colours of all lanes for each of the ``shifts``, with the samples of all recorded paths added.

    ``first_hit`` (ray) is the first intersection of a camera ray. All arguments are evaluated.
    """
    lanes, exists = in_packets(np.array(dr.compress(chain.record != 0)), camera)
    if not len(lanes):
        return Δ
    # One lane for each offset path, so that all offset paths of a base path are in one packet
    n = len(shifts)
    wide, found = mi.UInt32(np.repeat(lanes, n)), mi.Bool(np.repeat(exists, n))
    number = dr.arange(mi.UInt32, n * len(lanes)) % n
    shift = dr.gather(mi.Vector2f, mi.Vector2f(*np.array(shifts, np.float32).T), number)
    word, survival = dr.gather(mi.UInt32, chain.record, wide), dr.gather(mi.Float, chain.survival, wide)
    samples = followed(plan, first_hit, camera.at(wide), Recorded(shift, word, survival, found))
    dr.eval(samples)
    first = dr.arange(mi.UInt32, len(lanes)) * n
    return [
        with_samples(total, samples, first + dr.opaque(mi.UInt32, i), mi.UInt32(lanes), mi.Bool(exists))
        for i, total in enumerate(Δ)
    ]


def with_samples(total: mi.Color3f, samples: mi.Color3f, which: mi.UInt32, lanes, exists) -> mi.Color3f:
    """``total`` with those ``samples`` added to ``lanes`` of it."""
    own = dr.gather(mi.Color3f, samples, which)
    channels = [mi.Float(channel) for channel in total]
    for channel, value in zip(channels, own, strict=True):
        dr.scatter_add(channel, value, lanes, exists)
    return mi.Color3f(*channels)


def followed(plan: Plan, first_hit, camera: CameraSamples, recorded: Recorded) -> mi.Color3f:
    """Δ of the light that each lane has ``recorded``."""
    # -------------------- To z_b and to z_b' ---------------------
    scene, survival, active = plan.space.scene, recorded.survival, recorded.exists
    events, steps = recorded.word & _EVENTS, recorded.word >> _EVENT_BITS
    camera_ray, importance, _ = camera.rays()
    ray1, importance1, inside = camera.rays(recorded.shift)
    random, random1 = camera.random.clone(), camera.random.clone()
    z, β, active = specular_steps(scene, first_vertex(first_hit, camera_ray), importance, random, steps, active)
    z1, β1, exists = specular_steps(scene, first_vertex(first_hit, ray1), importance1, random1, steps, active & inside)

    # ----------------------- The base path -----------------------
    _, u_lobe, u_direction, _ = draw(random)
    sample, f_p = z.bsdf().sample(mi.BSDFContext(), z, u_lobe, u_direction, active)
    active &= (sample.pdf > 0) & (event_kind(sample.sampled_type) == SMOOTH)
    ω = z.to_world(sample.wo)
    ray = shoot(scene, z, ω, events, Target(z.p, mi.Vector3f(ω), mi.Bool(True)), active).ray
    x_c = scene.ray_intersect(ray, active)
    target = Target(x_c.p, dr.select(x_c.is_valid(), mi.Vector3f(x_c.n), ray.d), ~x_c.is_valid())
    base = shoot(scene, z, ω, events, target, active)
    emitter = x_c.emitter(scene)
    b = β * f_p * base.weight * survival * emitter.eval(x_c, active)

    # ---------------------- The offset path ----------------------
    ω1, shot, J, exists = follow(scene, z, ω, base, z1, events, target=target, active=exists & active)
    f1, p1 = evaluate(z1.bsdf(), z1, z1.to_local(ω1), exists)
    J *= shot.P / (sample.pdf * base.P)
    b1 = β1 * f1 * shot.weight * (J * survival) * emitter.eval(seen_from(x_c, shot.ray.d), exists)
    r = p1 * J
    # The reverse shift begins at z_b', which must be connectable as well.
    exists &= plan.materials.connectable(z1.bsdf()) & (p1 > 0) & dr.isfinite(r) & dr.isfinite(dr.sum(b1))
    Δ = gradient_weight(r, exists) * (dr.select(exists, b1, 0) - b)
    return to_rgb(dr.select(active & dr.isfinite(dr.sum(b)), Δ, 0), camera_ray.wavelengths)


def draw(random) -> tuple:
    """The random numbers of one step, in the order of ``base_step()``."""
    return random.next_2d(), random.next_1d(), random.next_2d(), random.next_1d()


def first_vertex(first_hit, ray) -> mi.SurfaceInteraction3f:
    return first_hit(ray).compute_surface_interaction(mi.Ray3f(ray))


@dr.syntax
def specular_steps(scene, z, β, random, steps, active) -> tuple:
    """The vertex that a replay reaches ``steps`` events behind ``z``, its throughput, and whether it gets there."""
    z, β = mi.SurfaceInteraction3f(z), mi.Spectrum(β)
    good, i = active & z.is_valid(), mi.UInt32(0)
    while dr.hint(good & (i < steps), label="specular steps"):
        _, u_lobe, u_direction, _ = draw(random)
        sample, f_p = z.bsdf().sample(mi.BSDFContext(), z, u_lobe, u_direction, good)
        good &= (sample.pdf > 0) & (event(sample.sampled_type) != 0)
        β *= f_p
        z = scene.ray_intersect(z.spawn_ray(z.to_world(sample.wo)), good)
        good &= z.is_valid()
        i += 1
    return z, β, good
