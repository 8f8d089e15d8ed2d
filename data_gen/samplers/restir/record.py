r"""A path in 80 bytes: all that is needed to find its counterpart in another pixel, or in its own again.

A path is a prefix, a vertex *rc* where copies of the path reconnect to it, and what comes behind. The prefix is not
stored but replayed: its random numbers belong to a pixel and a sample. rc is the first vertex that is joined to its
predecessor: a smooth event between two connectable vertices, see ``data_gen.samplers.restir.walk``. Each part has a
measure of its own, so that a shift has one Jacobian and not one at each vertex:

| part | measure | Jacobian of a shift |
|---|---|---|
| camera sample, prefix, choice of an emitter | the random numbers; f there is f / p | 1 |
| the step to rc | solid angle | the reconnection's Jacobian |
| the direction from rc on | solid angle at rc | 1 |
| behind it | the random numbers; f, and Russian roulette, are in ``L`` | 1 |

Russian roulette up to rc depends on the prefix's throughput, so it belongs to the density: to W, not to f.

Kinds of paths, by what ends them:

    LIGHT       a sampled emitter, before there is an rc: its numbers are replayed as well, whatever kind of lamp it is
    HIT         rc is on a lamp, or the environment
    RC_LIGHT    an emitter sampled at rc; one that no direction meets (a point) counts as SUFFIX without ``p_light``
    SUFFIX      anything behind the direction from rc on: ``behind`` vertices, and a lamp, at the last or sampled there
    REPLAY      a lamp, without an rc: mirrors and glass all along
    STUCK       it leaves rc by a Dirac delta or a hole: a path that comes from elsewhere cannot follow, so no other
                pixel has it, and ``evaluate`` gives 0

[Lin et al. 2022, "Generalized Resampled Importance Sampling": hybrid shifts]
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import drjit as dr
import mitsuba as mi

LIGHT, HIT, RC_LIGHT, SUFFIX, REPLAY, STUCK = range(6)

# Parts of a word, from its lowest bits on: kind, whether the lamp was sampled, vertices behind rc, replayed vertices
_KIND_BITS, _COUNT_BITS = 3, 14
_BEHIND, _REPLAYED = _KIND_BITS + 1, _KIND_BITS + 1 + _COUNT_BITS
# Vertices that a record can count. Russian roulette ends paths by then, for none survives a step for certain.
MOST_VERTICES = (1 << _COUNT_BITS) - 1


@dataclass
class Record:
    """A path that lives in the pixel of its ``place``. 20 words of 4 bytes, RGB variants only."""

    pixel: mi.UInt32  # whose numbers the path was sampled with; ``sample`` counts on over the frames of a shot
    sample: mi.UInt32
    place: mi.Point2f  # on the film, in pixels: where the path lives now, at first where its camera sample fell
    word: mi.UInt32  # kind, ``sampled``, ``behind``, and how many vertices are left by replay
    P: mi.Point3f  # rc, if it is on a surface
    shape: mi.ShapePtr  # there; none where rc is in the environment, and for paths without rc
    primitive: mi.UInt32
    uv: mi.Point2f  # of the primitive
    w: mi.Vector3f  # unit, the direction from rc on; toward rc if that is in the environment
    L: mi.Spectrum  # radiance that comes along ``w``, divided by the density of all that is behind; of RC_LIGHT Le / p
    p_light: mi.Float  # density with which the other technique finds the lamp from rc: 0 if it could not
    geometry: mi.Float  # |cos θ| / d² at rc, toward its predecessor: the part of the Jacobian that is this path's

    @property
    def kind(self) -> mi.UInt32:
        return self.word & ((1 << _KIND_BITS) - 1)

    @property
    def sampled(self) -> mi.Bool:
        """Whether the lamp was sampled: of what leaves rc along ``w``, from the last vertex behind it, or from rc."""
        return (self.word >> _KIND_BITS) & 1 == 1

    @property
    def behind(self) -> mi.UInt32:
        """Vertices after rc, the lamp's own among them if it was not sampled."""
        return (self.word >> _BEHIND) & MOST_VERTICES

    @property
    def replayed(self) -> mi.UInt32:
        return self.word >> _REPLAYED

    def hit(self, origin: mi.Point3f) -> tuple[mi.PreliminaryIntersection3f, mi.Ray3f]:
        """rc as what a ray from ``origin`` meets, and the ray."""
        to = self.P - origin
        distance = dr.norm(to)
        far = self.escapes()
        hit = dr.zeros(mi.PreliminaryIntersection3f, dr.width(self.pixel))
        # A mesh's vertex follows from ``uv``, a sphere's from the distance, which is each path's own.
        hit.t = dr.select(far, dr.inf, distance)
        hit.shape, hit.prim_index, hit.prim_uv = self.shape, self.primitive, self.uv
        hit.valid = ~far
        return hit, mi.Ray3f(origin, dr.select(far, self.w, to / distance))

    def escapes(self) -> mi.Bool:
        """Whether there is no surface at rc."""
        return self.shape == None  # noqa: E711 - a comparison of arrays of pointers

    def moved(self, place: mi.Point2f, geometry: mi.Float) -> Record:
        """The record's path elsewhere on the film, where ``evaluate`` has found its ``geometry``."""
        return replace(self, place=place, geometry=geometry)


def word_of(kind: mi.UInt32, replayed: mi.UInt32, behind: mi.UInt32, sampled: bool | mi.Bool) -> mi.UInt32:
    flag = dr.select(sampled, mi.UInt32(1 << _KIND_BITS), 0)
    return kind | flag | (behind << _BEHIND) | (replayed << _REPLAYED)


def geometry_of(normal: mi.Normal3f, at: mi.Point3f, origin: mi.Point3f) -> mi.Float:
    """|cos θ| / d² at a vertex with a geometric ``normal``: solid angle at ``origin`` for each unit of area."""
    to = origin - at
    squared = dr.squared_norm(to)
    return dr.abs(dr.dot(normal, to)) * dr.rsqrt(squared) / squared


def gather(record: Record, lanes: mi.UInt32, active: bool | mi.Bool = True) -> Record:
    """The records of these ``lanes``; zeros where not ``active``."""
    values = ((f.name, getattr(record, f.name)) for f in fields(Record))
    return Record(**{name: dr.gather(type(value), value, lanes, active) for name, value in values})


def empty(lanes: int) -> Record:
    types = (
        *(mi.UInt32, mi.UInt32, mi.Point2f, mi.UInt32, mi.Point3f, mi.ShapePtr),
        *(mi.UInt32, mi.Point2f, mi.Vector3f, mi.Spectrum, mi.Float, mi.Float),
    )
    return Record(*(dr.zeros(kind, lanes) for kind in types))
