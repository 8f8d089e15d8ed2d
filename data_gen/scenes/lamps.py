"""How often each lamp of a scene is chosen, by what it brings to what the camera sees.

The best weights are in proportion to the root of the mean square of what a lamp brings to a vertex, which a short pilot
measures: at the first vertices of camera paths, each lamp is sampled in turn, whatever kind of lamp it is.

With many lamps, most light up little of the scene, which is cut into cells: in each, lamps are chosen by the mean
square of their light at vertices there. The mean of each cell includes some virtual samples with the mean of its
parent. Any probabilities give correct images, as long as none is 0 where a lamp has light. A shifted path keeps its
lamp, and knows the probability of choosing it both where the path comes from and where it goes to.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

# Camera paths of the pilot, and vertices of each that lamps are sampled at
_PATHS, _VERTICES = 1 << 14, 3
# Paths of a pilot that weighs lamps by place, and the number of lamps from which on there is one
_PATHS_BY_PLACE, MANY = 1 << 17, 8
# Lamps are chosen by place if this is expected to lower the variance of direct light to less than this share. In matt
# scenes the expectation holds; glossy materials, which the pilot does not consider, were seen to cost a factor of two.
PROMISE = 0.45
# The share given to all lamps alike, and in a cell as in the whole scene: lamps that the pilot did not see may light
# other places and start light paths.
_FLOOR = 0.2
# Mean squares leave out this share of a lamp's largest values, so that a single vertex close to it does not decide.
_TRIM = 0.002


@contextmanager
def weighed(scene: mi.Scene, lamps: str, by_place: bool = False) -> Iterator[Places | None]:
    """The ``scene`` with its lamps chosen by "power", where it leaves their weights equal; "uniform": as it is.

    Yields how they are to be chosen by place, if the sampler can (``by_place``) and there are many. Afterwards the
    scene is as it was before.
    """
    emitters = scene.emitters()
    before = [emitter.sampling_weight() for emitter in emitters]
    if lamps == "uniform" or len(emitters) < 2 or len(set(before)) > 1:
        yield None
        return
    many = by_place and len(emitters) >= MANY
    found = _pilot(scene, _PATHS_BY_PLACE if many else _PATHS)
    weights = lamp_weights(scene, found)
    places = lamp_places(scene, weights, found) if many else None
    _set(scene, weights)
    try:
        yield places
    finally:
        _set(scene, before)


def _set(scene: mi.Scene, weights) -> None:
    for emitter, weight in zip(scene.emitters(), weights, strict=True):
        params = mi.traverse(emitter)
        params["sampling_weight"] = float(weight)
        params.update()
    # Else the old distribution stays.
    scene.parameters_changed()


def lamp_weights(scene: mi.Scene, found: Found | None = None) -> np.ndarray:
    """The share of each lamp in the choice, in the order of ``scene.emitters()``; they sum to 1.

    The same for the same scene and camera. ``found`` is what a pilot has found, by at least ``_PATHS`` paths.
    """
    n = len(scene.emitters())
    found = (found or _pilot(scene, _PATHS)).first(_PATHS)
    roots = np.zeros(n)
    for each in range(n):
        squares = np.sort(np.square(found.L[found.lamp == each]))
        squares = squares[: max(1, int(len(squares) * (1 - _TRIM)))]
        roots[each] = np.sqrt(squares.mean()) if len(squares) else 0
    if not roots.sum() > 0:
        return np.full(n, 1 / n)
    return (1 - _FLOOR) * roots / roots.sum() + _FLOOR / n


def lamp_places(scene: mi.Scene, weights: np.ndarray, found: Found) -> Places | None:
    """How often each lamp is chosen by place, beside ``weights`` of the whole scene; None where that does not pay."""
    share, table = promised(found, weights)
    return Places(scene, table) if table and share < PROMISE else None


def promised(found: Found, weights: np.ndarray) -> tuple[float, Table | None]:
    """What choosing by place promises to leave of the variance of direct light, and by what table.

    One half of a pilot's samples determines how often each lamp is chosen. The other half measures how much better that
    is. Where the pilot meets nothing there is no table.
    """
    lamp, squares, at = found.lamp, np.square(found.L), found.at
    half = np.random.default_rng(0).random(len(lamp)) < 0.5
    if half.all() or not half.any():
        return 1.0, None
    p = learn(lamp[half], squares[half], at[half], weights).of(lamp, at)
    by_place, as_before = ((squares / share)[~half].sum() for share in (p, weights[lamp]))
    return by_place / as_before if as_before > 0 else 1.0, learn(lamp, squares, at, weights)


@dataclass
class Found:
    """Samples of lamps at the first vertices of a pilot's paths, (N) each: the number of the ``lamp``, what it brings
    (``L``), the vertex ``at``, (N, 3), and the number of the ``path``."""

    lamp: np.ndarray
    L: np.ndarray
    at: np.ndarray
    path: np.ndarray

    def first(self, paths: int) -> Found:
        """What a pilot of only the first ``paths`` paths would have found."""
        some = self.path < paths
        return Found(self.lamp[some], self.L[some], self.at[some], self.path[some])


def _pilot(scene: mi.Scene, paths: int) -> Found:
    """Samples of lamps by this number of paths.

    What a lamp brings counts by its weight beside BSDF sampling: lamps that are large, or close, count for less.
    """
    random, sensor = mi.PCG32(paths, 0x1A3B), scene.sensors()[0]
    wavelength, film, lens = random.next_float32(), _pair(random), _pair(random)
    # Meters on shapes have no other way to sample a ray.
    ray, _ = sensor.sample_ray_differential(sensor.shutter_open(), wavelength, film, lens)
    ray = mi.Ray3f(ray)
    dr.eval(ray, random)
    index, L, at, there = _walk(scene, ray, random, dr.opaque(mi.UInt32, len(scene.emitters())), paths)
    met = np.array(there) > 0
    return Found(
        np.array(index)[met],
        np.array(L, np.float64)[met],
        np.array(at).reshape(-1, 3)[met],
        np.tile(np.arange(paths), _VERTICES)[met],
    )


def _walk(scene: mi.Scene, ray: mi.Ray3f, random: mi.PCG32, lamps: mi.UInt32, paths: int) -> tuple:
    """Lamp, light, place and existence of the vertices of ``paths``, one vertex of all after the other.

    A loop is recorded twice, however many vertices there are. With many lamps each recording takes seconds.
    """
    n, lane, emitters = _VERTICES * paths, dr.arange(mi.UInt32, paths), scene.emitters_dr()
    of_lamp, of_light, of_there = dr.zeros(mi.UInt32, n), dr.zeros(mi.Float, n), dr.zeros(mi.UInt32, n)
    of_place = dr.zeros(mi.Float, 3 * n)

    def step(ray: mi.Ray3f, random: mi.PCG32, vertex: mi.UInt32, active: mi.Bool) -> tuple:
        # Place and normal are all that is used: of thousands of shapes, all else takes twice the time to record.
        si = scene.ray_intersect(ray, mi.RayFlags.Minimal, False, active)
        active = active & si.is_valid()
        # As if all were grey and matt: so no material is compiled for the pilot, which would take longer than the rest.
        side = mi.Frame3f(dr.mulsign(si.n, dr.dot(si.n, -ray.d)))
        # Each lamp as often as the others, at vertices all over the image
        index = (lane + vertex * 0x9E37) % lamps
        emitter = dr.gather(mi.EmitterPtr, emitters, index, active)
        light, radiance = emitter.sample_direction(si, _pair(random), active)
        cos = dr.maximum(dr.dot(side.n, light.d), 0)
        # Over all colours: a red lamp has as much noise in one channel as a white lamp has in each.
        L = dr.sqrt(dr.mean(dr.square(mi.unpolarized_spectrum(radiance)))) * cos
        L *= dr.select(light.delta, 1, dr.rcp(1 + dr.square(cos * dr.inv_pi * mi.Float(lamps) / light.pdf)))
        lit = active & (light.pdf > 0) & (L > 0)
        lit &= ~scene.ray_test(si.spawn_ray_to(light.p), lit)
        place = vertex * paths + lane
        dr.scatter(of_lamp, index, place, active)
        dr.scatter(of_light, dr.select(lit & dr.isfinite(L), L, 0), place, active)
        dr.scatter(of_there, mi.UInt32(1), place, active)
        for axis, coordinate in enumerate(si.p):
            dr.scatter(of_place, coordinate, 3 * place + axis, active)
        ray = si.spawn_ray(side.to_world(mi.warp.square_to_cosine_hemisphere(_pair(random))))
        return ray, random, vertex + 1, active & (vertex + 1 < _VERTICES)

    begin = (ray, random, dr.zeros(mi.UInt32, paths), dr.full(mi.Bool, True, paths))
    dr.while_loop(begin, lambda ray, random, vertex, active: active, step)
    return of_lamp, of_light, of_place, of_there


def _pair(random: mi.PCG32) -> mi.Point2f:
    return mi.Point2f(random.next_float32(), random.next_float32())


def emitter_numbers(scene: mi.Scene, none: int = 0) -> mi.UInt32:
    """By what Dr.Jit calls an emitter: its number in ``scene.emitters()``. What is no emitter of it has ``none``."""
    pointers = np.array(dr.reinterpret_array(mi.UInt32, scene.emitters_dr())) if scene.emitters() else np.zeros(0, int)
    index = np.full(pointers.max(initial=0) + 1, none, np.uint32)
    index[pointers] = np.arange(len(pointers))
    return mi.UInt32(index)


# Cells along each axis of the finest grid, and of the coarser ones that it goes by, down to the whole scene
_SIDE = 16
# Samples that the mean of the larger cell stands for
_OF_PARENT = 16
# Numbers in a table: with more lamps, cells are larger.
_LARGEST = 1 << 21


@dataclass
class Chosen:
    """A lamp of the scene, by its number, the probability to choose it, and the random numbers that are left."""

    lamp: mi.UInt32
    p: mi.Float
    u: mi.Point2f

    @classmethod
    def of_scene(cls, scene: mi.Scene, u: mi.Point2f, active: mi.Bool) -> Chosen:
        """As the scene chooses it, everywhere alike."""
        lamp, per_p, left = scene.sample_emitter(u.x, active)
        return cls(lamp, dr.rcp(per_p), mi.Point2f(left, u.y))


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
        self.indices = emitter_numbers(scene)
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

    def probability(self, x: mi.SurfaceInteraction3f, lamp: mi.UInt32, active: mi.Bool = True) -> mi.Float:
        """With which this lamp is chosen at vertex ``x``."""
        return dr.gather(mi.Float, self.p, self.row(x) + lamp, active)

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
    for cells in (1 << level for level in range(side.bit_length())):  # 1, 2, 4 ... up to ``side``
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
