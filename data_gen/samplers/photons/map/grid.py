"""Search for photons by place, in a dense uniform grid. Each cell is a run of entries in one sorted list.

The edge of a cell is at least the diameter of the ball in which photons are gathered. So a ball touches at most two
cells along each axis. These are four rows of two cells, and the two cells of a row are neighbours in the list. Counts
and a stable sort build the list, and photons are gathered in its order, so sums have the same bits every time.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

# With more cells for each photon, most cells would be empty, and larger cells would cost less.
_CELLS_PER_PHOTON = 4
_LEAST_CELLS = 1 << 12


@dataclass(init=False)
class Grid:
    """Points ``p[i]`` with numbers ``index[i]``, sorted by cell. Cell c has i from ``start[c]`` to ``start[c + 1]``.

    The grid contains the ``points`` that ``exist``. ``radius`` is the largest radius of a search.
    """

    low: mi.Point3f
    edge: mi.Float  # of a cell
    rate: mi.Float  # cells in a unit of length
    n: mi.Vector3u
    start: mi.UInt32
    index: mi.UInt32
    p: mi.Point3f

    def __init__(self, points: mi.Point3f, exist: mi.Bool, radius: float):
        index = dr.compress(exist)
        if not dr.width(index):
            # No cell has a point. The arrays hold one point outside all cells, since they must not be empty.
            self.low, self.n = dr.opaque(mi.Point3f, 0), dr.opaque(mi.Vector3u, 3)
            self.edge, self.rate = (dr.opaque(mi.Float, value) for value in (2 * radius, 1 / (2 * radius)))
            self.start, self.index, self.p = dr.zeros(mi.UInt32, 28), dr.zeros(mi.UInt32, 1), dr.zeros(mi.Point3f, 1)
            dr.eval(self.start, self.index, self.p)
            return
        p = dr.gather(mi.Point3f, points, index)
        low, high = (np.array([f(axis)[0] for axis in p], np.float64) for f in (dr.min, dr.max))
        most = max(_LEAST_CELLS, _CELLS_PER_PHOTON * dr.width(index))
        edge, cells = self.cells(high - low, 2 * radius, most)
        # There is a spare cell on all sides, so the grid contains all cells of a ball around any of the points.
        self.low = mi.Point3f(*(dr.opaque(mi.Float, float(c)) for c in low - edge))
        self.edge, self.rate = (dr.opaque(mi.Float, value) for value in (edge, 1 / edge))
        self.n = mi.Vector3u(*(dr.opaque(mi.UInt32, int(n)) for n in cells))
        key = self.linear(*(mi.UInt32((q - o) * self.rate) for q, o in zip(p, self.low, strict=True)))
        counts = dr.zeros(mi.UInt32, int(np.prod(cells)) + 1)
        dr.scatter_add(counts, mi.UInt32(1), key)
        self.start = dr.prefix_sum(counts)
        order = dr.argsort(key)
        self.index, self.p = dr.gather(mi.UInt32, index, order), dr.gather(mi.Point3f, p, order)
        dr.eval(self.start, self.index, self.p)

    @staticmethod
    def cells(extents: np.ndarray, edge: float, most: int) -> tuple[float, np.ndarray]:
        """The edge of a cell and the numbers of cells; ``edge`` grows until there are at most ``most`` cells."""
        while True:
            cells = np.floor(extents / edge).astype(np.int64) + 3
            if np.prod(cells.astype(np.float64)) <= most:
                return edge, cells
            edge *= 1.25

    def linear(self, x: mi.UInt32, y: mi.UInt32, z: mi.UInt32) -> mi.UInt32:
        return x + self.n.x * (y + self.n.y * z)

    def row(self, p: mi.Point3f, k: mi.UInt32, active) -> tuple[mi.UInt32, mi.UInt32]:
        """The start and end in the list of row ``k`` (0 to 3) of the cells near ``p``; empty far off the grid."""
        near = [(q - o) * self.rate - 0.5 for q, o in zip(p, self.low, strict=True)]
        for f, n in zip(near, self.n, strict=True):
            active = active & (f >= 0) & (f < n - 1)
        x, y, z = (mi.UInt32(dr.select(active, f, 0)) for f in near)
        cell = self.linear(x, y + (k & 1), z + (k >> 1))
        return dr.gather(mi.UInt32, self.start, cell, active), dr.gather(mi.UInt32, self.start, cell + 2, active)

    def each(self, p: mi.Point3f, radius2: mi.Float, active: mi.Bool, visit, state: tuple) -> tuple:
        """Returns ``state`` after a call of ``visit`` (state, place in the list, near) for each point that may be near
        ``p``.

        ``near`` says whether the point is within the radius. If it is not, ``visit`` must change nothing. ``each`` may
        be called within symbolic loops.
        """

        def nearer(q, k):
            return dr.squared_norm(q - p) < radius2

        none = dr.zeros(mi.UInt32, dr.width(p))
        return self.rows((none, none + 4), lambda k: p, nearer, active, visit, state)

    def along(self, ray: mi.Ray3f, length: mi.Float, radius2: mi.Float, active: mi.Bool, visit, state: tuple) -> tuple:
        """As ``each()``, for points within the radius of a piece of a ray, but not past the ends of the piece.

        The piece is cut into parts. They are so short that the points near a part lie in two cells along each axis.
        Each point belongs to only one part.
        """
        # Half the length of a part. All points near the part lie in a ball about the part's middle. The radius of this
        # ball is half the edge of a cell.
        half = dr.sqrt(dr.maximum(0.25 * dr.square(self.edge) - radius2, 0))
        rate = dr.rcp(2 * half)
        # The interval in which the ray is inside the grid
        begin, end = mi.Float(0), mi.Float(length)
        for o, d, low, n in zip(ray.o, ray.d, self.low, self.n, strict=True):
            first, last = (low - o) / d, (low + self.edge * n - o) / d
            begin = dr.maximum(begin, dr.select(first < last, first, last))
            end = dr.minimum(end, dr.select(first < last, last, first))
        crosses = active & (begin < end)
        first = mi.UInt32(dr.select(crosses, begin * rate, 0))
        last = mi.UInt32(dr.select(crosses, end * rate, 0)) + 1

        def middle(k):
            return ray(mi.Float(2 * (k >> 2) + 1) * half)

        def beside(q, k):
            to = q - ray.o
            t = dr.dot(to, ray.d)
            here = (t > 0) & (t < length) & (mi.UInt32(dr.maximum(t, 0) * rate) == (k >> 2))
            return here & (dr.squared_norm(to - ray.d * t) < radius2)

        return self.rows((4 * first, 4 * last), middle, beside, crosses, visit, state)

    def rows(self, numbers: tuple, center, is_near, active: mi.Bool, visit, state: tuple) -> tuple:
        """Returns ``state`` after visits to all points in the rows with ``numbers`` (from, to). Row number k is row
        k % 4 of the cells near the point ``center`` (k).

        ``is_near`` (point, k) says whether a point is within the radius.
        """
        first, last = numbers

        # k - 1 is the number of the row, i the place of the point in the list, end the place behind the row's last
        # point.
        def step(k, i, end, state):
            at = i < end
            near = at & is_near(dr.gather(mi.Point3f, self.p, i, at), k - 1)
            state = visit(state, i, near)
            i = i + 1
            next_row = ~(i < end) & (k < last)
            begin, stop = self.row(center(k), k & 3, next_row)
            moves = ((k + 1, k), (begin, i), (stop, end))
            return *(dr.select(next_row, new, old) for new, old in moves), state

        # The first step has no point: i = end, so the first row is next.
        none = dr.zeros(mi.UInt32, dr.width(first))
        begun = (mi.UInt32(first), mi.UInt32(none), mi.UInt32(none), state)
        goes_on = lambda k, i, end, state: active & ((k < last) | (i < end))  # noqa: E731
        return dr.while_loop(begun, goes_on, step, label="gather")[3]

    def gather(self, p: mi.Point3f, radius2: mi.Float, active: mi.Bool, value, total):
        """Returns ``total`` plus the sum of ``value`` (place in the list, near) over all points within the radius of
        ``p``.

        ``value`` returns the type of ``total``, and must return 0 where ``near`` is false. ``gather`` may be called
        within symbolic loops.
        """
        return self.each(p, radius2, active, lambda sums, i, near: (sums[0] + value(i, near),), (total,))[0]
