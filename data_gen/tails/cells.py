"""Cells of the cache: cubes in space, apart by their size and by the side and direction of the surface.

A cell is small against the *spread* of a path at the vertex where the path looks it up. The spread is the width of the
bundle of paths that arrive there, and the light of the cell is blurred over that width. Smooth events add to it,

    spread = Σ t / sqrt(p |cos θ|),

for steps of length t whose direction has density p and meets the surface at θ; the same area is in Bekaert et al. 2003,
"Custom path-space filtering", and ends paths in Müller et al. 2021, "Real-time neural radiance caching for path
tracing", and in NVIDIA's SHaRC.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from data_gen.paths.streams import mixed
from data_gen.tails.schedule import FINENESS

# Directions along an axis of the octahedral map, where the fineness is the least
_DIRECTIONS = 8
# A corner of cells of all sizes, as each lies within one of twice the side: not at a round coordinate, where walls are.
_CORNER = 0.3713


@dataclass
class Place:
    """A vertex as the cache knows it."""

    p: mi.Point3f
    code: mi.UInt32  # direction of the normal on the side that is seen, and what else tells cells apart
    level: mi.Int32  # cells have the side 2^level


@dataclass
class Trail:
    """How far a path has come: the length of its way to the first rough surface, and its spread from there on."""

    reach: mi.Float
    spread: mi.Float

    @classmethod
    def to(cls, x: mi.SurfaceInteraction3f) -> Trail:
        """The trail of a path at its first vertex."""
        return cls(mi.Float(x.t), dr.zeros(mi.Float, dr.width(x.t)))

    def on(self, x: mi.SurfaceInteraction3f, smooth: mi.Bool, p: mi.Float, active: mi.Bool) -> Trail:
        """At the next vertex ``x``, if there is one, behind an event of density ``p`` that was ``smooth``, or not."""
        there = active & x.is_valid()
        wider = x.t * dr.rsqrt(dr.maximum(p * dr.abs(x.wi.z), 1e-6))
        further = there & ~smooth & (self.spread == 0)
        return Trail(self.reach + dr.select(further, x.t, 0), self.spread + dr.select(there & smooth, wider, 0))


def place_of(
    x: mi.SurfaceInteraction3f, spread: mi.Float, fineness: mi.Float, kind: mi.UInt32 | int, gloss: mi.Bool
) -> Place:
    """Where vertex ``x`` lies among the cells that are ``fineness`` times smaller than the ``spread``.

    ``kind`` tells vertices apart that have no light in common. Where ``gloss`` counts, light is another one in each
    direction, and cells are apart by that.
    """
    level = mi.Int32(dr.floor(dr.log2(dr.maximum(spread / fineness, 1e-20))))
    normal = octahedral(mi.Normal3f(dr.mulsign(x.sh_frame.n, x.wi.z)), fineness)
    view = dr.select(gloss, mixed(octahedral(x.to_world(x.wi), fineness) + 1), 0)
    return Place(mi.Point3f(x.p), (normal + (mi.UInt32(kind) << 16)) ^ view, level)


def octahedral(n: mi.Vector3f, fineness: mi.Float) -> mi.UInt32:
    """The number of a direction's cell on the sphere. [Meyer et al. 2010, "On floating-point normal vectors"]"""
    side = _DIRECTIONS * dr.exp2(dr.floor(dr.log2(fineness / FINENESS)))
    s = dr.rcp(dr.abs(n.x) + dr.abs(n.y) + dr.abs(n.z))
    u, v = n.x * s, n.y * s
    folded = n.z < 0
    u, v = dr.select(folded, (1 - dr.abs(v)) * dr.sign(u), u), dr.select(folded, (1 - dr.abs(u)) * dr.sign(v), v)
    # Shifted a little, so that axes lie within cells and not between them.
    i, j = (mi.UInt32(dr.clip((w + 1) * 0.5 * side + 0.02, 0, side - 1)) for w in (u, v))
    return i + mi.UInt32(side) * j


def coarser(place: Place) -> Place:
    """The place of the same vertex among cells of twice the side."""
    return Place(place.p, place.code, place.level + 1)


def key(place: Place) -> tuple[mi.UInt32, mi.UInt32]:
    """Where in a table the cell may be looked for, and what it is known by there, which is never 0."""
    q = (place.p + _CORNER) * dr.exp2(mi.Float(-place.level))
    x, y, z = (mi.UInt32(mi.Int32(dr.floor(q[i]))) for i in range(3))
    code = place.code + (mi.UInt32(place.level) << 24)
    h = mixed(x + mixed(y + mixed(z + mixed(code + 0x1234567))))
    return h, mixed(h ^ (x * 0x9E3779B1 + y * 0x85EBCA6B + z * 0xC2B2AE35 + code * 0x27D4EB2F)) | 1
