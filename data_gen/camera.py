"""Camera samples, shared by paths and their shifted copies, and the passes in which they are rendered."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import drjit as dr
import mitsuba as mi

from data_gen.film import GradientFilm
from data_gen.streams import sample_streams
from ngpt.errors import NgptError

Progress = Callable[[int, int], None]

# What a render may use, in MiB, beside the scene itself; see lanes_within().
DEFAULT_MEMORY = 4096
# Bytes that a lane takes in a pass; the most that any sampler was seen to take, and some more.
_LANE_BYTES = 256
# Lanes of the first pass: enough to render small images at one go, and to judge how long the next may be.
_FIRST_LANES = 1 << 20
_FIRST_LANES_TIMED = 1 << 17
# A pass this long makes little of the time that it takes to start one, and reacts soon enough.
_PASS_SECONDS = 2.0


class CameraSamples:
    """``spp`` camera samples for every pixel of a sensor, from number ``first`` on, in lanes ordered pixel by pixel.

    ``random`` holds the random numbers of the paths to come. Cloning it replays them, which is what correlates a path
    with its shifted copies. Sample i of a pixel is the same for a given seed, whatever else is rendered with it.
    """

    def __init__(self, sensor: mi.Sensor, seed: int, spp: int, first: int = 0):
        self.sensor = sensor
        self.size = mi.ScalarVector2u(sensor.film().crop_size())
        lane = dr.arange(mi.UInt32, int(dr.prod(self.size)) * spp)
        # Opaque, here and below: a literal would be compiled into the kernel, a new one for every value.
        per_pixel = dr.opaque(mi.UInt32, spp)
        pixel, sample = lane // per_pixel, lane % per_pixel + dr.opaque(mi.UInt32, first)
        self.random = sample_streams(seed, pixel, sample)
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
    spp: int | None,
    progress: Progress = lambda done, total: None,
    seconds: float | None = None,
    memory: int = DEFAULT_MEMORY,
    stop: Callable[[], bool] = lambda: False,
) -> GradientFilm:
    """Calls ``sample`` with the camera samples of pass after pass, and returns the film it filled.

    Rendered are ``spp`` samples per pixel, or as many as ``seconds`` of wall-clock time allow, the first pass and the
    compilation of its kernels included: at least one, and passes are as long as the time left. With both, whichever
    comes first. ``stop`` is asked after each pass whether to end there. ``progress`` is called with (samples per pixel
    so far, spp) before the first pass and after each, or, where there are ``seconds``, with whole (seconds gone,
    seconds). The length of passes adapts to the speed of the scene and to ``memory`` (MiB), which changes no bit of the
    result: it depends on the seed and on how many samples there are.

    Raises NgptError where a single sample per pixel does not fit into ``memory``.
    """
    width, height = (int(n) for n in sensor.film().crop_size())
    film = GradientFilm(width, height)
    most = lanes_within(memory, film) // film.pixels
    total = spp if spp is not None else 1 << 31
    start = now = time.perf_counter()

    def report(finished: bool = False) -> None:
        if seconds is None:
            progress(film.samples, total)
        else:
            limit = math.ceil(seconds)
            progress(limit if finished else min(limit - 1, int(now - start)), limit)

    n = (_FIRST_LANES if seconds is None else _FIRST_LANES_TIMED) // film.pixels
    report()
    while film.samples < total:
        n = max(1, min(n, most, total - film.samples))
        begin = now
        sample(CameraSamples(sensor, seed, n, film.samples), film)
        film.end_pass()
        dr.sync_thread()
        now = time.perf_counter()
        left = float("inf") if seconds is None else seconds - (now - start)
        each = (now - begin) / n
        finished = stop() or left < each
        report(finished)
        if finished:
            break
        n = int(min(left, _PASS_SECONDS) / each)
    return film


def lanes_within(memory: int, film: GradientFilm) -> int:
    """How many lanes a pass may have, so that it and the film stay within ``memory`` MiB.

    Raises NgptError where not even one sample per pixel fits.
    """
    # Dr.Jit gives each array the next power of two of bytes.
    lanes = (memory * 2**20 - film.bytes) // _LANE_BYTES
    lanes = 1 << (lanes.bit_length() - 1) if lanes > 0 else 0
    if lanes < film.pixels:
        needed = -(-(film.bytes + _LANE_BYTES * (1 << (film.pixels - 1).bit_length())) // 2**20)
        raise NgptError(
            f"{film.width}x{film.height} pixels need {needed} MiB for one sample per pixel, and {memory} MiB are "
            f"allowed; pass --memory {needed}, or render a smaller image"
        )
    return lanes
