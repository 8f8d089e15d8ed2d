"""How often each lamp of a scene is chosen, by what it brings to what the camera sees.

Mitsuba chooses all lamps alike, unless a scene gives them ``sampling_weight``. The best weights are in proportion to
the root of the mean square of what a lamp brings to a vertex, which a short pilot measures: at the first vertices of
camera paths, each lamp is sampled in turn. So all kinds of lamps, the sun and an environment are told by the same
measure, and what is behind walls counts for little.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import drjit as dr
import mitsuba as mi
import numpy as np

# Camera paths of the pilot, and vertices of each that lamps are sampled at
_PATHS, _VERTICES = 1 << 14, 3
# Of all lamps alike: those that the pilot did not see may bring light elsewhere, and light paths begin there, too.
_FLOOR = 0.2
# Mean squares are over all but so many of a lamp's largest, lest a single vertex close to it decide.
_TRIM = 0.002


@contextmanager
def weighed(scene: mi.Scene, lamps: str) -> Iterator[None]:
    """The ``scene`` with its lamps chosen by "power", where it leaves their weights equal; "uniform": as it is.

    Afterwards it is as it was before.
    """
    emitters = scene.emitters()
    before = [emitter.sampling_weight() for emitter in emitters]
    if lamps == "uniform" or len(emitters) < 2 or len(set(before)) > 1:
        yield
        return
    _set(scene, lamp_weights(scene))
    try:
        yield
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
    lane = dr.arange(mi.UInt32, _PATHS)
    random = mi.PCG32(_PATHS, 0x1A3B)
    sensor = scene.sensors()[0]

    def pair() -> mi.Point2f:
        return mi.Point2f(random.next_float32(), random.next_float32())

    # Meters on shapes have no other way to sample a ray.
    ray, _ = sensor.sample_ray_differential(sensor.shutter_open(), random.next_float32(), pair(), pair())
    ray, active, found = mi.Ray3f(ray), dr.full(mi.Bool, True, _PATHS), []
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
        L = dr.mean(mi.unpolarized_spectrum(radiance)) * dr.maximum(dr.dot(side.n, light.d), 0)
        lit = active & (light.pdf > 0) & (L > 0)
        lit &= ~scene.ray_test(si.spawn_ray_to(light.p), lit)
        L = dr.select(lit & dr.isfinite(L), L, 0)
        ray = si.spawn_ray(side.to_world(mi.warp.square_to_cosine_hemisphere(pair())))
        dr.eval(L, ray, active, random)
        found.append((np.array(index), np.array(L, np.float64)))
    index, L = (np.concatenate(each) for each in zip(*found, strict=True))
    roots = np.zeros(n)
    for lamp in range(n):
        squares = np.sort(np.square(L[index == lamp]))
        squares = squares[: max(1, int(len(squares) * (1 - _TRIM)))]
        roots[lamp] = np.sqrt(squares.mean()) if len(squares) else 0
    if not roots.sum() > 0:
        return np.full(n, 1 / n)
    return (1 - _FLOOR) * roots / roots.sum() + _FLOOR / n
