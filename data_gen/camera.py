"""What the paths of a pass share with their shifted copies: pixel, lens, time and wavelength samples."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import drjit as dr
import mitsuba as mi
import numpy as np

from data_gen.film import GradientFilm

Progress = Callable[[int, int], None]

# Lanes in one kernel launch. A lane's state takes about 150 bytes, so a pass stays below about 300 MB.
LANES_PER_PASS = 1 << 21


class CameraSamples:
    """``spp`` camera samples for every pixel of a sensor, in lanes ordered pixel by pixel.

    ``random`` holds the random numbers of the paths to come. Cloning it replays them, which is what correlates a path
    with its shifted copies.
    """

    def __init__(self, sensor: mi.Sensor, seed: int, spp: int):
        self.sensor = sensor
        self.size = mi.ScalarVector2u(sensor.film().crop_size())
        lanes = int(dr.prod(self.size)) * spp
        self.random = mi.load_dict({"type": "independent"})
        self.random.seed(seed, lanes)
        # Opaque, here and below: a literal would be compiled into the kernel, a new one for every value.
        pixel = dr.arange(mi.UInt32, lanes) // dr.opaque(mi.UInt32, spp)
        corner = mi.Point2f(pixel % self.size.x, pixel // self.size.x)
        self.position = corner + self.random.next_2d()
        self.lens = self.random.next_2d() if sensor.needs_aperture_sample() else mi.Point2f(0.5)
        self.time = sensor.shutter_open() + sensor.shutter_open_time() * self.random.next_1d()
        self.wavelength = self.random.next_1d()
        dr.schedule(self.position, self.lens, self.time, self.wavelength)
        self.random.schedule_state()
        dr.eval()

    def rays(self, shift: tuple[int, int] = (0, 0)) -> tuple[mi.RayDifferential3f, mi.Spectrum, mi.Bool]:
        """Camera rays displaced by ``shift`` = (x, y) pixels, their importance, and whether they are on the film."""
        p = self.position + mi.Vector2f(*(dr.opaque(mi.Float, s) for s in shift))
        inside = (p.x >= 0) & (p.y >= 0) & (p.x < self.size.x) & (p.y < self.size.y)
        uv = p / mi.Vector2f(self.size)
        ray, importance = self.sensor.sample_ray_differential(self.time, self.wavelength, uv, self.lens)
        return ray, importance, inside


def render_passes(
    sample: Callable[[CameraSamples, GradientFilm], None],
    sensor: mi.Sensor,
    seed: int,
    spp: int,
    progress: Progress = lambda done, total: None,
) -> GradientFilm:
    """Calls ``sample`` with the camera samples of as many passes as memory asks for, and returns the film it filled.

    The same seed, size and spp give the same bits. ``progress`` is called with (samples per pixel so far, spp) before
    the first pass and after each.
    """
    width, height = (int(n) for n in sensor.film().crop_size())
    film = GradientFilm(width, height)
    passes = min(spp, -(-spp * width * height // LANES_PER_PASS))
    ends = [spp * i // passes for i in range(passes + 1)]
    progress(0, spp)
    for i, (start, end) in enumerate(pairwise(ends)):
        # Independent streams for the passes of one render and for renders of different seeds.
        pass_seed = int(np.random.SeedSequence((seed, i)).generate_state(1)[0])
        sample(CameraSamples(sensor, pass_seed, end - start), film)
        progress(end, spp)
    return film
