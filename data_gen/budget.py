"""The budget of a render and the functions that watch it: two small records that are passed down to each pass."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from ngpt.errors import WrongUse
from ngpt.stack import GradientStack

# The default memory limit of a render in MiB, without the scene itself
DEFAULT_MEMORY = 6144
# Bytes that a lane (one camera sample) takes in a pass. Path tracers were measured to take at most 200; the rest is a
# margin.
LANE_BYTES = 256

# Called with (samples per pixel so far, spp). In renders with a time limit, called with (elapsed seconds, limit), both
# whole numbers.
Progress = Callable[[int, int], None]


def wall() -> float:
    """The clock on the wall, in seconds."""
    return time.perf_counter()


@dataclass(frozen=True)
class Budget:
    """What a render may spend. A render ends when it reaches ``spp`` or ``seconds``, whichever comes first."""

    spp: int | None = None  # base paths per pixel; None: as many as the time allows
    seconds: float | None = None  # on the ``clock``, compilation of kernels included; None: no limit
    memory: int = DEFAULT_MEMORY  # MiB for paths and film
    clock: Callable[[], float] = wall  # or time.process_time, which other work on the machine hardly affects

    def check(self) -> None:
        """Raises WrongUse for budgets with which no scene could be rendered."""
        if self.spp is not None and not 1 <= self.spp < 2**31:
            raise WrongUse(f"{self.spp} samples per pixel: from 1 to 2^31 - 1 can be rendered")
        if self.seconds is not None and not 0 < self.seconds < float("inf"):
            raise WrongUse(f"cannot render for {self.seconds:g} s; give a positive number of seconds")
        if self.memory < 1:
            raise WrongUse(f"{self.memory} MiB of memory: give a positive number")


@dataclass(frozen=True)
class Watch:
    """Functions that are called during a render."""

    progress: Progress = lambda done, total: None  # called before the first pass and after each
    stop: Callable[[], bool] = lambda: False  # called after each pass; True ends the render
    # Called after each pass with a function that makes the stack of the samples done by then
    newest: Callable[[Callable[[], GradientStack]], None] = lambda stack: None
    chosen: Callable[[Any], None] = lambda plan: None  # called before the render with the plan of "auto"
    said: Callable[[str], None] = lambda line: None  # called with a line on each sampler that a pilot tries
    # Called with the ``GradientFilm`` after each pass, before ``stop``; it leaves the film as it is
    look: Callable[[Any], None] = lambda film: None
