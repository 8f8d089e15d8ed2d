"""Warnings that explain a black image."""

from __future__ import annotations

import logging

import drjit as dr
import mitsuba as mi
import numpy as np

from data_gen.scenes.facts import integrator_name

_LOG = logging.getLogger(f"ngpt.{__name__}")

_RAYS = 1 << 10
_NO_LAMPS = 'the scene has no lamps, so its image is black; add one, such as <emitter type="constant"/>'
# Integrators whose light comes only from emitters
_OF_EMITTERS = ("path", "direct", "volpath", "volpathmis")


def warn_without_lamps(scene: mi.Scene) -> None:
    """Warns before a render if the scene has no lamps."""
    if not scene.emitters() and integrator_name(scene) in _OF_EMITTERS:
        _LOG.warning(_NO_LAMPS)


def warn_if_black(scene: mi.Scene, image: np.ndarray) -> None:
    """Warns after a render if its ``image`` (H, W, 3) is black. ``warn_without_lamps`` covers scenes without lamps."""
    if scene.emitters() and not image.any():
        _LOG.warning("the image is black: %s", why_black(scene))


def why_black(scene: mi.Scene) -> str:
    """The reason why the first sensor's image is black although the scene has lamps.

    It is found by tracing random rays of this sensor.
    """
    random, sensor = mi.PCG32(_RAYS, 0x1A3B), scene.sensors()[0]
    film, lens = (mi.Point2f(random.next_float32(), random.next_float32()) for _ in range(2))
    ray, _ = sensor.sample_ray_differential(sensor.shutter_open(), random.next_float32(), film, lens)
    si = scene.ray_intersect(mi.Ray3f(ray))
    met = np.broadcast_to(np.array(si.is_valid()), _RAYS)
    behind = met & np.array(dr.dot(si.n, ray.d) > 0)
    if not met.any():
        return "the camera sees none of the shapes; check the to_world of its sensor"
    if behind.all():
        shapes = {int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0]): shape for shape in scene.shapes()}
        numbers, counts = np.unique(np.array(dr.reinterpret_array(mi.UInt32, si.shape)), return_counts=True)
        most = shapes.get(int(numbers[counts.argmax()]))
        name = f" '{most.id()}'" if most else ""
        return f"the camera is inside an object{name}, of which it sees the back; move the camera, or flip_normals"
    return "no light reaches what the camera sees"
