r"""A path in 80 bytes, which are enough to evaluate it again, in its own pixel or in another one.

A path is a prefix, a vertex *rc* where copies of the path reconnect to it, and a rest. The prefix is not stored but
replayed: its random numbers belong to a pixel and a sample. rc is the first vertex that is joined to the vertex before
it, that is, by a smooth event between two connectable vertices, see ``ngpt_studies.restir.walk``. Each part has
its own measure, so that a shift has one Jacobian and not one at each vertex:

| part | measure | Jacobian of a shift |
|---|---|---|
| camera sample, prefix, choice of an emitter | the random numbers; f there is f / p | 1 |
| the step to rc | solid angle | the Jacobian of the reconnection |
| the direction from rc | solid angle at rc | 1 |
| the rest | the random numbers; f / p and Russian roulette are in ``L`` | 1 |

Russian roulette up to rc depends on the throughput of the prefix. So it belongs to the density: it is in W, not in f.

Kinds of paths, by what ends them:

    LIGHT       an emitter sampled before there is an rc; its random numbers are replayed, too, for any kind of lamp
    HIT         rc is on a lamp, or the environment
    RC_LIGHT    an emitter sampled at rc; if it has a Dirac delta (a point), the kind is SUFFIX without ``p_light``
    SUFFIX      ``behind`` vertices after rc, and a lamp at the last of them or sampled there
    REPLAY      a lamp without an rc: only mirrors and glass on the way
    STUCK       the path leaves rc by a Dirac delta or a hole. A copy arrives from another direction and cannot
                follow, so no other pixel has the path, and ``evaluate`` gives 0

[Lin et al. 2022, "Generalized Resampled Importance Sampling": hybrid shifts]
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import drjit as dr
import mitsuba as mi

LIGHT, HIT, RC_LIGHT, SUFFIX, REPLAY, STUCK = range(6)

# Parts of a word, from the lowest bits: kind, whether the lamp was sampled, vertices behind rc, replayed vertices
_KIND_BITS, _COUNT_BITS = 3, 14
_BEHIND, _REPLAYED = _KIND_BITS + 1, _KIND_BITS + 1 + _COUNT_BITS
# The most vertices that a record can count. Russian roulette ends paths before, since no step is survived for certain.
MOST_VERTICES = (1 << _COUNT_BITS) - 1


@dataclass
class Record:
    """A path that lives in the pixel of its ``place``. 20 words of 4 bytes, RGB variants only."""

    pixel: mi.UInt32  # whose random numbers the path has; ``sample`` continues over the frames of a shot
    sample: mi.UInt32
    place: mi.Point2f  # on the film, in pixels: the path's current place, at first that of its camera sample
    word: mi.UInt32  # kind, ``sampled``, ``behind`` and ``replayed``
    P: mi.Point3f  # rc, if it is on a surface
    shape: mi.ShapePtr  # of rc; none if rc is in the environment, and for paths without rc
    primitive: mi.UInt32
    uv: mi.Point2f  # of the primitive
    w: mi.Vector3f  # unit, the direction from rc; toward rc if that is in the environment
    L: mi.Spectrum  # radiance along ``w``, divided by the density of the path behind; for RC_LIGHT Le / p
    p_light: mi.Float  # density of emitter sampling at rc, if the lamp can be found from there, else 0
    geometry: mi.Float  # |cos θ| / d² at rc, toward the vertex before: this path's part of the Jacobian

    @property
    def kind(self) -> mi.UInt32:
        return self.word & ((1 << _KIND_BITS) - 1)

    @property
    def sampled(self) -> mi.Bool:
        """Whether the lamp was sampled, from rc or from the last vertex behind it, and not met by chance."""
        return (self.word >> _KIND_BITS) & 1 == 1

    @property
    def behind(self) -> mi.UInt32:
        """The number of vertices after rc, including the lamp's if it was not sampled."""
        return (self.word >> _BEHIND) & MOST_VERTICES

    @property
    def replayed(self) -> mi.UInt32:
        return self.word >> _REPLAYED

    def hit(self, origin: mi.Point3f) -> tuple[mi.PreliminaryIntersection3f, mi.Ray3f]:
        """rc as the hit of a ray from ``origin``, and the ray."""
        to = self.P - origin
        distance = dr.norm(to)
        far = self.escapes()
        hit = dr.zeros(mi.PreliminaryIntersection3f, dr.width(self.pixel))
        # The point follows from ``uv`` on a mesh, and from the distance on a sphere, which differs for each ``origin``.
        hit.t = dr.select(far, dr.inf, distance)
        hit.shape, hit.prim_index, hit.prim_uv = self.shape, self.primitive, self.uv
        hit.valid = ~far
        return hit, mi.Ray3f(origin, dr.select(far, self.w, to / distance))

    def escapes(self) -> mi.Bool:
        """Whether there is no surface at rc."""
        return self.shape == None  # noqa: E711 - a comparison of arrays of pointers

    def moved(self, place: mi.Point2f, geometry: mi.Float) -> Record:
        """The record with its path at another ``place`` on the film, where ``evaluate`` has given ``geometry``."""
        return replace(self, place=place, geometry=geometry)


def word_of(kind: mi.UInt32, replayed: mi.UInt32, behind: mi.UInt32, sampled: bool | mi.Bool) -> mi.UInt32:
    flag = dr.select(sampled, mi.UInt32(1 << _KIND_BITS), 0)
    return kind | flag | (behind << _BEHIND) | (replayed << _REPLAYED)


def geometry_of(normal: mi.Normal3f, at: mi.Point3f, origin: mi.Point3f) -> mi.Float:
    """|cos θ| / d² at a vertex with a geometric ``normal``: the solid angle at ``origin`` per unit of area."""
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
