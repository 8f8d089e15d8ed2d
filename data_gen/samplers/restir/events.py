"""What a path does at a vertex, whether it is sampled for the first time or replayed."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from data_gen.paths.vertex import DELTA, SMOOTH, event_kind
from data_gen.samplers.gpt.plan import Plan

# Random numbers of a vertex, in total
DRAWN = 6


@dataclass
class Numbers:
    """Random numbers of a vertex: drawn whether used or not, so that a replay finds its own."""

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
    joined: mi.Bool  # x1 is where copies of the path reconnect, if none before it is


def sample_event(scene: mi.Scene, plan: Plan, x: mi.SurfaceInteraction3f, numbers: Numbers, active: mi.Bool) -> Event:
    """The event of these random ``numbers``, and where it leads: the same for the same vertex."""
    bsdf = x.bsdf()
    sample, f_p = bsdf.sample(mi.BSDFContext(), x, numbers.lobe, numbers.direction, active)
    found = active & (sample.pdf > 0) & (dr.max(f_p) > 0)
    kind = dr.select(found, event_kind(sample.sampled_type), DELTA)
    ray = x.spawn_ray(x.to_world(sample.wo))
    hit = scene.ray_intersect_preliminary(ray, active=found)
    x1 = hit.compute_surface_interaction(ray)
    rough = ~x1.is_valid() | plan.materials.connectable(x1.bsdf())
    # Both vertices, so that a path and its copy agree on where to reconnect. A record has no room for the instance that
    # a shape is part of: such vertices are replayed.
    joined = (kind == SMOOTH) & plan.materials.connectable(bsdf) & rough
    joined &= hit.instance == None  # noqa: E711 - a comparison of arrays of pointers
    return Event(found, kind, sample.wo, sample.pdf, sample.eta, dr.select(found, f_p, 0), ray, hit, x1, joined)
