"""Camera samples, shared by paths and their shifted copies."""

from __future__ import annotations

from copy import copy
from typing import Self

import drjit as dr
import mitsuba as mi

from data_gen.paths.streams import sample_streams
from data_gen.scenes.cameras import camera_name

# Shifts by half a pixel. A sample and its three shifted copies have one place in each quarter of the pixel.
QUARTERS = ("x", "y", "xy")
# Origin, direction and length of eight rays
_SEEN_BYTES = 8 * 7 * 4


class CameraSamples:
    """``spp`` camera samples for each pixel of a sensor, or for some pixels, from sample number ``first`` on.

    Lanes are ordered by blocks of ``block`` samples (default: all samples are one block), within a block by pixel, and
    within a pixel by sample. ``spp`` is a multiple of ``block``. For a given seed, sample i of a pixel is always the
    same, whatever other samples are rendered with it. ``pixel`` is the number of each lane's pixel, row by row, and
    ``sample`` the number of its sample. ``random`` holds the random numbers for the paths. A clone of it gives the same
    numbers, which correlates a path with its shifted copies.

    ``net`` is the size of the first round of points (``data_gen.paths.streams``), or 0 for independent samples.
    ``some``, UInt32, lists the pixels to sample, which may repeat; then ``first`` is a UInt32 with a sample number for
    each entry of ``some``. Functions that are recorded once (``data_gen.paths.frozen``) may use only those fields that
    ``DRJIT_STRUCT`` names.
    """

    DRJIT_STRUCT = dict.fromkeys(
        ("sensor", "pixel", "random", "position", "lens", "time", "wavelength", "seen", "columns", "ends", "steps"),
        object,
    )
    # shift -> (ray, importance), computed by ``look``; None if the sensor can be called instead
    seen: dict | None = None

    def __init__(
        self,
        sensor: mi.Sensor,
        seed: int,
        spp: int,
        first: int | mi.UInt32 = 0,
        block: int | None = None,
        some: mi.UInt32 | None = None,
        *,
        net: int = 0,
    ):
        self.seed, self.first, self.net = seed, first, net
        self._see(sensor)
        self.pixels = int(dr.prod(self.size)) if some is None else dr.width(some)
        lane = dr.arange(mi.UInt32, self.pixels * spp)
        # Numbers are opaque here and below. A literal would be compiled into the kernel, so each value would need a new
        # kernel.
        self.block = block or spp
        in_pixel, in_block = (dr.opaque(mi.UInt32, n * self.block) for n in (1, self.pixels))
        pixel = lane % in_block // in_pixel
        if some is None:
            first = dr.opaque(mi.UInt32, first)
        else:
            pixel, first = dr.gather(mi.UInt32, some, pixel), dr.gather(mi.UInt32, first, pixel)
        self.pixel = pixel
        self.sample = lane // in_block * in_pixel + lane % in_pixel + first
        self._draw(seed, pixel, self.sample, net)
        self.position = self._corner() + self.position
        dr.schedule(self.position, self.lens, self.time, self.wavelength)
        self.random.schedule_state()
        dr.eval()

    @classmethod
    def replayed(cls, sensor: mi.Sensor, seed: int, pixel: mi.UInt32, sample: mi.UInt32, place: mi.Point2f) -> Self:
        """Sample ``sample`` of each ``pixel``, at another ``place`` on the film. Its random numbers are drawn in the
        kernel that uses them."""
        camera = cls.__new__(cls)
        camera.pixel = pixel
        camera._see(sensor)
        camera._draw(seed, pixel, sample, 0)
        camera.position = place
        return camera

    def _see(self, sensor: mi.Sensor) -> None:
        """Stores the sensor and its size: ``columns`` of pixels, ``ends`` of the film, ``steps`` of a pixel."""
        self.sensor, self.size = sensor, mi.ScalarVector2u(sensor.film().crop_size())
        self.columns = dr.opaque(mi.UInt32, self.size.x)
        self.ends = mi.Vector2f(*(dr.opaque(mi.Float, n) for n in self.size))
        self.steps = mi.Vector2f(*(dr.opaque(mi.Float, 1 / n) for n in self.size))

    def _corner(self) -> mi.Point2f:
        return mi.Point2f(self.pixel % self.columns, self.pixel // self.columns)

    def _draw(self, seed: int, pixel: mi.UInt32, sample: mi.UInt32, net: int) -> None:
        """Draws all random numbers of a camera sample; ``position`` is its place within the pixel."""
        self.random = sample_streams(seed, pixel, sample, int(self.size.x), net)
        self.position = self.random.next_2d()
        self.lens = self.random.next_2d() if self.sensor.needs_aperture_sample() else mi.Point2f(0.5)
        self.time = mi.Float(self.sensor.shutter_open() + self.sensor.shutter_open_time() * self.random.next_1d())
        self.wavelength = self.random.next_1d()

    def cells(self, k: int) -> mi.UInt32:
        """The number of each sample's subpixel among the K x K subpixels of its pixel, row by row.

        This uses the place in the pixel as it was drawn, because ``position`` includes the column and so has fewer
        digits.
        """
        place = sample_streams(self.seed, self.pixel, self.sample, int(self.size.x), self.net).next_2d()
        size = dr.opaque(mi.UInt32, k)
        x, y = (dr.minimum(mi.UInt32(c * mi.Float(size)), size - 1) for c in (place.x, place.y))
        return y * size + x

    def at(self, lanes: mi.UInt32) -> CameraSamples:
        """The samples of only these ``lanes``. Only the fields for rays and random numbers are valid."""

        def gather(value):
            return dr.gather(type(value), value, lanes) if dr.width(value) > 1 else value

        some = copy(self)
        if self.seen:
            some.seen = {shift: tuple(dr.gather(type(v), v, lanes) for v in seen) for shift, seen in self.seen.items()}
        some.random = self.random.at(lanes)
        some.position, some.lens, some.time, some.wavelength = map(
            gather, (self.position, self.lens, self.time, self.wavelength)
        )
        return some

    def rays(self, shift=(0, 0)) -> tuple[mi.RayDifferential3f, mi.Spectrum, mi.Bool]:
        """Camera rays displaced by ``shift`` pixels, their importance, and whether they are on the film.

        The ``shift`` is a pair (x, y), one of ``QUARTERS``, or a Vector2f with one shift for each lane.
        """
        p = self.position + self._shift(shift)
        inside = (p.x >= 0) & (p.y >= 0) & (p.x < self.ends.x) & (p.y < self.ends.y)
        if self.seen:
            ray, importance = self.seen[shift]
            return mi.RayDifferential3f(ray), importance, inside
        uv = p * self.steps
        ray, importance = self.sensor.sample_ray_differential(self.time, self.wavelength, uv, self.lens)
        return ray, importance, inside

    def _shift(self, shift) -> mi.Vector2f:
        if isinstance(shift, mi.Vector2f):
            return shift
        if shift in QUARTERS:
            within = self.position - self._corner()
            half = dr.select(within < 0.5, mi.Vector2f(0.5), -0.5)
            return mi.Vector2f(half.x if "x" in shift else 0, half.y if "y" in shift else 0)
        return mi.Vector2f(*(dr.opaque(mi.Float, s) for s in shift))

    def look(self, *shifts: tuple[int, int] | str) -> Self:
        """Prepares these samples for a function that is recorded once and uses their rays displaced by ``shifts``.

        Such a function cannot call most cameras, since Dr.Jit 1.5 does not find their arrays. So the rays are evaluated
        beforehand.
        """
        if bytes_of_rays(self.sensor):
            rays = [self.rays(shift) for shift in shifts]
            self.seen = {shift: (mi.Ray3f(ray), weight) for shift, (ray, weight, _) in zip(shifts, rays, strict=True)}
            dr.eval(*self.seen.values())
        return self


def bytes_of_rays(sensor: mi.Sensor) -> int:
    """The most bytes that a lane takes for the rays that ``look`` keeps."""
    return 0 if camera_name(sensor) == "perspective" else _SEEN_BYTES
