"""How often each lamp of a scene is chosen, by what it brings to what the camera sees.

Mitsuba chooses all lamps alike, unless a scene gives them ``sampling_weight``. The best weights are in proportion to
The best weights are in proportion to the root of the mean square of what a lamp brings to a vertex, which a short pilot
measures: at the first vertices of camera paths, each lamp is sampled in turn. So all kinds of lamps, the sun and an
environment are measured in the same way, and lamps behind walls count for little.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import drjit as dr
import mitsuba as mi
import numpy as np

from data_gen.scenes.places import Places, Table, learn

# Camera paths of the pilot, and vertices of each that lamps are sampled at
_PATHS, _VERTICES = 1 << 14, 3
# Paths of a pilot that tells lamps by place, and from how many lamps on there is one
_PATHS_BY_PLACE, MANY = 1 << 17, 8
# Lamps are chosen by place if this is expected to lower the variance of direct light to less than this share. In matt
# scenes the expectation holds; glossy materials, which the pilot does not consider, were seen to cost a factor of two.
PROMISE = 0.45
# The share given to all lamps alike: lamps that the pilot did not see may light other places and start light paths.
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
    weights = lamp_weights(scene)
    places = lamp_places(scene, weights) if by_place and len(emitters) >= MANY else None
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


def lamp_weights(scene: mi.Scene) -> np.ndarray:
    """The share of each lamp in the choice, in the order of ``scene.emitters()``; they sum to 1.

    The same for the same scene and camera.
    """
    n = len(scene.emitters())
    lamp, L, _ = _pilot(scene, _PATHS)
    roots = np.zeros(n)
    for each in range(n):
        squares = np.sort(np.square(L[lamp == each]))
        squares = squares[: max(1, int(len(squares) * (1 - _TRIM)))]
        roots[each] = np.sqrt(squares.mean()) if len(squares) else 0
    if not roots.sum() > 0:
        return np.full(n, 1 / n)
    return (1 - _FLOOR) * roots / roots.sum() + _FLOOR / n


def lamp_places(scene: mi.Scene, weights: np.ndarray) -> Places | None:
    """How often each lamp is chosen by place, beside ``weights`` of the whole scene; None where that does not pay."""
    share, table = promised(scene, weights)
    return Places(scene, table) if table and share < PROMISE else None


def promised(scene: mi.Scene, weights: np.ndarray) -> tuple[float, Table | None]:
    """What choosing by place promises to leave of the variance of direct light, and by what table.

    One half of a pilot's samples tells how often each lamp is chosen, and the other how much better that is. Where the
    pilot meets nothing there is no table.
    """
    lamp, L, at = _pilot(scene, _PATHS_BY_PLACE)
    squares, half = np.square(L), np.random.default_rng(0).random(len(L)) < 0.5
    if half.all() or not half.any():
        return 1.0, None
    p = learn(lamp[half], squares[half], at[half], weights).of(lamp, at)
    by_place, as_before = ((squares / share)[~half].sum() for share in (p, weights[lamp]))
    return by_place / as_before if as_before > 0 else 1.0, learn(lamp, squares, at, weights)


def _pilot(scene: mi.Scene, paths: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Samples of lamps at the first vertices of camera paths: each one's number, what it brings, and the vertex (N, 3).

    What it brings counts by its weight beside BSDF sampling: lamps that are large, or close, count for less.
    """
    n = len(scene.emitters())
    lane = dr.arange(mi.UInt32, paths)
    random = mi.PCG32(paths, 0x1A3B)
    sensor = scene.sensors()[0]

    def pair() -> mi.Point2f:
        return mi.Point2f(random.next_float32(), random.next_float32())

    # Meters on shapes have no other way to sample a ray.
    ray, _ = sensor.sample_ray_differential(sensor.shutter_open(), random.next_float32(), pair(), pair())
    ray, active, found = mi.Ray3f(ray), dr.full(mi.Bool, True, paths), []
    emitters = scene.emitters_dr()
    for vertex in range(_VERTICES):
        dr.eval(ray, active, random)
        si = scene.ray_intersect(ray, active)
        active = active & si.is_valid()
        # As if all were grey and matt: so no material is compiled for the pilot, which would take longer than the rest.
        side = mi.Frame3f(dr.mulsign(si.n, dr.dot(si.n, -ray.d)))
        # Each lamp as often as the others, at vertices all over the image
        index = (lane + dr.opaque(mi.UInt32, vertex * 0x9E37)) % dr.opaque(mi.UInt32, n)
        emitter = dr.gather(mi.EmitterPtr, emitters, index)
        light, radiance = emitter.sample_direction(si, pair(), active)
        cos = dr.maximum(dr.dot(side.n, light.d), 0)
        # Over all colours: a red lamp has as much noise in one channel as a white lamp has in each.
        L = dr.sqrt(dr.mean(dr.square(mi.unpolarized_spectrum(radiance)))) * cos
        L *= dr.select(light.delta, 1, dr.rcp(1 + dr.square(cos * dr.inv_pi * n / light.pdf)))
        lit = active & (light.pdf > 0) & (L > 0)
        lit &= ~scene.ray_test(si.spawn_ray_to(light.p), lit)
        L = dr.select(lit & dr.isfinite(L), L, 0)
        ray = si.spawn_ray(side.to_world(mi.warp.square_to_cosine_hemisphere(pair())))
        dr.eval(L, ray, active, random)
        there = np.array(active)
        found.append((np.array(index)[there], np.array(L, np.float64)[there], np.array(si.p).T[there]))
    lamp, L, at = (np.concatenate(each) for each in zip(*found, strict=True))
    return lamp, L, at
