"""Traces light paths again, up to a vertex that the camera sees, with the data that a shift needs.

The kernel that finds light paths only marks which vertices are seen. These are few and scattered over lanes and steps,
and a shift traces eight rays. So each seen vertex gets its own lane in a second kernel, which traces its path again.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from data_gen.film.splats import Splats
from data_gen.paths.eye import Sight
from data_gen.paths.light_ends import LightRay
from data_gen.paths.spectrum import to_rgb
from data_gen.paths.vertex import SMOOTH, event_kind
from data_gen.samplers.bdpt.light_path import End, Seen, begin, go_on
from data_gen.samplers.bdpt.plan import Plan
from data_gen.samplers.bdpt.vertex import record, record_class
from ngpt_studies.gbdpt.manifold import event, has_room
from ngpt_studies.gbdpt.pairs import weighted


@dataclass
class Marker:
    """Splats the light of connections to the camera. Its state has a bit for each vertex that the camera sees."""

    splats: Splats
    ray: mi.Ray3f
    importance: mi.Spectrum

    def start(self) -> mi.UInt64:
        return mi.UInt64(0)

    def light(self, seen: Seen) -> mi.Color3f:
        """The light that is splatted."""
        return to_rgb(weighted(seen.C, seen.others) * self.importance, self.ray.wavelengths)

    def sees(self, state: mi.UInt64, seen: Seen) -> mi.UInt64:
        lit = dr.max(seen.C) > 0
        self.splats.add(seen.pixel, list(self.light(seen)), lit)
        return state | dr.select(lit, mi.UInt64(1) << mi.UInt64(seen.y.depth), 0)


class Unseen:
    """A visitor for light paths whose connections to the camera are not needed."""

    def start(self) -> None:
        return None

    def sees(self, state: None, seen: Seen) -> None:
        return None


def marked(state: mi.UInt64, longest: int) -> tuple[mi.UInt32, mi.UInt32]:
    """The lane and depth of each marked vertex, ordered by depth, so that neighbours trace equally many edges."""
    lanes = [dr.compress((state >> mi.UInt64(depth)) & 1 != 0) for depth in range(1, longest)]
    depths = [dr.full(mi.UInt32, depth, dr.width(some)) for depth, some in enumerate(lanes, 1)]
    found = [(some, depth) for some, depth in zip(lanes, depths, strict=True) if dr.width(some)]
    if not found:
        return mi.UInt32(), mi.UInt32()
    return dr.concat([some for some, _ in found]), dr.concat([depth for _, depth in found])


@dataclass
class Link:
    """The part of a light path between its last vertex and the last vertex before it with a smooth event."""

    depth: mi.UInt32  # of the vertex with the smooth event; 0 is the emitter
    p: mi.Float  # density with which the path left that vertex
    survival: mi.Float  # 1 / probability to survive Russian roulette and to pass the holes after that vertex
    events: mi.UInt32  # mirrors and glass between the two, of ``manifold``, the last one first
    whole: mi.Bool  # whether ``events`` holds all of them, and the link does not have both events and holes
    holes: mi.UInt32  # the number of holes between the two


def first_link() -> Link:
    """The link of the first vertex after the emitter."""
    return Link(mi.UInt32(0), mi.Float(1), mi.Float(1), mi.UInt32(0), mi.Bool(True), mi.UInt32(0))


def next_link(
    link: Link, depth: mi.UInt32, sample: mi.BSDFSample3f, survival: mi.Float, passed: mi.Bool | bool = False
) -> Link:
    """The link of the next vertex, after the event that was sampled at ``depth``, or that has ``passed`` a hole."""
    if passed is not False:
        whole = link.whole & (link.events == 0)
        survived = link.survival * survival / sample.pdf
        through = Link(link.depth, link.p, survived, link.events, whole, link.holes + 1)
        return dr.select(passed, through, next_link(link, depth, sample, survival))
    smooth = event_kind(sample.sampled_type) == SMOOTH
    code = event(sample.sampled_type)
    # One more event in front
    events, fits = (link.events << 2) | code, has_room(link.events)
    return Link(
        dr.select(smooth, depth, link.depth),
        dr.select(smooth, sample.pdf, link.p),
        dr.select(smooth, 1, link.survival) * survival,
        dr.select(smooth, 0, dr.select(fits, events, link.events)),
        smooth | (link.whole & fits & (code != 0) & (link.holes == 0)),
        dr.select(smooth, 0, link.holes),
    )


@dataclass
class Again:
    """A light path up to a vertex, traced once more."""

    start: LightRay
    end: End  # the vertex, and the ray that led there
    link: Link
    left: Any  # the record of the vertex at the other end of the link
    lens: mi.Point2f  # the place on the lens to which the vertex is connected
    there: mi.Bool  # whether the path reaches that vertex


@dr.syntax
def light_again(plan: Plan, sight: Sight, depth: mi.UInt32) -> Again:
    """Traces light paths up to the vertex at ``depth``, with the same random numbers as in ``light_path``."""
    eye, random = sight.eye, sight.random.clone()
    start, end, active = begin(plan, random, sight.ray)
    link, left = first_link(), dr.zeros(record_class(mi.variant()))
    while dr.hint(active & (end.y.depth < depth), label="light path again"):
        bsdf = end.y.si.bsdf()
        depth_here = end.y.depth
        here = record(end.ray, end.hit, replace(end.y, end=plan.known(end.y.end, bsdf)), active)
        # Draws the random numbers that ``light_path`` drew for the connection to the camera
        eye.place_on_lens(random)
        end, active, sample, survival = go_on(plan, random, start, end.y, bsdf, active)
        passed = plan.holes.passed(bsdf, event_kind(sample.sampled_type)) if plan.holes else False
        link = next_link(link, depth_here, sample, survival, passed)
        left = dr.select(link.depth == depth_here, here, left)
    on_lens = eye.place_on_lens(random)
    end.y.end = plan.known(end.y.end, end.y.si.bsdf())
    return Again(start, end, link, left, on_lens, active)
