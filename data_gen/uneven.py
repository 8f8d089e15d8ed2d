"""Rendering of some pixels more than others: passes over lists of pixels, the same bits whatever the passes."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import drjit as dr
import mitsuba as mi
import numpy as np

from data_gen import passes
from data_gen.film import GradientFilm
from data_gen.passes import DEFAULT_MEMORY, LANE_BYTES, PACKET, SamplePass, lanes_within, recording
from data_gen.paths.camera import CameraSamples

# Samples of a pixel come in blocks of a packet of rays, so that no pixel's bits depend on which others are rendered.
BLOCK = PACKET


class UnevenRender:
    """A render that is told, step by step, how many more blocks of samples each pixel gets.

    What it is told makes one sequence of blocks: the first block of all pixels that get one, row by row, then the
    second of all that get two, and so on. ``most`` samples, a time of ``seconds`` or ``stop`` cut the sequence
    wherever it is: the same samples in all give the same bits, whatever the passes and whatever ended it.

    ``sample`` must take independent samples; see ``data_gen.passes.render_passes()`` for it, for ``memory`` (MiB) and
    for ``stop``. ``report`` is called after each pass.
    """

    def __init__(
        self,
        sample: SamplePass,
        sensor: mi.Sensor,
        seed: int,
        most: int | None = None,
        seconds: float | None = None,
        memory: int = DEFAULT_MEMORY,
        stop: Callable[[], bool] = lambda: False,
        lane_bytes: int = LANE_BYTES,
        report: Callable[[], None] = lambda: None,
    ):
        width, height = (int(n) for n in sensor.film().crop_size())
        self.film = GradientFilm(width, height)
        self.sample, self.sensor, self.seed, self.stop, self.report = sample, sensor, seed, stop, report
        self.blocks_left = (most or 1 << 62) // BLOCK
        # Raises NgptError where not even one row's worth fits.
        self.at_once = lanes_within(memory, self.film, BLOCK * width, lane_bytes) // BLOCK
        self.end = None if seconds is None else time.perf_counter() + seconds
        self.expected: float | None = None  # seconds of a block
        self.ended = False

    def add(self, blocks: np.ndarray, whole: bool = False) -> None:
        """Renders so many more ``blocks`` of each pixel, (pixels) integers.

        Unless the ``whole`` is asked for, these are as many of them as there may be; ``ended`` says whether some were
        left out.
        """
        for some, each in _levels(blocks):
            done, total = 0, len(some) * each
            while done < total:
                n = min(self._at_once(whole), total - done)
                if not whole and (n := min(n, self.blocks_left)) < 1:
                    self.ended = True
                    return
                begin = done % len(some)
                if begin or n < len(some):
                    part, rounds = some[begin : begin + n], 1
                else:
                    part, rounds = some, n // len(some)
                self._render(part, rounds)
                done += len(part) * rounds
                self.report()
                if self.stop() and not whole:
                    self.ended = True
                    return

    def _at_once(self, whole: bool) -> int:
        """Blocks of the next pass; 0 where there is no time for one."""
        if self.expected is None:
            return max(1, min(self.at_once, passes.FIRST_LANES // BLOCK))
        n = max(1, min(self.at_once, int(passes.PASS_SECONDS / self.expected)))
        if whole or self.end is None:
            return n
        return min(n, int(max(self.end - time.perf_counter(), 0) / self.expected))

    def _render(self, some: np.ndarray, rounds: int) -> None:
        start = time.perf_counter()
        first = mi.UInt32(self.film.samples_each[some])
        with recording():
            camera = CameraSamples(self.sensor, self.seed, rounds * BLOCK, first, BLOCK, mi.UInt32(some))
            self.sample(camera, self.film)
            self.film.end_pass(BLOCK, some)
        dr.sync_thread()
        self.blocks_left -= len(some) * rounds
        # Small passes take longer per block than large ones; more than the time left is worse than some of it unused.
        self.expected = (time.perf_counter() - start) / (len(some) * rounds)


def _levels(blocks: np.ndarray) -> Iterator[tuple[np.ndarray, int]]:
    """(pixels, number of further blocks of each), in the order of the sequence."""
    before = 0
    for level in np.unique(blocks[blocks > 0]):
        yield np.flatnonzero(blocks >= level), int(level) - before
        before = int(level)
