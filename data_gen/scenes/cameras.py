"""Cameras of Mitsuba: what they are called, which part of a picture they show, and which no sampler renders."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from ngpt.errors import NgptError
from ngpt.windows import Place, Window

# By the names of their classes, since a loaded camera does not know its plugin
_PLUGINS = {
    "PerspectiveCamera": "perspective",
    "ThinLensCamera": "thinlens",
    "OrthographicCamera": "orthographic",
    "RadianceMeter": "radiancemeter",
    "IrradianceMeter": "irradiancemeter",
    "DistantSensorImpl": "distant",
    "BatchSensor": "batch",
}
# As for Mitsuba's own perspective camera: of a rotation in float32 that is none
_SCALE = 1e-3


def camera_name(sensor: mi.Sensor) -> str:
    """The plugin name of a camera, or the name of its class."""
    name = sensor.class_name()
    return _PLUGINS.get(name, name)


def place_of(sensor: mi.Sensor) -> Place:
    """The crop window of a sensor's film, in the whole film."""
    film = sensor.film()
    (left, top), size, whole = ([int(n) for n in pair] for pair in (film.crop_offset(), film.crop_size(), film.size()))
    return Place(Window(left, top, *size), Window(0, 0, *whole))


def check_camera(sensor: mi.Sensor) -> None:
    """Raises NgptError for a camera that no sampler renders.

    Cameras in one film have neither normals in the space of one camera nor differences across their borders. The rays
    of a scaled meter are no unit vectors in Mitsuba 3.9, by which materials and distances would be wrong.
    """
    name = camera_name(sensor)
    if name == "batch":
        raise NgptError(
            "camera 'batch': several cameras in one film have no normals and differences in common; "
            "take its cameras out of it, and render each on its own, the first of the scene"
        )
    if name in ("radiancemeter", "distant"):
        scale = np.linalg.norm(np.array(sensor.world_transform().matrix, np.float64).reshape(4, 4)[:3, 2])
        if abs(scale - 1) > _SCALE:
            raise NgptError(f"camera '{name}': its to_world is scaled by {scale:.3g}; remove <scale> from it")
