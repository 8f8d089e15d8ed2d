"""Renders pass by pass, within a given memory and time. The bits of the result do not depend on the passes."""

from __future__ import annotations

import gc
import logging
import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from data_gen.budget import LANE_BYTES, Budget, Watch
from data_gen.film import GradientFilm
from data_gen.paths.camera import CameraSamples, bytes_of_rays
from data_gen.paths.streams import ROUND, first_round
from ngpt.errors import NgptError
from ngpt.system.limits import memory as machine_memory

_LOG = logging.getLogger(f"ngpt.{__name__}")

# A function that takes the samples of one pass: it puts, or splats, one value for each camera sample into the film.
SamplePass = Callable[[CameraSamples, GradientFilm], None]

# A lane is one camera sample of a pass. The rays of PACKET neighbouring lanes are traced together. This is quickest if
# these rays start from one pixel.
PACKET = 16
_BLOCK_LANES = 1 << 21
# Lanes are numbered with 32 bits.
_MOST_LANES = 1 << 30
# The fewest lanes of the first pass of a render with a time limit, since fewer lanes would leave cores idle
_FEWEST_LANES = 1 << 13
# In renders with a time limit, the last pass is planned to take the share _CAUTION of the remaining time. A pass has at
# most _GROWTH times as many samples as the largest pass before it.
_CAUTION, _GROWTH = 0.9, 8
# Lanes of the first pass of other renders: enough to render small images in one pass, and to foretell how long the next
# pass takes
FIRST_LANES = 1 << 20
# The seconds that a pass should take: much longer than its start, but short enough for the render to react quickly
PASS_SECONDS = 2.0


class Rounds:
    """A render in rounds, in which samples depend on what earlier rounds have found.

    A ``SamplePass`` that renders in rounds derives from this class. The class itself stands for independent samples,
    which need no rounds. ``seed`` is the seed of what rounds find; None stands for the seed of the render.
    """

    seed: int | None = None

    @property
    def shares(self) -> bool:
        """Whether samples depend on earlier rounds in the current render."""
        return False

    @property
    def said(self) -> dict[str, Any]:
        """Header attributes that describe how samples depend on earlier rounds."""
        return {}

    def begin(self, sensor: mi.Sensor, seed: int, sample: int, film: GradientFilm) -> None:
        """Called before each pass. The ``film`` holds all earlier passes. ``sample`` is the number of the first sample
        of the pass; 0 begins another render."""

    def end_of_round(self, sample: int) -> int | None:
        """The sample before which a pass must end if it begins with this ``sample``; None: there is no limit."""
        return None


def rounds_of(sample: SamplePass) -> Rounds:
    return sample if isinstance(sample, Rounds) else Rounds()


# Called with the bytes that are left for a lane when memory is short. Returns advice for the message, or "".
Advice = Callable[[int], str]


def _no_advice(left: int) -> str:
    return ""


def render_passes(
    sample: SamplePass,
    sensor: mi.Sensor,
    seed: int,
    budget: Budget,
    watch: Watch = Watch(),  # noqa: B008 - it is frozen
    *,
    lane_bytes: int = LANE_BYTES,
    batch: int = 0,
    points: str = "sobol",
    **kind: Any,
) -> GradientFilm:
    """Calls ``sample`` with the camera samples of each pass, and returns the film that it has filled.

    The first pass is always rendered. A further pass is rendered only if it is expected to fit into the rest of the
    ``budget``'s time. The last block may be a partial one. Passes are short at first if ``points`` are "rounds", which
    means that the number of samples is not known beforehand.

    The number of blocks of samples in a pass adapts to the speed of the scene and to the memory. A lane takes
    ``lane_bytes``, or the attribute ``lane_bytes`` of ``sample`` if it exists. The division into passes changes no bit
    of the result, which depends only on the seed, the size, the number of samples and ``spp``: ``spp`` determines the
    first round of the ``points``, see ``data_gen.paths.streams.first_round``. With a ``batch``, the samples of a pass
    depend on each other: each pass is one block of ``batch`` samples per pixel, and the film's variances are computed
    over passes. Such a ``sample`` may keep a state from pass to pass; ``CameraSamples.first`` gives its position.

    If ``sample`` has ``Rounds``, no pass crosses the end of a round. ``kind`` holds ``subpixels`` and ``gradients`` of
    the film, as in ``film_within``.

    Raises NgptError if one block of samples does not fit into the memory.
    """
    spp, seconds = budget.spp, budget.seconds
    total = spp if spp is not None else 1 << 31
    rounds = rounds_of(sample)
    lane_bytes = getattr(sample, "lane_bytes", lane_bytes)
    instead = getattr(sample, "instead", _no_advice)
    net = first_round(points, spp)
    film, block, most = film_within(budget.memory, sensor, total, lane_bytes, batch, instead, net=net, **kind)
    grows = points == "rounds" and not batch
    start = now = budget.clock()
    done: list[tuple[int, float]] = []

    def report(finished: bool = False) -> None:
        if seconds is None:
            watch.progress(film.samples, total)
        else:
            gone, early = now - start, film.samples >= total
            watch.progress(*(end_of_time(gone, seconds, early) if finished else progress_of_time(gone, seconds)))

    def next_pass(size: int) -> int:
        """Samples of the next pass, with blocks of ``size`` samples; 0 for none."""
        left, time_left = total - film.samples, math.inf if seconds is None else seconds - (now - start)
        # The samples that are left over at the end form a block.
        if left < size and seconds is None:
            return left
        blocks = min(most, max(min(left, until) // size, 1)) if size == block else 1
        if not done:
            return min(left, size * (1 if seconds else max(1, min(blocks, FIRST_LANES // (film.pixels * size)))))
        begin, each = foretold(done)
        # If passes take long to begin, they are made longer.
        wanted = min(time_left - begin, max(PASS_SECONDS - begin, 3 * begin)) / each
        if seconds is not None:
            # The duration of short passes says little about a pass that is a hundred times as long.
            wanted = min(wanted, _GROWTH * max(n for n, _ in done))
        n = min(left, size * max(1, min(blocks, int(wanted / size))))
        if begin + each * n <= time_left:
            return n
        # Only a part of a block fits, and no other pass can follow it. Some time is kept in reserve, since the pass may
        # take longer than the others.
        return 0 if batch else max(0, min(n, int((_CAUTION * time_left - begin) / each)))

    report()
    while True:
        rounds.begin(sensor, seed, film.samples, film)
        size = growing_block(film.pixels, film.samples, block) if grows else block
        until = (rounds.end_of_round(film.samples) or total) - film.samples
        size = min(size, until)
        n = next_pass(size)
        if n == 0:
            break
        begin, wall = now, time.perf_counter()
        with recording(), compilation() as compiled:
            camera = CameraSamples(sensor, seed, n, film.samples, min(n, size), net=net)
            film.begin_pass(camera)
            sample(camera, film)
            # Frees the memory of the camera samples before the film processes the pass.
            del camera
            film.end_pass(min(n, size))
            dr.sync_thread()
        now, wall = budget.clock(), time.perf_counter() - wall
        first = ", kernels compiled or loaded" if not done else ""
        _LOG.debug("pass of %d samples per pixel, %.3g s%s", n, now - begin, first)
        # Kernels report their compilation in wall-clock seconds, but the budget may use another clock. So the share of
        # the wall-clock time that compilation takes is subtracted from the pass.
        done.append((n, max((now - begin) * (1 - sum(compiled) / max(wall, 1e-9)), 1e-6)))
        watch.look(film)
        now = budget.clock()
        if n % size or film.samples >= total or watch.stop():
            break
        report()
    report(finished=True)
    return film


def progress_of_time(gone: float, seconds: float) -> tuple[int, int]:
    """The progress to report in a render with a time limit: (elapsed seconds, limit), both whole numbers."""
    limit = math.ceil(seconds)
    return min(limit - 1, int(gone)), limit


def end_of_time(gone: float, seconds: float, early: bool) -> tuple[int, int]:
    """The progress to report when a render with a time limit ends: all of its time or, if it ended ``early``, the
    elapsed time."""
    limit = math.ceil(seconds)
    if early:
        limit = max(1, min(limit, math.ceil(gone)))
    return limit, limit


def growing_block(pixels: int, done: int, block: int) -> int:
    """The samples per pixel in the next block, after ``done`` samples, of a render that a time limit may end.

    The number is small at first and grows up to ``block``.
    """
    first = 1
    while first < block and pixels * first < _FEWEST_LANES:
        first *= 2
    return min(block, max(first, done))


def foretold(done: list[tuple[int, float]]) -> tuple[float, float]:
    """Returns the seconds to begin a pass, and the seconds for each of its samples or blocks, from a line fitted by
    least squares.

    ``done`` holds the number of samples or blocks of each pass, and its seconds. The last eight passes are used,
    without the very first one, which compiles kernels.
    """
    blocks, seconds = np.array(done[1:][-8:] or done).T
    fastest = float((seconds / blocks).min())
    if np.ptp(blocks) == 0:
        return 0.0, fastest
    each = float(np.clip(np.polyfit(blocks, seconds, 1)[0], 0.1 * fastest, fastest))
    return max(float(np.median(seconds - each * blocks)), 0.0), each


@contextmanager
def compilation() -> Iterator[list[float]]:
    """Yields a list that receives the seconds in which each kernel was compiled, when the ``with`` block ends."""
    compiled: list[float] = []
    if dr.flag(dr.JitFlag.KernelHistory):  # The caller reads the history, which empties it.
        yield compiled
        return
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        yield compiled
        compiled += [kernel.get("backend_time", 0) / 1000 for kernel in dr.kernel_history()]


def film_within(
    memory: int,
    sensor: mi.Sensor,
    spp: int,
    lane_bytes: int = LANE_BYTES,
    batch: int = 0,
    instead: Advice = _no_advice,
    *,
    net: int = ROUND,
    **kind: Any,
) -> tuple[GradientFilm, int, int]:
    """Returns an empty film for ``spp`` samples per pixel, the number of samples per pixel in a block, and the largest
    number of blocks in a pass.

    ``memory`` is in MiB. ``net`` is as in ``CameraSamples``. ``kind`` holds further parameters of the film. If memory
    is short, the film has fewer ``subpixels``, and a warning says so. Raises NgptError if one block of samples does not
    fit into ``memory``.
    """
    width, height = (int(n) for n in sensor.film().crop_size())
    block = batch or block_of_samples(width * height)
    lane_bytes += bytes_of_rays(sensor)
    film = film_of(width, height, memory, lane_bytes * min(block, spp), batches=bool(batch), net=net, **kind)
    lanes = film.pixels * min(block, spp)
    most = lanes_within(memory, film, lanes, lane_bytes, instead) // lanes
    # If blocks are not whole packets, each pass has one block. A second block would begin in the middle of a packet.
    return film, block, most if lanes % PACKET == 0 and not batch else 1


def film_of(width: int, height: int, memory: int, pixel_bytes: int, *, subpixels: int = 1, **how: Any) -> GradientFilm:
    """A film with the requested subpixels, or with fewer if a pass of ``pixel_bytes`` per pixel would not fit into
    ``memory`` MiB beside it."""
    k = subpixels
    while True:
        film = GradientFilm(width, height, subpixels=k, **how)
        if k == 1 or least_memory(film, film.pixels, pixel_bytes) <= memory:
            break
        k //= 2
    if k < subpixels:
        kept = f"{k}x{k} are kept" if k > 1 else "none are kept"
        _LOG.warning(
            "%dx%d subpixels of %dx%d pixels do not fit into %d MiB of memory: %s; more memory (--memory) holds them",
            *(subpixels, subpixels, width, height, memory, kept),
        )
    return film


@contextmanager
def recording() -> Iterator[None]:
    """A context for recording kernels. Python's garbage collector is off in it, so no scene of an earlier render is
    freed.

    A virtual function call of Dr.Jit holds one function for each object (material, lamp ...) that exists at that
    moment. If an earlier scene were freed while a kernel is recorded, one call could hold functions of two lamps, and
    the next call only one. Dr.Jit 1.5 takes the two calls for two functions, gives both the same name ("invalid
    redefinition of function"), and ends the process.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def block_of_samples(pixels: int) -> int:
    """The number of samples of a pixel in a block: as many as are traced together, or fewer if the image is large.

    The results of a ray depend, in the last bits, on the rays traced with it. So the grouping of rays must not depend
    on how a render is split into passes: passes consist of whole blocks.
    """
    block = PACKET
    while block > 1 and pixels * block > _BLOCK_LANES:
        block //= 2
    return block


def lanes_within(
    memory: int, film: GradientFilm, lanes: int, lane_bytes: int = LANE_BYTES, instead: Advice = _no_advice
) -> int:
    """The largest number of lanes with which a pass and the film together fit into ``memory`` MiB.

    Raises NgptError if this number is below ``lanes``. The error's message contains the advice of ``instead``.
    """
    available = min((memory * 2**20 - film.bytes) // lane_bytes, _MOST_LANES)
    most = 1 << (available.bit_length() - 1) if available > 0 else 0
    if most < lanes:
        needed = least_memory(film, lanes, lane_bytes)
        other = instead((memory * 2**20 - film.bytes) // _allocated(lanes))
        there = machine_memory() // 2**20
        remedy = "render a smaller image" if needed > there else f"pass --memory {needed}, or render a smaller image"
        limit = f"this machine has {there} MiB" if needed > there else f"{memory} MiB are allowed"
        raise NgptError(
            f"{film.width}x{film.height} pixels need {needed} MiB of memory beside the scene, and {limit}; "
            f"{remedy}{other}"
        )
    return most


def least_memory(film: GradientFilm, lanes: int, lane_bytes: int = LANE_BYTES) -> int:
    """MiB that the film and a pass of this number of lanes need."""
    return -(-(film.bytes + lane_bytes * _allocated(lanes)) // 2**20)


def _allocated(lanes: int) -> int:
    """The lanes for which Dr.Jit allocates memory: each array gets the next power of two of bytes."""
    return 1 << (lanes - 1).bit_length()
