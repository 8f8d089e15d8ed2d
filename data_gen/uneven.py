"""Rendering of some pixels more than others: passes over lists of pixels, the same bits whatever the passes."""

from __future__ import annotations

import time
from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np

from data_gen import passes
from data_gen.budget import LANE_BYTES, Budget
from data_gen.film import GradientFilm
from data_gen.passes import PACKET, SamplePass, foretold, lanes_within, recording
from data_gen.paths.camera import CameraSamples, bytes_of_rays
from data_gen.paths.streams import first_round

# Samples of a pixel come in blocks of a packet of rays, so that no pixel's bits depend on which others are rendered.
BLOCK = PACKET


class UnevenRender:
    """A render that receives, step by step, how many more blocks of samples each pixel gets.

    The steps make one sequence of blocks: the first block of all pixels that get one, row by row, then the second block
    of all pixels that get two, and so on. ``most`` samples, the time of the ``budget`` or ``stop`` can end the sequence
    anywhere. The same total of samples gives the same bits, whatever the passes and whatever ended the render.

    ``sample`` must take samples that do not share anything; see ``data_gen.passes.render_passes()`` for it. ``stop`` is
    asked before each pass, and ``report`` called after it.
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
    ):
        width, height = (int(n) for n in sensor.film().crop_size())
        self.net = first_round(points, None)
        self.film = GradientFilm(width, height, net=self.net)
        self.sample, self.sensor, self.seed, self.stop, self.report = sample, sensor, seed, stop, report
        self.blocks_left = (most or 1 << 62) // BLOCK
        lane_bytes += bytes_of_rays(sensor)
        # Raises NgptError where not even one row's worth fits.
        self.at_once = lanes_within(budget.memory, self.film, BLOCK * width, lane_bytes) // BLOCK
        self.end = None if budget.seconds is None else time.perf_counter() + budget.seconds
        self.passes: list[tuple[int, float]] = []  # blocks and seconds of each
        self.ended = False

    def add(self, blocks: np.ndarray, whole: bool = False) -> None:
        """Renders so many more ``blocks`` of each pixel, (pixels) integers.

        Unless the ``whole`` is asked for, these are as many of them as there may be; ``ended`` says whether some were
        left out.
        """
        waiting, level = np.zeros(0, np.uint32), 0
        while True:
            n = self._at_once(whole)
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

    def _at_once(self, whole: bool) -> int:
        """Blocks of the next pass; 0 where there is no time for one."""
        if not self.passes:
            return max(1, min(self.at_once, passes.FIRST_LANES // BLOCK))
        begin, each = foretold(self.passes)
        # Where a pass takes long to begin, it goes on for longer.
        n = max(1, min(self.at_once, int(max(passes.PASS_SECONDS - begin, 3 * begin) / each)))
        if whole or self.end is None:
            return n
        left = self.end - time.perf_counter()
        # Two thirds of the time left, since a pass may take longer than others did; all of it where that is too little.
        most = int((2 / 3 * left - begin) / each)
        return min(n, most if most > 0 else int(left > begin + each))

    def _render(self, some: np.ndarray) -> None:
        """One block of each of ``some`` pixels, ascending; of a pixel that is there more than once, so many."""
        start = time.perf_counter()
        pixels, starts, blocks = np.unique(some, return_index=True, return_counts=True)
        within = np.arange(len(some)) - np.repeat(starts, blocks)
        first = mi.UInt32(np.repeat(self.film.samples_each[pixels], blocks) + BLOCK * within)
        with recording():
            self.sample(
                CameraSamples(self.sensor, self.seed, BLOCK, first, BLOCK, mi.UInt32(some), net=self.net), self.film
            )
            self.film.end_pass(BLOCK, some)
        dr.sync_thread()
        self.blocks_left -= len(some)
        self.passes.append((len(some), time.perf_counter() - start))
