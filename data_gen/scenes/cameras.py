"""Mitsuba's cameras: their names, the part of a picture that they show, and refusals."""

from __future__ import annotations

from collections.abc import Sequence
from difflib import get_close_matches

import mitsuba as mi
import numpy as np

from ngpt.errors import NgptError, WrongUse
from ngpt.windows import Place, Window

# Class name -> plugin name, since a loaded camera does not know its plugin
_PLUGINS = {
    "PerspectiveCamera": "perspective",
    "ThinLensCamera": "thinlens",
    "OrthographicCamera": "orthographic",
    "RadianceMeter": "radiancemeter",
    "IrradianceMeter": "irradiancemeter",
    "DistantSensorImpl": "distant",
    "BatchSensor": "batch",
}
# The tolerance of Mitsuba's own perspective camera, which is above the rounding of a rotation in float32
_SCALE = 1e-3


def camera_name(sensor: mi.Sensor) -> str:
    """The plugin name of a camera, or the name of its class."""
    name = sensor.class_name()
    return _PLUGINS.get(name, name)


def place_of(sensor: mi.Sensor) -> Place:
    """The place of the crop window of a sensor's film in the whole film."""
    film = sensor.film()
    (left, top), size, whole = ([int(n) for n in pair] for pair in (film.crop_offset(), film.crop_size(), film.size()))
    return Place(Window(left, top, *size), Window(0, 0, *whole))


def check_camera(sensor: mi.Sensor) -> None:
    """Raises NgptError for a camera that no sampler renders.

    Several cameras in one film have no common camera space for normals, and differences across their borders mean
    nothing. In Mitsuba 3.9 the ray directions of a scaled meter are no unit vectors, so materials and distances would
    be wrong.
    """
    name = camera_name(sensor)
    if name == "batch":
        raise NgptError(
            "camera 'batch': several cameras in one film cannot be rendered together; take its cameras out of it, "
            "and render them one by one"
        )
    if name in ("radiancemeter", "distant"):
        scale = np.linalg.norm(np.array(sensor.world_transform().matrix, np.float64).reshape(4, 4)[:3, 2])
        if abs(scale - 1) > _SCALE:
            raise NgptError(f"camera '{name}': its to_world is scaled by {scale:.3g}; remove <scale> from it")


def sensor_number(wanted: int | str | None, ids: Sequence[str], scene: str) -> int:
    """The index of the ``wanted`` sensor, given by id or number, among a scene's sensors, whose ``ids`` may be "".

    None stands for the first. Raises WrongUse if there is no such sensor.
    """
    if wanted is None:
        return 0
    name = str(wanted)
    if name in ids and name:
        return ids.index(name)
    if name.isdecimal() and int(name) < len(ids):
        return int(name)
    near = get_close_matches(name, [known for known in ids if known], 1)
    meant = f"did you mean '{near[0]}'? " if near else ""
    raise WrongUse(f"{scene}: there is no sensor '{name}'; {meant}choose one of: {sensor_names(ids)}")


def sensor_names(ids: Sequence[str]) -> str:
    return ", ".join(f"{number} '{known}'" if known else str(number) for number, known in enumerate(ids))
