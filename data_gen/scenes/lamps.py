"""How often each lamp of a scene is chosen: by the light that it brings to the surfaces that the camera sees.

The best weight of a lamp is proportional to the root mean square of the light that it brings to a vertex. A short pilot
measures this: at the first vertices of camera paths it samples the lamps in turn, whatever their kind.

If there are many lamps, most of them light only a part of the scene. So the scene is cut into cells, and in each cell
lamps are chosen by the mean square of their light at the vertices in it. This mean includes some virtual samples with
the mean of the parent cell. Any probabilities give correct images, as long as none is 0 where a lamp has light. A
shifted path keeps its lamp, and knows the probability of choosing it at both vertices.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

# The number of camera paths of the pilot, and of vertices of each path at which lamps are sampled
_PATHS, _VERTICES = 1 << 14, 3
# The number of paths of a pilot that weights lamps by place, and the least number of lamps for such a pilot
_PATHS_BY_PLACE, MANY = 1 << 17, 8
# Lamps are chosen by place if the variance of direct light is expected to fall below this share. In matt scenes the
# expectation is right. With glossy materials, which the pilot ignores, it was wrong by a factor of two.
PROMISE = 0.45
# The share of the choice that is uniform over lamps. In a cell this share follows the weights of the whole scene. Lamps
# that the pilot did not see may light other places and start light paths.
_FLOOR = 0.2
# Mean squares leave out this share of a lamp's largest values, so that a single vertex close to it does not decide.
_TRIM = 0.002


@contextmanager
def weighed(scene: mi.Scene, lamps: str, by_place: bool = False) -> Iterator[Places | None]:
    """A context in which the ``scene`` has lamp weights from a pilot. With ``lamps`` "uniform", or weights that already
    differ, the scene stays as it is.

    Yields the choice of lamps by place if the sampler can use it (``by_place``) and there are many lamps, else None.
    The weights are restored afterwards.
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
    # Without this the scene would keep its old distribution.
    scene.parameters_changed()


def lamp_weights(scene: mi.Scene, found: LampSamples | None = None) -> np.ndarray:
    """The probability of each lamp, in the order of ``scene.emitters()``; they sum to 1.

    It depends only on the scene and the camera. ``found`` are the samples of a pilot with at least ``_PATHS`` paths.
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


def lamp_places(scene: mi.Scene, weights: np.ndarray, found: LampSamples) -> Places | None:
    """The choice of lamps by place, given the ``weights`` of the whole scene; None if it is not worth its cost."""
    share, table = promised(found, weights)
    return Places(scene, table) if table and share < PROMISE else None


def promised(found: LampSamples, weights: np.ndarray) -> tuple[float, LampTable | None]:
    """The expected share of the variance of direct light that is left with a choice by place, and the table for it.

    One half of the pilot's samples gives a table, and the other half measures its gain. If the pilot meets nothing,
    there is no table.
    """
    lamp, squares, at = found.lamp, np.square(found.L), found.at
    half = np.random.default_rng(0).random(len(lamp)) < 0.5
    if half.all() or not half.any():
        return 1.0, None
    p = learn(lamp[half], squares[half], at[half], weights).of(lamp, at)
    by_place, as_before = ((squares / share)[~half].sum() for share in (p, weights[lamp]))
    return by_place / as_before if as_before > 0 else 1.0, learn(lamp, squares, at, weights)


@dataclass
class LampSamples:
    """Samples of lamps at the first vertices of a pilot's paths, (N) each: the number of the ``lamp``, its light ``L``,
    the vertex ``at`` (N, 3), and the number of the ``path``."""

    lamp: np.ndarray
    L: np.ndarray
    at: np.ndarray
    path: np.ndarray

    def first(self, paths: int) -> LampSamples:
        """The samples of the first ``paths`` paths only."""
        some = self.path < paths
        return LampSamples(self.lamp[some], self.L[some], self.at[some], self.path[some])


def _pilot(scene: mi.Scene, paths: int) -> LampSamples:
    """Runs the pilot with ``paths`` paths.

    The light of a lamp includes its MIS weight against BSDF sampling, so large or close lamps count for less.
    """
    random, sensor = mi.PCG32(paths, 0x1A3B), scene.sensors()[0]
    wavelength, film, lens = random.next_float32(), _pair(random), _pair(random)
    # Meters on shapes have no other way to sample a ray.
    ray, _ = sensor.sample_ray_differential(sensor.shutter_open(), wavelength, film, lens)
    ray = mi.Ray3f(ray)
    dr.eval(ray, random)
    index, L, at, there = _walk(scene, ray, random, dr.opaque(mi.UInt32, len(scene.emitters())), paths)
    met = np.array(there) > 0
    return LampSamples(
        np.array(index)[met],
        np.array(L, np.float64)[met],
        np.array(at).reshape(-1, 3)[met],
        np.tile(np.arange(paths), _VERTICES)[met],
    )


def _walk(scene: mi.Scene, ray: mi.Ray3f, random: mi.PCG32, lamps: mi.UInt32, paths: int) -> tuple:
    """Lamp, light, place and existence of the vertices of ``paths`` paths: first vertices, then second ones, and so on.

    A loop is recorded twice, however many vertices there are. With many lamps each recording takes seconds.
    """
    n, lane, emitters = _VERTICES * paths, dr.arange(mi.UInt32, paths), scene.emitters_dr()
    of_lamp, of_light, of_there = dr.zeros(mi.UInt32, n), dr.zeros(mi.Float, n), dr.zeros(mi.UInt32, n)
    of_place = dr.zeros(mi.Float, 3 * n)

    def step(ray: mi.Ray3f, random: mi.PCG32, vertex: mi.UInt32, active: mi.Bool) -> tuple:
        # Only place and normal are used. With thousands of shapes, recording all fields would take twice as long.
        si = scene.ray_intersect(ray, mi.RayFlags.Minimal, False, active)
        active = active & si.is_valid()
        # All surfaces count as grey and matt, since compiling materials would take longer than the rest of the pilot.
        side = mi.Frame3f(dr.mulsign(si.n, dr.dot(si.n, -ray.d)))
        # Each lamp is sampled equally often, at vertices all over the image
        index = (lane + vertex * 0x9E37) % lamps
        emitter = dr.gather(mi.EmitterPtr, emitters, index, active)
        light, radiance = emitter.sample_direction(si, _pair(random), active)
        cos = dr.maximum(dr.dot(side.n, light.d), 0)
        # The mean over colours: a red lamp has as much noise in one channel as a white lamp has in each.
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
    """Dr.Jit's number of an emitter -> its number in ``scene.emitters()``, or ``none`` for numbers of other objects."""
    pointers = np.array(dr.reinterpret_array(mi.UInt32, scene.emitters_dr())) if scene.emitters() else np.zeros(0, int)
    index = np.full(pointers.max(initial=0) + 1, none, np.uint32)
    index[pointers] = np.arange(len(pointers))
    return mi.UInt32(index)


# Cells along each axis of the finest grid. Coarser grids halve it, down to one cell
_SIDE = 16
# The number of virtual samples with the mean of the parent cell
_OF_PARENT = 16
# The most numbers in a table. With more lamps, cells are larger.
_LARGEST = 1 << 21


@dataclass
class Chosen:
    """The number of a chosen lamp, the probability to choose it, and the random numbers that are left."""

    lamp: mi.UInt32
    p: mi.Float
    u: mi.Point2f

    @classmethod
    def of_scene(cls, scene: mi.Scene, u: mi.Point2f, active: mi.Bool) -> Chosen:
        """The choice with the scene's own probabilities, which are the same everywhere."""
        lamp, per_p, left = scene.sample_emitter(u.x, active)
        return cls(lamp, dr.rcp(per_p), mi.Point2f(left, u.y))


@dataclass
class LampTable:
    """The probability ``p`` of each lamp in each cell, (cells + 1, lamps). Its rows sum to 1.

    The last row is for paths that have ended. ``low`` is the first corner of the grid and ``size`` the size of a cell,
    (3,); there are ``side`` cells along each axis.
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
    """The number of the cell along each axis, (N, 3). Places beyond the grid belong to the nearest cell."""
    return np.clip((at - low) / size, 0, side - 1).astype(int)


class Places:
    """A table as Dr.Jit arrays, and the emitters of its scene."""

    def __init__(self, scene: mi.Scene, table: LampTable):
        self.emitters, self.lamps, self.side = scene.emitters_dr(), table.p.shape[1], table.side
        self.low, self.per_size = mi.Point3f(*table.low.tolist()), mi.Vector3f(*(1 / table.size).tolist())
        self.p = mi.Float(table.p.ravel().astype(np.float32))
        upto = np.cumsum(table.p, axis=1).astype(np.float32)
        # Above any random number, even if the sum was rounded down
        upto[:, -1] = 2
        self.upto = mi.Float(upto.ravel())
        self.indices = emitter_numbers(scene)
        # Similar scenes can then share the kernel.
        dr.make_opaque(self.low, self.per_size, self.p, self.upto, self.indices)

    def row(self, x: mi.SurfaceInteraction3f) -> mi.UInt32:
        """The index in the table at which the cell of vertex ``x`` begins."""
        place = (x.p - self.low) * self.per_size
        i, j, k = (mi.UInt32(dr.clip(each, 0, self.side - 1)) for each in place)
        cell = (i * self.side + j) * self.side + k
        return dr.select(x.is_valid(), cell, self.side**3) * self.lamps

    def choose(self, x: mi.SurfaceInteraction3f, u: mi.Point2f) -> Chosen:
        """Chooses a lamp at vertex ``x`` by the first of the random numbers ``u``."""
        row = self.row(x)
        lamp = dr.binary_search(0, self.lamps - 1, lambda i: dr.gather(mi.Float, self.upto, row + i) <= u.x)
        p = dr.gather(mi.Float, self.p, row + lamp)
        before = dr.gather(mi.Float, self.upto, row + lamp - 1, lamp > 0)
        left = dr.clip((u.x - before) / p, 0, dr.one_minus_epsilon(mi.Float))
        return Chosen(lamp, p, mi.Point2f(left, u.y))

    def probability(self, x: mi.SurfaceInteraction3f, lamp: mi.UInt32, active: mi.Bool = True) -> mi.Float:
        """The probability of choosing this lamp at vertex ``x``."""
        return dr.gather(mi.Float, self.p, self.row(x) + lamp, active)

    def sample(self, x: mi.SurfaceInteraction3f, chosen: Chosen, active: mi.Bool) -> tuple:
        """As ``scene.sample_emitter_direction(x, u, False, active)``, for the ``chosen`` lamp.

        The density and the weight include the probability ``chosen.p``.
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


def learn(lamp: np.ndarray, squares: np.ndarray, at: np.ndarray, whole: np.ndarray) -> LampTable:
    """Makes a table from samples of a pilot: the number of the ``lamp``, its squared light, and the vertex, (N, 3).

    ``whole`` (lamps,) are the weights of lamps in the whole scene, all above 0.
    """
    lamps, side = len(whole), _SIDE
    while side > 1 and side**3 * lamps > _LARGEST:
        side //= 2
    # The extent of all but a few vertices, since a single distant vertex would leave only one cell for all others. The
    # margins are not round numbers, so that no wall lies exactly between two cells. Rounding would decide to which cell
    # such a wall belongs, and a path and its shifted copy might disagree.
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
    return LampTable(np.vstack([table, whole]), low, size, side)
