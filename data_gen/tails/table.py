"""A hash table of cells. A cell is a cube of a grid, further separated by the direction of surfaces and by kind."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from data_gen.paths.streams import mixed

# The search for a cell looks at this number of adjacent slots of the table. This is enough for each cell to find a free
# slot, in whatever order cells are added.
_PLACES = 512
# The number of directions along an axis of the octahedral map, and the code of cells in media, which have no direction.
_DIRECTIONS = 8
INSIDE = _DIRECTIONS**2


@dataclass
class CellPlace:
    """The place of a vertex in the grid of the cache."""

    p: mi.Point3f  # the position relative to the origin of the grid of its level
    code: mi.UInt32  # the direction of the normal on the visible side, and the kind of cell
    level: mi.Int32  # cells of a level have edges of length 2^level


@dataclass
class CellGrid:
    """The position of the grids. There is one grid for each level.

    The origin of a level's grid is ``origin`` minus ``shift`` times the edge of its cells. Floats are finest near
    ``origin``. If the camera is there, cells near the camera can be small, however large the scene is.
    """

    origin: mi.Point3f
    shift: mi.Vector3f

    @classmethod
    def at(cls, origin: Sequence[float] = (0.0, 0.0, 0.0), shift: Sequence[float] = (0.0, 0.0, 0.0)) -> CellGrid:
        # The values are opaque: as literals they would be compiled into kernels, so every seed would need new kernels.
        point, vector = ([dr.opaque(mi.Float, float(x)) for x in each] for each in (origin, shift))
        return cls(mi.Point3f(*point), mi.Vector3f(*vector))

    def place_of(self, p: mi.Point3f, level: mi.Int32) -> mi.Point3f:
        """``p`` relative to the origin of the grid of a ``level``."""
        return mi.Point3f(mi.Vector3f(p - self.origin) + self.shift * dr.exp2(mi.Float(level)))


def octahedral(n: mi.Vector3f) -> mi.UInt32:
    """The number of the cell of the octahedral map in which ``n`` lies, below ``INSIDE``.

    [Meyer et al. 2010, "On floating-point normal vectors"]
    """
    s = dr.rcp(dr.abs(n.x) + dr.abs(n.y) + dr.abs(n.z))
    u, v = n.x * s, n.y * s
    folded = n.z < 0
    u, v = dr.select(folded, (1 - dr.abs(v)) * dr.sign(u), u), dr.select(folded, (1 - dr.abs(u)) * dr.sign(v), v)
    # The map is shifted a little, so that the coordinate axes lie within cells and not on their borders.
    i, j = (mi.UInt32(dr.clip((w + 1) * 0.5 * _DIRECTIONS + 0.02, 0, _DIRECTIONS - 1)) for w in (u, v))
    return i + _DIRECTIONS * j


def key(place: CellPlace) -> tuple[mi.UInt32, mi.UInt32, list[mi.Bool]]:
    """A hash, the cell's check value, and whether the place is in the upper half of the cell along each axis.

    The search for the cell begins at the slot of the hash. The check value is never 0, because 0 marks free slots.
    """
    q = place.p * dr.exp2(mi.Float(-place.level))
    corner = [dr.floor(q[i]) for i in range(3)]
    x, y, z = (mi.UInt32(mi.Int32(c)) for c in corner)
    code = place.code + (mi.UInt32(place.level) << 24)
    h = mixed(x + mixed(y + mixed(z + mixed(code + 0x1234567))))
    name = mixed(h ^ (x * 0x9E3779B1 + y * 0x85EBCA6B + z * 0xC2B2AE35 + code * 0x27D4EB2F)) | 1
    return h, name, [q[i] - corner[i] >= 0.5 for i in range(3)]


def in_table(
    keys: mi.UInt32, h: mi.UInt32, name: mi.UInt32, active: mi.Bool, *, fill: bool = False
) -> tuple[mi.UInt32, mi.Bool]:
    """The slots of cells in a table, and which cells have a slot. With ``fill``, cells without a slot get a free one.

    ``h`` and ``name`` are the first two values of ``key``. The search goes from slot ``h`` to the first free slot.
    """
    last, lanes = dr.width(keys) - 1, dr.width(h)

    def body(i, open, slot, found):
        at = (h + i) & last
        if fill:
            there, made = dr.scatter_cas(keys, mi.UInt32(0), name, at, open)
            hit, empty = open & (made | (there == name)), mi.Bool(False)
        else:
            there = dr.gather(mi.UInt32, keys, at, open)
            hit, empty = open & (there == name), there == 0
        return i + 1, open & ~hit & ~empty & (i < _PLACES - 1), dr.select(hit, at, slot), found | hit

    state = (mi.UInt32(0), mi.Bool(active), mi.UInt32(0), dr.full(mi.Bool, False, lanes))
    how = {"label": "find cells", "mode": "symbolic"}
    _, _, slot, found = dr.while_loop(state, lambda i, open, slot, found: open, body, **how)
    return slot, found
