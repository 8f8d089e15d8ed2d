"""Camera samples, shared by paths and their shifted copies, and the passes in which they are rendered."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import drjit as dr
import mitsuba as mi

from data_gen.film import GradientFilm
from data_gen.paths.streams import sample_streams
from ngpt.errors import NgptError

Progress = Callable[[int, int], None]

# What a render may use, in MiB, beside the scene itself; see lanes_within().
DEFAULT_MEMORY = 6144
# Bytes that a lane takes in a pass: the most that any sampler was seen to take, 200, and some more.
_LANE_BYTES = 256
# Rays of lanes side by side are traced together, and do best where they start from one pixel.
_PACKET = 16
_BLOCK_LANES = 1 << 21
# Lanes are numbered with 32 bits.
_MOST_LANES = 1 << 30
# Lanes of the first pass: enough to render small images at one go, and to judge how long the next may be.
_FIRST_LANES = 1 << 20
# A pass this long makes little of the time that it takes to start one, and reacts soon enough.
_PASS_SECONDS = 2.0


class CameraSamples:
    """``spp`` camera samples for every pixel of a sensor, from number ``first`` on.

    Lanes are ordered by blocks of ``block`` samples (default: one block of them all), within a block pixel by pixel,
    within a pixel by sample; ``spp`` is a multiple of ``block``. Sample i of a pixel is the same for a given seed,
    whatever else is rendered with it. ``random`` holds the random numbers of the paths to come. Cloning it replays
    them, which is what correlates a path with its shifted copies.
    """

    def __init__(self, sensor: mi.Sensor, seed: int, spp: int, first: int = 0, block: int | None = None):
        self.sensor = sensor
        self.size = mi.ScalarVector2u(sensor.film().crop_size())
        pixels = int(dr.prod(self.size))
        lane = dr.arange(mi.UInt32, pixels * spp)
        # Opaque, here and below: a literal would be compiled into the kernel, a new one for every value.
        self.block = block or spp
        in_pixel, in_block = (dr.opaque(mi.UInt32, n * self.block) for n in (1, pixels))
        pixel = lane % in_block // in_pixel
        sample = lane // in_block * in_pixel + lane % in_pixel + dr.opaque(mi.UInt32, first)
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

    Rendered are ``spp`` samples per pixel, or as many as ``seconds`` of wall-clock time allow, compilation of kernels
    included; with both, whichever comes first. Time is kept in whole passes: the first is always rendered, and no
    further one that is expected to take longer than the time left. ``stop`` is asked after each pass whether to end
    there. ``progress`` is called with (samples per pixel so far, spp) before the first pass and after each, or, where
    there are ``seconds``, with whole (seconds gone, seconds).

    How many blocks of samples make a pass adapts to the speed of the scene and to ``memory`` (MiB). That changes no bit
    of the result, which depends on the seed, the size and the number of samples alone.

    Raises NgptError where one block of samples does not fit into ``memory``.
    """
    width, height = (int(n) for n in sensor.film().crop_size())
    film = GradientFilm(width, height)
    total = spp if spp is not None else 1 << 31
    block = block_of_samples(film.pixels)
    most = blocks_within(memory, film, min(block, total))
    start = now = time.perf_counter()

    def report(finished: bool = False) -> None:
        if seconds is None:
            progress(film.samples, total)
        else:
            limit = math.ceil(seconds)
            progress(limit if finished else min(limit - 1, int(now - start)), limit)

    blocks = _FIRST_LANES // (film.pixels * block) if seconds is None else 1
    report()
    while film.samples < total:
        left = total - film.samples
        # What is left over at the end is a block of its own.
        n = left if left < block else block * max(1, min(blocks, most, left // block))
        begin = now
        sample(CameraSamples(sensor, seed, n, film.samples, min(n, block)), film)
        film.end_pass(min(n, block))
        dr.sync_thread()
        now = time.perf_counter()
        time_left = float("inf") if seconds is None else seconds - (now - start)
        each = (now - begin) / n * block
        finished = film.samples >= total or stop() or time_left < each
        report(finished)
        if finished:
            break
        blocks = int(min(time_left, _PASS_SECONDS) / each)
    return film


def block_of_samples(pixels: int) -> int:
    """How many samples of a pixel go side by side: as many as are traced together, or fewer where images are large.

    The results of a ray depend, in the last bits, on the rays traced with it. So which they are must not depend on how
    a render is split into passes, and passes consist of whole blocks.
    """
    block = _PACKET
    while block > 1 and pixels * block > _BLOCK_LANES:
        block //= 2
    return block


def blocks_within(memory: int, film: GradientFilm, block: int) -> int:
    """How many blocks of ``block`` samples a pass may have, so that it and the film stay within ``memory`` MiB.

    Raises NgptError where not even one fits.
    """
    lanes = film.pixels * block
    # Dr.Jit gives each array the next power of two of bytes.
    available = min((memory * 2**20 - film.bytes) // _LANE_BYTES, _MOST_LANES)
    blocks = (1 << (available.bit_length() - 1)) // lanes if available > 0 else 0
    if blocks < 1:
        needed = -(-(film.bytes + _LANE_BYTES * (1 << (lanes - 1).bit_length())) // 2**20)
        raise NgptError(
            f"{film.width}x{film.height} pixels need {needed} MiB of memory beside the scene, and {memory} MiB are "
            f"allowed; pass --memory {needed}, or render a smaller image"
        )
    # A block that ends amid a packet would push the next one to another place in its own.
    return blocks if lanes % _PACKET == 0 else 1
