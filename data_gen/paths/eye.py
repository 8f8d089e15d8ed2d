"""The camera as an end of paths, of those too that come from a light: what they need to know of it, and no more."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from data_gen.paths.camera import CameraSamples


@dataclass
class Eye:
    """A camera, and what each lane has drawn of its lens, its shutter and its spectrum."""

    sensor: mi.Sensor
    lens: mi.Point2f  # place on the lens, in [0, 1]²
    time: mi.Float | float
    wavelength: mi.Float  # a random number

    @classmethod
    def of(cls, camera: CameraSamples) -> Eye:
        """That of these camera samples."""
        return cls(camera.sensor, camera.lens, camera.time, camera.wavelength)

    @property
    def size(self) -> mi.ScalarVector2u:
        """Pixels of the film, in x and y."""
        return mi.ScalarVector2u(self.sensor.film().crop_size())

    @property
    def pixels(self) -> int:
        return int(dr.prod(self.size))

    def place_on_lens(self, random: Any) -> mi.Point2f:
        """Another one, drawn from ``random``, if there is a lens: that of a path that comes from elsewhere."""
        return random.next_2d() if self.sensor.needs_aperture_sample() else mi.Point2f(0.5)

    def ray(self, uv: mi.Point2f, lens: mi.Point2f) -> mi.Ray3f:
        """Through the place ``uv`` on the film, in pixels, and the place ``lens`` on the lens."""
        return self.sensor.sample_ray(self.time, self.wavelength, uv / mi.Vector2f(self.size), lens)[0]

    def shows(self, uv: mi.Point2f) -> mi.Bool:
        """Whether the place ``uv`` is on the film."""
        size = self.size
        return (uv.x >= 0) & (uv.y >= 0) & (uv.x < size.x) & (uv.y < size.y)

    def pixel_at(self, uv: mi.Point2f) -> mi.UInt32:
        """The number of the pixel at the place ``uv``, row by row."""
        size = self.size
        return dr.minimum(mi.UInt32(uv.x), size.x - 1) + dr.minimum(mi.UInt32(uv.y), size.y - 1) * size.x


@dataclass
class Sight:
    """What both paths of a camera sample begin with: the one from the camera, and the one from a light."""

    eye: Eye
    random: Any  # the stream of random numbers of the paths to come
    ray: mi.Ray3f  # whose time and wavelengths are those of the path from the light, too
    importance: mi.Spectrum

    @classmethod
    def of(cls, camera: CameraSamples) -> Sight:
        """That of these camera samples."""
        ray, importance, _ = camera.rays()
        return cls(Eye.of(camera), camera.random.clone(), ray, importance)
