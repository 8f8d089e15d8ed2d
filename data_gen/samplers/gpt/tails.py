"""Paths of ``gpt`` and ``primal`` that end in the cache (``data_gen.tails``), and those that feed it.

A path may end at its second vertex or a later one. Three conditions must hold: the material has a diffuse part, or the
vertex is in a medium that scatters evenly enough; the path's spread is large; and the cell is trusted. A path of
``gpt`` ends only where all offset paths have joined it. The cache then supplies the light that a matt surface, or an
even phase function, would scatter toward the path (``data_gen.tails.matt``):

    ρ C,

the vertex's ρ times the mean light of the cell. An offset path adds a ρ C to its difference, with the factor ``a`` that
it would have had for all that follows (``offset_path.settle``). If the vertex scatters in no other way, the path is
over. Otherwise it goes on for the rest. The step before has already found the emission at the vertex itself, with its
usual MIS weight.

If there is the layer ``caustic``, the cache stores the light of that layer separately: light that has passed a sharp
surface behind the vertex (``data_gen.paths.caustic``). It goes into the layer and into no difference.

A path that feeds the cache opens a record at its first vertex that meets the first two conditions, and at later ones,
at most ``RECORDS``. From the second such vertex on it may end in the cache itself, in its own half of the records. So
light of many bounces builds up. A record holds the light that arrives. Therefore the path leaves the vertex as if it
were matt and white, even where the texture is black. [Müller et al. 2021, "Real-time neural radiance caching for path
tracing", section 4]
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
# If the depth of paths is limited, cells are separated by the number of bounces that are left, where it is below this.
_ALL = 16


def place(plan: Plan, known: Known, path: Path) -> tuple[CellPlace, mi.Bool]:
    """Returns the path's place in the cache, and whether it may end there or open a record."""
    x, trail = path.x, path.trail
    able = path.walks & x.is_valid() & (path.depth < plan.limits.max_depth) & (trail.spread > NEAR * trail.reach)
    able = plan.matt.at(x, path.place, able)
    if plan.replays:
        # At other vertices all light is late, even the light that a diffuse part scatters.
        able &= plan.materials.connectable(x.bsdf()) | media.scatters(path.place)
    most = plan.limits.max_depth
    late = mi.UInt32(0) if most == UNLIMITED else path.depth - dr.minimum(path.depth, max(most - _ALL, 0))
    return known.place_of(x, media.scatters(path.place), trail.spread, late), able


def end(plan: Plan, known: Known, path: Path, offsets: list) -> tuple[Path, mi.Spectrum, mi.Spectrum, mi.Spectrum]:
    """Ends paths where the cache knows the light that follows.

    Returns the paths, that light without the layer ``caustic``, that light of the layer, and a sample of the error of
    both (``data_gen.tails.cache``). The differences of the ``offsets`` get their part of the light that is not of the
    layer.
    """
    where, able = place(plan, known, path)
    lambertian = plan.matt.lambertian(path.x, path.place, able)
    for y in offsets:
        # A joined path has come from elsewhere, so the material scatters another rest for it than for the base path.
        able &= ~(y.apart | (y.joined & ~lambertian))
    sorts, errors, ends = known.look(where, LEAST, able)
    ρ = plan.matt.reflectance(path.x, path.place, ends)
    found, *late = [ρ * C for C in sorts]
    found, caustic_found = caustic.split(path.late, found)
    caustic_found = sum(late, caustic_found)
    for y in offsets:
        # For a joined path: the factor with which it would settle at this vertex, which scatters evenly
        joined = gradient_weight(y.r, True) * (y.β - path.β)
        y.Δ = y.Δ + dr.select(y.joined, joined, y.a) * found
    path.walks = path.walks & ~(ends & lambertian)
    path.ρ = ρ
    # A path that could have ended here but goes on has a new spread from here, as after a record of a path that feeds
    # the cache.
    path.trail.spread = dr.select(able & ~ends, 0, path.trail.spread)
    return path, path.β * found, path.β * caustic_found, path.β * ρ * sum(errors)


@dataclass
class Record:
    """A vertex of a path that feeds the cache, and the light of each sort that the path has found to arrive there."""

    place: CellPlace
    T: mi.Spectrum  # throughput from there on
    late: mi.Bool  # what follows belongs to the layer ``caustic``
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
    # Light is late relative to each record here, and not relative to the camera.
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
            # A record at the step's vertex is the newest one. There light is scattered as by a matt white surface.
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
        # The first vertex where paths may end has a record in any case.
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
