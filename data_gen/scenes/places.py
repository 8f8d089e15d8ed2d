"""How often each lamp of a scene is chosen, by place: with many lamps, most light up little of the scene.

The scene is cut into cells. In each cell, lamps are chosen by the mean square of their light at vertices there, which
a pilot measures (``data_gen.scenes.lamps``). The mean of each cell also includes some virtual samples with the mean of
its parent. Any probabilities give correct images, as long as none is 0 where a lamp has light. A shifted path keeps its
lamp, and knows the probability of choosing it both where the path comes from and where it goes to.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

# Cells along each axis of the finest grid, and of the coarser ones that it goes by, down to the whole scene
_SIDE = 16
# Samples that the mean of the larger cell stands for
_OF_PARENT = 16
# The share chosen as in the whole scene: no pilot sees all light.
_FLOOR = 0.2
# Numbers in a table: with more lamps, cells are larger.
_LARGEST = 1 << 21


@dataclass
class Chosen:
    """A lamp of the scene, by its number, the probability to choose it, and the random numbers that are left."""

    lamp: mi.UInt32
    p: mi.Float
    u: mi.Point2f


@dataclass
class Table:
    """The probability of each lamp in each cell: ``p``, (cells + 1, lamps), of rows that sum to 1.

    The last row is for what is nowhere: paths that have ended. ``low`` is the first corner of all cells, ``size`` that
    of one, (3,); there are ``side`` along each axis.
    """

    p: np.ndarray
    low: np.ndarray
    size: np.ndarray
    side: int

    def of(self, lamp: np.ndarray, at: np.ndarray) -> np.ndarray:
        """The probability of these lamps at these places, (N, 3)."""
        i, j, k = cell_of(at, self.low, self.size, self.side).T
        return self.p[(i * self.side + j) * self.side + k, lamp]


def cell_of(at: np.ndarray, low: np.ndarray, size: np.ndarray, side: int) -> np.ndarray:
    """The numbers of cells along each axis, (N, 3); what is beyond them belongs to the nearest."""
    return np.clip((at - low) / size, 0, side - 1).astype(int)


class Places:
    """A table on the device, and the emitters of the scene that it is of."""

    def __init__(self, scene: mi.Scene, table: Table):
        self.emitters, self.lamps, self.side = scene.emitters_dr(), table.p.shape[1], table.side
        self.low, self.per_size = mi.Point3f(*table.low.tolist()), mi.Vector3f(*(1 / table.size).tolist())
        self.p = mi.Float(table.p.ravel().astype(np.float32))
        upto = np.cumsum(table.p, axis=1).astype(np.float32)
        # More than any random number, so that rounding leaves none beyond
        upto[:, -1] = 2
        self.upto = mi.Float(upto.ravel())
        numbers = [int(dr.reinterpret_array(mi.UInt32, mi.EmitterPtr(emitter))[0]) for emitter in scene.emitters()]
        index = np.zeros(max(numbers) + 1, np.uint32)
        index[numbers] = np.arange(len(numbers))
        self.indices = mi.UInt32(index)
        # Similar scenes can then share the kernel.
        dr.make_opaque(self.low, self.per_size, self.p, self.upto, self.indices)

    def row(self, x: mi.SurfaceInteraction3f) -> mi.UInt32:
        """Where the cell of vertex ``x`` begins in the table."""
        place = (x.p - self.low) * self.per_size
        i, j, k = (mi.UInt32(dr.clip(each, 0, self.side - 1)) for each in place)
        cell = (i * self.side + j) * self.side + k
        return dr.select(x.is_valid(), cell, self.side**3) * self.lamps

    def choose(self, x: mi.SurfaceInteraction3f, u: mi.Point2f) -> Chosen:
        """The lamp that the first of the numbers ``u`` leads to at vertex ``x``."""
        row = self.row(x)
        lamp = dr.binary_search(0, self.lamps - 1, lambda i: dr.gather(mi.Float, self.upto, row + i) <= u.x)
        p = dr.gather(mi.Float, self.p, row + lamp)
        before = dr.gather(mi.Float, self.upto, row + lamp - 1, lamp > 0)
        left = dr.clip((u.x - before) / p, 0, dr.one_minus_epsilon(mi.Float))
        return Chosen(lamp, p, mi.Point2f(left, u.y))

    def probability(self, x: mi.SurfaceInteraction3f, lamp: mi.UInt32) -> mi.Float:
        """With which this lamp is chosen at vertex ``x``."""
        return dr.gather(mi.Float, self.p, self.row(x) + lamp)

    def sample(self, x: mi.SurfaceInteraction3f, chosen: Chosen, active: mi.Bool) -> tuple:
        """As ``scene.sample_emitter_direction(x, u, False, active)``: a point of the lamp that is ``chosen``.

        Its density, and Le over it, count the choice with the probability that ``chosen`` says.
        """
        lamp = dr.gather(mi.EmitterPtr, self.emitters, chosen.lamp, active)
        light, weight = lamp.sample_direction(x, chosen.u, active)
        light.pdf *= chosen.p
        return light, weight / chosen.p

    def density(self, x: mi.SurfaceInteraction3f, light: mi.DirectionSample3f, active: mi.Bool) -> mi.Float:
        """As ``scene.pdf_emitter_direction(x, light, active)``."""
        p = light.emitter.pdf_direction(x, light, active)
        return p * self.probability(x, self.index_of(light.emitter, active))

    def index_of(self, emitter: mi.EmitterPtr, active: mi.Bool = True) -> mi.UInt32:
        """The number of an emitter; 0 where there is none."""
        return dr.gather(mi.UInt32, self.indices, dr.reinterpret_array(mi.UInt32, emitter), active)


def learn(lamp: np.ndarray, squares: np.ndarray, at: np.ndarray, whole: np.ndarray) -> Table:
    """From samples of a pilot: the number of its ``lamp``, the square of what that brings, and its vertex, (N, 3).

    ``whole``: weights of lamps in the whole scene, (lamps,), none 0.
    """
    lamps, side = len(whole), _SIDE
    while side > 1 and side**3 * lamps > _LARGEST:
        side //= 2
    # The extent of all but a few vertices: a single distant vertex would leave only one cell for the others. Uneven
    # margins make sure that no wall lies exactly between two cells: rounding would then decide which cell it is in, and
    # a path and its shifted copy might disagree.
    low, high = np.quantile(at, 0.005, axis=0), np.quantile(at, 0.995, axis=0)
    extent = np.maximum(high - low, 1e-3 * (high - low).max() + 1e-30)
    low, size = low - 0.0137 * extent, 1.0411 * extent / side
    cell = cell_of(at, low, size, side)
    means = np.full((1, 1, 1, lamps), np.nan)
    for cells in _doubling(side):
        key = np.ravel_multi_index((*(cell * cells // side).T, lamp), (cells, cells, cells, lamps))
        count = np.bincount(key, minlength=cells**3 * lamps).reshape(cells, cells, cells, lamps)
        total = np.bincount(key, squares, minlength=cells**3 * lamps).reshape(count.shape)
        if cells == 1:
            means = total / np.maximum(count, 1)
        else:
            for axis in range(3):
                means = means.repeat(2, axis=axis)
            means = (total + _OF_PARENT * means) / (count + _OF_PARENT)
    roots = np.sqrt(means.reshape(-1, lamps))
    total = roots.sum(axis=1, keepdims=True)
    table = np.where(total > 0, (1 - _FLOOR) * roots / np.maximum(total, 1e-300) + _FLOOR * whole, whole)
    return Table(np.vstack([table, whole]), low, size, side)


def _doubling(side: int) -> list[int]:
    """1, 2, 4 ... up to ``side``."""
    return [1 << level for level in range(side.bit_length())]
