"""The camera as an endpoint of paths: paths start at it, or start at a light and are connected to it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from data_gen.paths.camera import CameraSamples
from data_gen.scenes.cameras import camera_name


@dataclass
class ThinLens:
    """A copy of Mitsuba's camera ``thinlens``. Dr.Jit 1.5 does not find the arrays of the camera itself, and cannot
    freeze a function that calls it."""

    radius: mi.Float
    focus: mi.Float
    # A point (x, y, z) in the camera's space is seen on the film at ``scale`` (x, y) / z + ``shift``; [0, 1]² is the
    # crop window.
    scale: mi.Vector2f
    shift: mi.Vector2f

    @classmethod
    def of(cls, sensor: mi.Sensor) -> ThinLens:
        params, film = mi.traverse(sensor), sensor.film()
        fov, radius, focus = (float(np.ravel(params[n])[0]) for n in ("x_fov", "aperture_radius", "focus_distance"))
        frustum = film.size(), film.crop_size(), film.crop_offset(), fov, sensor.near_clip(), sensor.far_clip()
        matrix = np.array(mi.perspective_projection(*frustum).matrix, np.float64).reshape(4, 4)
        (sx, _, x, _), (_, sy, y, _) = (matrix / matrix[3, 2])[:2]
        radius, focus, sx, sy, x, y = (dr.opaque(mi.Float, float(number)) for number in (radius, focus, sx, sy, x, y))
        return cls(radius, focus, mi.Vector2f(sx, sy), mi.Vector2f(x, y))

    def on_lens(self, lens: mi.Point2f) -> mi.Point3f:
        """Maps ``lens``, a place in [0, 1]², to a point on the lens, in the camera's space."""
        disk = mi.warp.square_to_uniform_disk_concentric(lens) * self.radius
        return mi.Point3f(disk.x, disk.y, 0)

    def toward(self, to_world, si: mi.Interaction3f, lens: mi.Point2f, size: mi.Vector2f) -> mi.DirectionSample3f:
        """The fields of the camera's ``sample_direction`` that ``Eye`` uses."""
        place = self.on_lens(lens)
        d = mi.Vector3f(to_world.inverse() @ si.p - place)
        focused = place + d * (self.focus / d.z)
        to = dr.zeros(mi.DirectionSample3f, dr.width(si.p))
        to.p, to.n = to_world @ place, dr.normalize(to_world @ mi.Vector3f(0, 0, 1))
        way = mi.Vector3f(to.p - si.p)
        to.dist = dr.norm(way)
        to.d = way / to.dist
        to.uv = (mi.Point2f(focused.x, focused.y) / focused.z * self.scale + self.shift) * size
        return to

    def ray(self, to_world, uv: mi.Point2f, lens: mi.Point2f, *, near: mi.Float, far: mi.Float, time) -> mi.Ray3f:
        """``sample_ray`` of the camera through the place ``uv`` in [0, 1]² of the film."""
        place, slope = self.on_lens(lens), (uv - self.shift) / self.scale
        d = dr.normalize(mi.Vector3f(slope.x, slope.y, 1) * self.focus - mi.Vector3f(place))
        ray = mi.Ray3f(to_world @ mi.Point3f(place + d * (near / d.z)), dr.normalize(to_world @ d))
        ray.time, ray.maxt = time, (far - near) / d.z
        return ray


@dataclass
class Eye:
    """A camera, with a point on the lens, a time and a wavelength for each lane."""

    sensor: mi.Sensor
    lens: mi.Point2f  # place on the lens, in [0, 1]²
    time: mi.Float | float
    wavelength: mi.Float  # a random number
    near: mi.Float  # its near plane, as a distance along its axis
    far: mi.Float  # its far plane
    area: mi.Float  # of the film, at distance 1
    thin: ThinLens | None = None  # for a thin lens; None if the sensor can be called

    @classmethod
    def of(cls, camera: CameraSamples) -> Eye:
        """The eye for these camera samples. The camera is perspective or a thin lens."""
        sensor = camera.sensor
        numbers = (sensor.near_clip(), sensor.far_clip(), film_area(sensor))
        planes_and_area = (dr.opaque(mi.Float, number) for number in numbers)
        # Spectral variants do not need the copy, because they never freeze functions. Its rays would lack wavelengths.
        thin = ThinLens.of(sensor) if camera_name(sensor) == "thinlens" and not mi.is_spectral else None
        return cls(sensor, camera.lens, camera.time, camera.wavelength, *planes_and_area, thin)

    @property
    def size(self) -> mi.ScalarVector2u:
        return mi.ScalarVector2u(self.sensor.film().crop_size())

    @property
    def pixels(self) -> int:
        return int(dr.prod(self.size))

    def place_on_lens(self, random: Any) -> mi.Point2f:
        """A point on the lens for a path that starts at a light, drawn from ``random`` if there is a lens."""
        return random.next_2d() if self.sensor.needs_aperture_sample() else mi.Point2f(0.5)

    def ray(self, uv: mi.Point2f, lens: mi.Point2f) -> mi.Ray3f:
        """The camera ray through the place ``uv`` on the film, in pixels, and the place ``lens`` on the lens."""
        if self.thin:
            where, planes = uv / mi.Vector2f(self.size), {"near": self.near, "far": self.far}
            return self.thin.ray(self.sensor.world_transform(), where, lens, **planes, time=self.time)
        return self.sensor.sample_ray(self.time, self.wavelength, uv / mi.Vector2f(self.size), lens)[0]

    def toward(self, si: mi.Interaction3f, lens: mi.Point2f, active: mi.Bool | bool = True) -> tuple:
        """Connects ``si`` to the place ``lens`` on the lens: a DirectionSample3f, and the camera's W / distance².

        ``uv`` of the sample is the place on the film, in pixels. ``p`` is the point on the near plane where the camera
        ray begins. ``pdf`` is 1 if ``si`` is in the camera's view, else 0; occlusion is ignored. W = 1 / (A cos³), with
        A the film's area at distance 1. Mitsuba's own values are not used: in version 3.9 the importance is
        wrongly 0 in the part of the film that only an offset of the principal point brings into view, and the thin lens
        sees objects nearer than the near plane.
        """
        if self.thin:
            to = self.thin.toward(self.sensor.world_transform(), si, lens, mi.Vector2f(self.size))
        else:
            to, _ = self.sensor.sample_direction(si, lens, active)
        cos = -dr.dot(to.n, to.d)
        deep = cos * to.dist
        importance = dr.rcp(self.area * cos * dr.square(deep))
        to.p -= to.d * (self.near / cos)
        to.pdf = dr.select(self.shows(to.uv) & (deep >= self.near) & (deep <= self.far), mi.Float(1), 0)
        return to, importance

    def shows(self, uv: mi.Point2f) -> mi.Bool:
        size = self.size
        return (uv.x >= 0) & (uv.y >= 0) & (uv.x < size.x) & (uv.y < size.y)

    def pixel_at(self, uv: mi.Point2f) -> mi.UInt32:
        """The number of the pixel at the place ``uv``, row by row."""
        size = self.size
        return dr.minimum(mi.UInt32(uv.x), size.x - 1) + dr.minimum(mi.UInt32(uv.y), size.y - 1) * size.x


@dataclass
class Sight:
    """The start of both paths of a camera sample: the path from the camera and the path from a light."""

    eye: Eye
    random: Any  # the stream of random numbers of the paths to come
    ray: mi.Ray3f  # the path from the light has the same time and wavelengths
    importance: mi.Spectrum

    @classmethod
    def of(cls, camera: CameraSamples) -> Sight:
        ray, importance, _ = camera.rays()
        return cls(Eye.of(camera), camera.random.clone(), ray, importance)


def film_area(sensor: mi.Sensor) -> float:
    """The area of the film's crop window at distance 1, of a perspective camera or a thin lens."""
    film = sensor.film()
    fov = float(np.ravel(mi.traverse(sensor)["x_fov"])[0])
    # Pixels are squares.
    pixel = 2 * np.tan(np.radians(fov) / 2) / film.size()[0]
    return float(pixel**2 * np.prod(film.crop_size()))
