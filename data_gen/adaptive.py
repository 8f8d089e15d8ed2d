"""Adaptive samples: a few samples everywhere first, then more of them where the result's error is large.

Before each step the chosen method reconstructs the image twice, which gives the standard error of its result
(``ngpt.api.uncertainty``). docs/use/adaptive.md says how the numbers of samples follow from this error. The samples
that decide these numbers are also part of the image. So a pixel whose first samples were too dark by chance might get
too few further samples, and stay too dark. This bias is small, because the errors are divided by the light and averaged
over about 9x9 pixels.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from data_gen import passes
from data_gen.budget import LANE_BYTES, Budget, Watch, wall
from data_gen.film import GradientFilm
from data_gen.passes import PACKET, SamplePass, film_of, foretold, lanes_within, recording, rounds_of
from data_gen.paths.camera import CameraSamples, bytes_of_rays
from data_gen.paths.streams import first_round
from data_gen.samplers import SAMPLERS, Sampler
from ngpt.api.uncertainty import FACTOR, FACTORS, change, noisier
from ngpt.errors import NgptError, WrongUse
from ngpt.measure.metrics import EPSILON, trimmed_mean
from ngpt.methods import reconstruct
from ngpt.stack import GradientStack
from ngpt.subpixels import cropped, subpixels
from ngpt.system.late import ndimage

# Samples of a pixel come in blocks. A block is as large as a packet, the rays that are traced together. So the bits of
# a pixel do not depend on which other pixels are rendered.
BLOCK = PACKET
# The least mean number of samples per pixel: the first step gives BLOCK samples to each pixel, and as many more are
# left to distribute
LEAST = 2 * BLOCK
# The fewest and the most samples that a pixel gets, relative to an even share
_FLOOR, _CAP = 0.25, 16.0
# If an error is given, a step aims at _MARGIN times the samples that seem to be needed, and adds at least the share
# _SMALLEST of the samples so far.
_MARGIN, _SMALLEST = 1.05, 0.125
# The worst pixels are left out, as ngpt.measure.metrics.relmse_trimmed does.
_TRIM = 0.001
# This share of the changes, the largest ones, is cut to the next smaller change. Otherwise all pixels around a firefly
# would get more samples.
_CUT = 0.03
# The error of an image relative to the root mean square of its standard errors. It is above 1, since a few errors are
# much larger than their standard errors. For the method l1 it is below 1, since the standard errors of l1 include light
# that l1 leaves out of the image. Measured by bench/adaptive.py of commit e61ee6f3 in six scenes.
_TAILS, _TAIL = {"l1": 0.75}, 1.25
# Side, in pixels, of the part of an image that the method is timed on
_PART = 96


@dataclass(frozen=True)
class Adaptive:
    """How samples are distributed.

    The ``error`` is relative: the root of the mean of (x - r)² / (r² + 1e-3) over all but the worst 0.1 % of the
    pixels, for the result x of the ``method`` and the converged image r. It is estimated from standard errors, since r
    is not known.
    """

    error: float | None = None  # the render ends at this error; None: samples or time end it
    method: str = "auto"

    def chosen_by(self, stack: GradientStack) -> str:
        """The method whose errors decide where samples go. If neither a method nor an error is requested, it is ``wcv``
        for a stack with gradients. Networks take many times as long as ``wcv``, and their errors are in about the same
        places."""
        return "wcv" if self.method == "auto" and self.error is None and "dx" in stack else self.method


def check_adaptive(adaptive: Adaptive, sampler: Sampler, options: dict, spp: int | None) -> None:
    """Raises NgptError for samplers and options that need the same number of samples in all pixels, and for numbers
    that make no sense."""
    if adaptive.error is not None and not 0 < adaptive.error < math.inf:
        raise WrongUse(f"an error of {adaptive.error:g} is never reached; give a positive number, such as 0.05")
    if spp is not None and spp < LEAST:
        raise WrongUse(f"adaptive renders need at least {LEAST} samples per pixel, not {spp}")
    if sampler.even:
        able = ", ".join(name for name, other in SAMPLERS.items() if not other.even)
        raise NgptError(f"samples of '{sampler.name}' depend on each other and cannot be adaptive; use one of: {able}")
    if options.get("reuse"):
        raise NgptError("option 'reuse' needs samples of all pixels in each pass; leave it out")


def render_adaptive(
    sample: SamplePass, sensor: mi.Sensor, seed: int, adaptive: Adaptive, budget: Budget, watch: Watch, **how: Any
) -> tuple[GradientFilm, dict]:
    """Renders adaptive samples. Returns the film, and the attributes with the method and the error.

    For the parameters see ``data_gen.passes.render_passes()``. The samples of the ``budget`` and of the progress are
    means over pixels. The first 16 samples of each pixel are always rendered. The bits of the result depend on the
    seed, the size, the method and the total number of samples, but not on what ended the render. Raises NgptError as
    the method does.
    """
    width, height = (int(n) for n in sensor.film().crop_size())
    pixels = width * height
    spp, seconds, stop, clock = budget.spp, budget.seconds, watch.stop, budget.clock
    total, start = spp or LEAST, clock()

    def report() -> None:
        if seconds is not None:
            watch.progress(*passes.progress_of_time(clock() - start, seconds))
        else:
            done = int(work.film.samples_each.mean())
            watch.progress(min(done, total), total)

    def after_pass() -> None:
        watch.look(work.film)
        report()

    most = None if spp is None else spp * pixels
    work = UnevenRender(sample, sensor, seed, most, budget=budget, stop=stop, report=after_pass, **how)
    report()
    work.add(np.ones(pixels, int), whole=True)
    attributes: dict = {}
    took = 0.0
    while not (work.ended or stop()):
        begin = clock()
        if seconds is not None and begin - start > seconds:
            break
        n, stack = work.film.samples_each, work.film.stack()
        method = adaptive.chosen_by(stack)
        if seconds is not None:
            took = took or seconds_to_assess(stack, method, clock)
            if clock() - start + took > seconds:
                break
        found = assess(stack, method)
        took = clock() - begin
        attributes = {"ngpt:adaptive": found.method}
        more = n.mean()
        if adaptive.error is not None:
            attributes["ngpt:error"] = found.error
            if found.error <= adaptive.error:
                break
            needed = n.mean() * (found.error / adaptive.error) ** 2
            if spp is None:
                total = max(total, math.ceil(needed))
            more = min(more, max(_MARGIN * needed - n.mean(), _SMALLEST * n.mean()))
        work.add(share_out(found.relative * np.sqrt(n), n, more * pixels))
    if seconds is not None:
        early = adaptive.error is not None and attributes.get("ngpt:error", math.inf) <= adaptive.error
        watch.progress(*passes.end_of_time(clock() - start, seconds, early))
    elif not stop():
        watch.progress(total, total)
    return work.film, attributes


@dataclass(frozen=True)
class Assessment:
    relative: np.ndarray  # the standard error of each pixel relative to its light, (pixels)
    error: float  # of the whole image, see ``Adaptive``
    method: str


def assess(stack: GradientStack, method: str) -> Assessment:
    """The expected error of the method's result for the stack."""
    result, again = reconstruct(stack, method), reconstruct(noisier(stack), method)
    light = ndimage.uniform_filter(np.nan_to_num(result.image).astype(np.float64), (3, 3, 1))
    unit = np.sqrt(np.square(light) + EPSILON)
    # Errors are made relative before they are averaged over neighbours: the error at the edge of a lamp must not count
    # for the dark pixels beside it.
    once, twice = (np.nan_to_num(r.image) / unit for r in (result, again))
    factor = FACTORS.get(result.method, FACTOR)
    squares = np.square(factor * (twice - once))
    error = _TAILS.get(result.method, _TAIL) * math.sqrt(trimmed_mean(squares, squares, _TRIM))
    # The error of a firefly must not count for all pixels around it either.
    most = np.quantile(np.abs(twice - once), 1 - _CUT)
    around = factor * change(once, once + np.clip(twice - once, -most, most))
    return Assessment(np.sqrt(np.square(around).mean(axis=-1)).ravel(), error, result.method)


def seconds_to_assess(stack: GradientStack, method: str, clock: Callable[[], float] = wall) -> float:
    """The seconds that ``assess`` is expected to take, measured on a part in the middle of the image. Returns 0 for an
    image that is less than four times as large as this part."""
    if stack.width * stack.height < 4 * _PART**2:
        return 0.0
    seconds = 0.0
    for side in (_PART // 4, _PART):  # The first call loads networks, so its time is discarded.
        rows, columns = (slice(max(0, (n - side) // 2), (n + side) // 2) for n in (stack.height, stack.width))
        fine = stack.fine and cropped(stack.fine, (rows, columns), subpixels(stack.fine, stack.width))
        layers = {name: stack[name][rows, columns] for name in stack.names}
        part = GradientStack(layers, stack.attributes, fine=fine)
        start = clock()
        assess(part, method)
        seconds = (clock() - start) * (stack.width * stack.height) / (part.width * part.height)
    return seconds


def share_out(need: np.ndarray, n: np.ndarray, samples: float) -> np.ndarray:
    """The number of further blocks for each pixel: about ``samples`` in all, in proportion to ``need``. ``n`` is the
    number of samples that each pixel has. All arrays are (pixels).
    """
    shares = np.clip(need / max(need.mean(), 1e-300), _FLOOR, _CAP)
    low, high = 0.0, (n.max() + samples) / _FLOOR
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if np.maximum(middle * shares - n, 0).sum() < samples else (low, middle)
    blocks = np.floor(np.maximum(low * shares - n, 0) / BLOCK + 0.5).astype(int)
    return blocks if blocks.any() else np.ones(len(n), int)


def gain(need: np.ndarray) -> float:
    """The expected squared error with adaptive samples, divided by that with the same number of even samples, if
    ``need`` (pixels) is right and the numbers of samples follow it exactly."""
    shares = np.clip(need / max(need.mean(), 1e-300), _FLOOR, _CAP)
    squares = np.square(need)
    return float((squares / (shares / shares.mean())).mean() / max(squares.mean(), 1e-300))


class UnevenRender:
    """A render that receives, step by step, how many more blocks of samples each pixel gets.

    The steps make one sequence of blocks: the first block of all pixels that get one, row by row, then the second block
    of all pixels that get two, and so on. ``most`` samples, the time of the ``budget`` or ``stop`` can end the sequence
    anywhere. The same total of samples gives the same bits, however the sequence is divided into passes and whatever
    ended the render.

    The samples that ``sample`` takes must not share anything; for ``sample`` see ``data_gen.passes.render_passes()``.
    ``stop`` is called before each pass, and ``report`` after it.
    """

    def __init__(
        self,
        sample: SamplePass,
        sensor: mi.Sensor,
        seed: int,
        most: int | None = None,
        *,
        budget: Budget = Budget(),  # noqa: B008 - it is frozen
        stop: Callable[[], bool] = lambda: False,
        lane_bytes: int = LANE_BYTES,
        report: Callable[[], None] = lambda: None,
        points: str = "sobol",
        **kind: Any,
    ):
        width, height = (int(n) for n in sensor.film().crop_size())
        self.net = first_round(points, None)
        self.sample, self.sensor, self.seed, self.stop, self.report = sample, sensor, seed, stop, report
        self.blocks_left = (most or 1 << 62) // BLOCK
        lane_bytes += bytes_of_rays(sensor)
        room = BLOCK * lane_bytes // height
        self.film = film_of(width, height, budget.memory, room, net=self.net, **kind)
        # Raises NgptError if not even a block for each pixel of a row fits.
        self.at_once = lanes_within(budget.memory, self.film, BLOCK * width, lane_bytes) // BLOCK
        self.clock = budget.clock
        self.end = None if budget.seconds is None else self.clock() + budget.seconds
        self.passes: list[tuple[int, float]] = []  # blocks and seconds of each
        self.ended = False
        self.rounds, self.done = rounds_of(sample), 0
        # The first block of a pixel has samples that an even render takes in several rounds. So all these rounds begin
        # before this block.
        for first in (0, BLOCK - 1):
            self.rounds.begin(sensor, seed, first, self.film)

    def add(self, blocks: np.ndarray, whole: bool = False) -> None:
        """Renders further ``blocks`` of each pixel, (pixels) integers. Unless ``whole`` is set, it renders only as many
        as the limits allow; ``ended`` says whether some were left out.
        """
        waiting, level = np.zeros(0, np.uint32), 0
        while True:
            self.rounds.begin(self.sensor, self.seed, max(self.done // self.film.pixels, BLOCK - 1), self.film)
            n = min(self._at_once(whole), self._of_round())
            while len(waiting) < n and level < blocks.max():
                waiting = np.append(waiting, np.flatnonzero(blocks > level).astype(np.uint32))
                level += 1
            if not len(waiting):
                return
            n = min(n, len(waiting)) if whole else min(n, len(waiting), self.blocks_left)
            if n < 1 or (self.stop() and not whole):
                self.ended = True
                return
            self._render(np.sort(waiting[:n]))
            waiting = waiting[n:]
            self.report()

    def _of_round(self) -> int:
        """The number of blocks up to the end of the current round. A round ends at a given mean number of samples per
        pixel."""
        end = self.rounds.end_of_round(self.done // self.film.pixels)
        return 1 << 62 if end is None else max(1, -(-(end * self.film.pixels - self.done) // BLOCK))

    def _at_once(self, whole: bool) -> int:
        """The blocks of the next pass; 0 if there is no time for a pass."""
        if not self.passes:
            return max(1, min(self.at_once, passes.FIRST_LANES // BLOCK))
        begin, each = foretold(self.passes)
        # If passes take long to begin, they are made longer.
        n = max(1, min(self.at_once, int(max(passes.PASS_SECONDS - begin, 3 * begin) / each)))
        if whole or self.end is None:
            return n
        left = self.end - self.clock()
        # A pass may take longer than earlier passes, so it is planned to take two thirds of the time left. If this is
        # too short for a block, the pass has one block if that fits into all of the time left.
        most = int((2 / 3 * left - begin) / each)
        return min(n, most if most > 0 else int(left > begin + each))

    def _render(self, some: np.ndarray) -> None:
        """Renders one block for each entry of ``some``, a list of pixels in ascending order. A pixel that is listed n
        times gets n blocks.
        """
        start = self.clock()
        pixels, starts, blocks = np.unique(some, return_index=True, return_counts=True)
        within = np.arange(len(some)) - np.repeat(starts, blocks)
        first = mi.UInt32(np.repeat(self.film.samples_each[pixels], blocks) + BLOCK * within)
        with recording():
            camera = CameraSamples(self.sensor, self.seed, BLOCK, first, BLOCK, mi.UInt32(some), net=self.net)
            self.film.begin_pass(camera)
            self.sample(camera, self.film)
            self.film.end_pass(BLOCK, some)
        dr.sync_thread()
        self.blocks_left -= len(some)
        self.done += BLOCK * len(some)
        self.passes.append((len(some), self.clock() - start))
