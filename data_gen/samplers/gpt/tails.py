"""Paths of ``gpt`` and ``primal`` that end in the cache of light (``data_gen.tails``), and paths that feed it.

A path may end at its second vertex or a later one, under three conditions:

1. The material has a diffuse part, or the vertex is in a medium that scatters evenly enough.
2. The path's spread is large. The spread is the width of the bundle of similar paths (``data_gen.tails.cache``).
3. The cell of the cache is trusted: it has enough records.

A path of ``gpt`` ends only where all offset paths have joined it. The cache then supplies the light ρ C that a matt
surface, or an even phase function, would scatter toward the path (``data_gen.tails.matt``). C is the mean light of the
cell, and ρ is the share of it that the vertex scatters. An offset path adds a ρ C to its difference, where ``a`` is its
factor for all later light (``offset_path.settle``). If the vertex scatters in no other way, the path is over. Otherwise
the path goes on, to find the rest of the scattered light. ρ C does not contain the emission of the vertex itself: the
step before has already found it, with its usual MIS weight.

If there is a layer ``caustic``, the cache stores the light of this layer separately: light that has passed a sharp
surface behind the vertex (``data_gen.paths.caustic``). This light goes into the layer, and into no difference.

A path that feeds the cache opens a record at its first vertex that meets conditions 1 and 2. It may open more at later
such vertices, up to ``RECORDS`` in all. From the second such vertex on, the path itself may end in the cache, where it
reads only its own half of the records. So the cache collects light of many bounces. A record holds the light that
arrives. Therefore the path leaves the vertex as if it were matt and white, even where the texture is black. [Müller et
al. 2021, "Real-time neural radiance caching for path tracing", section 4]
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from data_gen.paths import caustic, media
from data_gen.paths.mis import gradient_weight
from data_gen.paths.walk import UNLIMITED
from data_gen.samplers.gpt.base_path import Path, Recording, base_step, begin
from data_gen.samplers.gpt.plan import Plan
from data_gen.tails.cache import LEAST, LEAST_TO_FEED, NEAR, RENEW, Known, Trail
from data_gen.tails.table import CellPlace

# The most records that a path may have
RECORDS = 3
# If the depth of paths is limited, and fewer than this number of bounces are left, each number of bounces that are left
# has its own cells.
_ALL = 16


def place(plan: Plan, known: Known, path: Path) -> tuple[CellPlace, mi.Bool]:
    """Returns the path's place in the cache, and whether it may end there or open a record."""
    x, trail = path.x, path.trail
    able = path.walks & x.is_valid() & (path.depth < plan.limits.max_depth) & (trail.spread > NEAR * trail.reach)
    able = plan.matt.at(x, path.place, able)
    if plan.replays:
        # At vertices that are not connectable all light is late (it belongs to the layer ``caustic``), even the light
        # that a diffuse part scatters.
        able &= plan.materials.connectable(x.bsdf()) | media.scatters(path.place)
    most = plan.limits.max_depth
    late = mi.UInt32(0) if most == UNLIMITED else path.depth - dr.minimum(path.depth, max(most - _ALL, 0))
    return known.place_of(x, media.scatters(path.place), trail.spread, late), able


def end(plan: Plan, known: Known, path: Path, offsets: list) -> tuple[Path, mi.Spectrum, mi.Spectrum, mi.Spectrum]:
    """Ends paths where the cache knows the light that follows.

    Returns four values: the paths, the cache's light outside the layer ``caustic``, the cache's light of this layer,
    and a sample of the error of both lights (``data_gen.tails.cache``). The light outside the layer is also added to
    the differences of the ``offsets``.
    """
    where, able = place(plan, known, path)
    lambertian = plan.matt.lambertian(path.x, path.place, able)
    for y in offsets:
        # A joined offset path has come from another direction than the base path. So the rest of the scattered light
        # differs between the two paths, except at Lambertian materials, where the rest is 0.
        able &= ~(y.apart | (y.joined & ~lambertian))
    sorts, errors, ends = known.look(where, LEAST, able)
    ρ = plan.matt.reflectance(path.x, path.place, ends)
    found, *late = [ρ * C for C in sorts]
    found, caustic_found = caustic.split(path.late, found)
    caustic_found = sum(late, caustic_found)
    for y in offsets:
        # For a joined path, this is the factor a with which it would settle at this vertex, which scatters evenly.
        joined = gradient_weight(y.r, True) * (y.β - path.β)
        y.Δ = y.Δ + dr.select(y.joined, joined, y.a) * found
    path.walks = path.walks & ~(ends & lambertian)
    path.ρ = ρ
    # If a path was able to end here, but the cache did not know the light, its spread starts again from 0. A path that
    # feeds the cache does the same after each record.
    path.trail.spread = dr.select(able & ~ends, 0, path.trail.spread)
    return path, path.β * found, path.β * caustic_found, path.β * ρ * sum(errors)


@dataclass
class Record:
    """A vertex of a path that feeds the cache, and the light of each sort that the path has found to arrive there."""

    place: CellPlace
    T: mi.Spectrum  # throughput from the record's vertex on
    late: mi.Bool  # whether later light belongs to the layer ``caustic``
    E: list[mi.Spectrum]

    def find(self, light: mi.Spectrum, late: mi.Bool) -> None:
        """Adds light that the path has found, to the sort that it belongs to."""
        parts = caustic.split(late, light) if len(self.E) > 1 else (light,)
        self.E = [E + part for E, part in zip(self.E, parts, strict=True)]


def feed(view, plan: Plan, known: Known, random, camera_ray: tuple, half: mi.UInt32) -> tuple[mi.UInt32, list[Record]]:
    """Traces paths that feed a ``half`` of the cache. Returns the number of records of each path, and the records.

    ``camera_ray`` is a camera ray, its importance, and the medium around the camera.
    """
    (ray, importance, within), space = camera_ray, plan.space
    drawn = space.begin(random)
    first = space.first(view, ray, within, drawn)
    x = media.vertex(mi.Ray3f(first.ray), first.hit, first.place)
    path = begin(plan, x, first.place, drawn.channel if drawn else None, importance * first.weight)
    path.trail, path.ρ, lanes = Trail.to(space.length(ray.o, x)), mi.Color3f(0), dr.width(x.t)
    blank = CellPlace(dr.zeros(mi.Point3f, lanes), mi.UInt32(0), mi.Int32(0))
    dark = [dr.zeros(mi.Spectrum, lanes) for _ in known.means]
    none = [Record(blank, mi.Spectrum(0), mi.Bool(False), list(dark)) for _ in range(RECORDS)]
    # ``base_step`` must not split off the layer ``caustic``, because here each record decides for itself which light is
    # late: the way from the camera to the record does not count.
    whole = replace(plan, caustic=False)
    with dr.scoped_set_flag(dr.JitFlag.OptimizeLoops, False):
        return walk(whole, known, random, path, none, half)


@dr.syntax
def walk(plan: Plan, known: Known, random, path: Path, records: list, half: mi.UInt32) -> tuple:
    scene = plan.space.scene
    count, fresh, active = mi.UInt32(0), dr.full(mi.Bool, False, dr.width(half)), path.goes_on(plan, [])
    while dr.hint(active, label="feed", exclude=[known]):
        step, path = base_step(scene, plan, random, path, [], Recording(count > 0, fresh))
        rough = mi.Bool(True)
        for i in range(RECORDS):
            # A record at the step's vertex is always the newest one. This vertex scatters as a matt white surface.
            r, here = records[i], fresh & (count == i + 1)
            r.find(
                dr.select(here, step.E_light, r.T * step.L_light), caustic.lit_late(rough, r.late, step.x_connectable)
            )
            # A record is at a vertex that scatters widely, so the path has been rough since then.
            _, r.late = caustic.classes(rough, r.late, step.goes_on, step.kind, step.x_connectable)
            r.T = dr.select(here, step.E_p * step.segment.weight, r.T * step.f_p)
            r.find(r.T * step.L_bsdf, r.late)
        where, able = place(plan, known, path)
        sorts, _, ends = known.look(where, LEAST_TO_FEED, able, half)
        # At the first vertex where paths may end, the path always goes on and opens a record.
        ends &= (count > 0) & ((count == RECORDS) | (random.next_1d() >= RENEW))
        ρ = plan.matt.reflectance(path.x, path.place, ends)
        fresh = able & ~ends & (count < RECORDS)
        for i in range(RECORDS):
            r, this = records[i], fresh & (count == i)
            for C, late in zip(sorts, (r.late, mi.Bool(True)), strict=False):
                r.find(dr.select(ends, r.T * ρ * C, 0), late)
            r.late = r.late & ~this
            r.place = dr.select(this, where, r.place)
        count = dr.select(fresh, count + 1, count)
        path.trail.spread = dr.select(fresh, 0, path.trail.spread)
        # The throughput since the newest record decides which paths survive.
        path.β = dr.select(fresh, 1, path.β)
        path.ρ = ρ
        path.walks = path.walks & ~(ends & plan.matt.lambertian(path.x, path.place, ends))
        active = path.goes_on(plan, [])
    return count, records
