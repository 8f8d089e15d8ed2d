"""Paths of ``gpt`` and ``primal`` that end in the cache (``data_gen.tails``), and those that feed it.

A path may end at the first vertex from the second on where the material is matt, the path's spread is large, and the
cell is trusted; of ``gpt``, where no offset path is apart any more. What it would have found behind the vertex is then

    ρ C,

the vertex's reflectance times the light over reflectance of the cell; an offset path adds a ρ C to its difference, with
the factor ``a`` that it would have had for all that follows (``offset_path.settle``). Emission at the vertex itself is
found by the step before, and weighted as ever.

Where there is the layer ``caustic``, the cache keeps the light apart that belongs to it from the vertex on, because it
has come over a sharp surface behind it (``data_gen.paths.caustic``). It goes into the layer and into no difference.

A path that feeds the cache opens a record at its first such vertex, and at those behind it, as many as there is room
for; from the second on it may end in the cache itself. So light of many bounces comes together one by one. [Müller et
al. 2021, "Real-time neural radiance caching for path tracing", section 4]
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from data_gen.paths import caustic, media
from data_gen.paths.mis import gradient_weight
from data_gen.paths.walk import UNLIMITED
from data_gen.samplers.gpt.base_path import Path, base_step, begin
from data_gen.samplers.gpt.plan import Plan
from data_gen.tails.cache import NEAR, Known, Place, Trail, place_of

# Records that a path may have
RECORDS = 3
# Light of so many more bounces is all there is: cells of shorter paths are kept apart by how many are left.
_ALL = 16


def place(plan: Plan, known: Known, path: Path) -> tuple[Place, mi.Bool, mi.Bool]:
    """Where a path is in the cache, whether it may end there, or open a record, and whether gloss counts there."""
    x, trail = path.x, path.trail
    able = path.walks & x.is_valid() & (path.depth < plan.limits.max_depth) & (trail.spread > NEAR * trail.reach)
    able, gloss = plan.matt.at(x, known.fineness, able)
    most = plan.limits.max_depth
    late = mi.UInt32(0) if most == UNLIMITED else path.depth - dr.minimum(path.depth, max(most - _ALL, 0))
    return place_of(x, trail.spread, known.fineness, late, gloss), able, gloss


def end(plan: Plan, known: Known, path: Path, offsets: list) -> tuple[Path, mi.Spectrum, mi.Spectrum]:
    """Ends paths where the cache knows what follows; returns them, and that, in the layer ``caustic`` or not.

    Differences get theirs, but for what is in that layer.
    """
    where, able, gloss = place(plan, known, path)
    for y in offsets:
        # A joined path sees the vertex from elsewhere, where gloss has other light.
        able &= ~(y.apart | (y.joined & gloss))
    sorts, ends = known.look(where, able)
    ρ = plan.matt.reflectance(path.x, ends)
    found, *late = [dr.select(ends, ρ * C, 0) for C in sorts]
    found, caustic_found = caustic.split(path.late, found)
    caustic_found = sum(late, caustic_found)
    for y in offsets:
        # For a joined path: what it would settle with at this vertex, which scatters alike in all directions
        joined = gradient_weight(y.r, True) * (y.β - path.β)
        y.Δ = y.Δ + dr.select(y.joined, joined, y.a) * found
    path.walks = path.walks & ~ends
    return path, path.β * found, path.β * caustic_found


@dataclass
class Record:
    """A vertex where a path has come by, and what it has found from there on: light of each sort."""

    place: Place
    ρ: mi.Color3f
    T: mi.Spectrum  # throughput from there on
    late: mi.Bool  # what follows belongs to the layer ``caustic``
    L: list[mi.Spectrum]

    def find(self, light: mi.Spectrum, late: mi.Bool) -> None:
        parts = caustic.split(late, self.T * light) if len(self.L) > 1 else (self.T * light,)
        self.L = [L + part for L, part in zip(self.L, parts, strict=True)]


def feed(view, plan: Plan, known: Known, random, camera_ray: tuple) -> tuple[mi.UInt32, list[Record]]:
    """Paths that feed the cache, from a camera ray and its importance: how many records each has, and these."""
    (ray, importance), space, scene = camera_ray, plan.space, plan.space.scene
    first = space.first(view, ray, None, space.begin(random))
    x = media.vertex(mi.Ray3f(first.ray), first.hit, first.place)
    path = begin(plan, x, first.place, None, importance * first.weight)
    path.trail, lanes = Trail.to(x), dr.width(x.t)
    blank = Place(dr.zeros(mi.Point3f, lanes), mi.UInt32(0), mi.Int32(0))
    dark = [dr.zeros(mi.Spectrum, lanes) for _ in known.values]
    none = [Record(blank, mi.Color3f(1), mi.Spectrum(0), mi.Bool(False), list(dark)) for _ in range(RECORDS)]
    # What is late is not so from the camera on, but from each record on.
    whole = replace(plan, caustic=False)
    with dr.scoped_set_flag(dr.JitFlag.OptimizeLoops, False):
        return walk(scene, whole, known, random, path, none)


@dr.syntax
def walk(scene, plan: Plan, known: Known, random, path: Path, records: list) -> tuple:
    count, active = mi.UInt32(0), path.goes_on(plan, [])
    while dr.hint(active, label="feed", exclude=[known]):
        step, path = base_step(scene, plan, random, path, [])
        rough = mi.Bool(True)
        for r in records:
            # A record is at a matt vertex, so its path has been rough since.
            r.find(step.L_light, caustic.lit_late(rough, r.late, step.x_connectable))
            _, r.late = caustic.classes(rough, r.late, step.goes_on, step.kind, step.x_connectable)
            r.find(step.f_p * step.L_bsdf, r.late)
            r.T = r.T * step.f_p
        where, able, _ = place(plan, known, path)
        sorts, ends = known.look(where, able)
        ρ = plan.matt.reflectance(path.x, able)
        # The first vertex is where others will end: it has a record in any case.
        ends &= count > 0
        opens = able & ~ends & (count < RECORDS)
        for i in range(RECORDS):
            r, this = records[i], opens & (count == i)
            for C, late in zip(sorts, (r.late, mi.Bool(True)), strict=False):
                r.find(dr.select(ends, ρ * C, 0), late)
            r.late = r.late & ~this
            r.T = dr.select(this, 1, r.T)
            r.ρ = dr.select(this, ρ, r.ρ)
            r.place = dr.select(this, where, r.place)
        count = dr.select(opens, count + 1, count)
        path.trail.spread = dr.select(opens, 0, path.trail.spread)
        active = path.goes_on(plan, []) & ~ends
    return count, records
