"""Pipelines from scene to image: a sampler and a method, and the error that they are expected to leave.

Every method that can use a sampler's four small stacks (``data_gen.choosing.trials``) reconstructs each of them, and
each half merged. The error at the number of samples that fit into the time is extrapolated by a power law. Its exponent
comes partly from the pilot, which compares one stack to two, and partly from what is usual for this kind of method.

A biased sampler (photons) never judges others. If it finds most of the light, the samplers that judge it are noisy. So
twice the standard error is added to its measured error. Light that no sampler has found in the pilot is not handled.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from data_gen.adaptive import LEAST, Adaptive, assess, gain
from data_gen.choosing.trials import Trial, Witnesses
from data_gen.samplers import SAMPLERS
from ngpt.merging import merge
from ngpt.methods import METHODS, reconstruct, runnable
from ngpt.stack import GradientStack

# The methods that are best for each kind of stack at some number of samples. All others have more error or are far
# slower. The most frequent winners come first: if time is short, the others are not measured.
WITH_GRADIENTS = ("ngpt-combine", "ngpt-fast", "wcv", "l1")
WITHOUT = ("oidn", "ngpt-primal", "primal")
# These numbers come from bench/pipelines.py of commit e61ee6f3, on scenes that are not ``--apart``.
# The usual exponents of the error as a power of the samples, for methods that use gradients and for denoisers; the
# weight of the pilot in an exponent, and the steepest and flattest exponents allowed
BY_GRADIENTS, BY_DENOISERS = -0.95, -0.55
SEEN, STEEPEST, FLATTEST = 0.3, -1.2, -0.2
# The exponent for images by photons, from theory, and the number of standard errors that are added to their error
_BY_PHOTONS, _DOUBT = -2 / 3, 2.0
# Adaptive samples with gradients gain this power of what the pilot foretells, since the need that a pilot measures is
# smoother than the true one. Below FROM samples per pixel, adaptive samples are not considered.
REALISED, FROM = 2.0, 2 * LEAST


@dataclass(frozen=True)
class Pipeline:
    sampler: str
    method: str
    spp: int  # samples per pixel at which the ``error`` was measured
    error: float  # trimmed relMSE
    step: float  # the exponent of the error as a power of the samples, as the pilot measured it
    seconds: float  # for one sample per pixel of the whole image
    after: float  # seconds that the method takes
    adaptive: float = 1.0  # expected error of adaptive samples relative to even ones; 1: samples are even
    choosing: float = 0.0  # seconds that the method takes each time that samples are distributed
    doubt: float = 0.0  # standard error of a biased sampler's error, by which the error is raised; otherwise 0

    @property
    def shared(self) -> bool:
        return self.choosing > 0

    @property
    def fall(self) -> float:
        """The power of the samples by which the error falls."""
        usual = usual_fall(self.sampler, self.method)
        if self.method == "primal" or SAMPLERS[self.sampler].biased:
            return usual
        return min(max(SEEN * self.step + (1 - SEEN) * usual, STEEPEST), FLATTEST)

    @property
    def doubtful(self) -> bool:
        """Whether the other samplers find too little of the light to judge this one."""
        return _DOUBT * self.doubt > self.error

    @property
    def gain(self) -> float:
        """The error of adaptive samples relative to the error of as many even samples."""
        return self.adaptive ** (REALISED if SAMPLERS[self.sampler].gradients else 1)

    def samples(self, seconds: float) -> float:
        """How many samples per pixel fit into the time; less than 1 if not even one fits."""
        spp = (seconds - self.after) / self.seconds
        return spp - self._choices(spp) / self.seconds

    def takes(self, spp: float) -> float:
        return spp * self.seconds + self._choices(spp) + self.after

    def _choices(self, spp: float) -> float:
        """Seconds for distributing ``spp`` samples. Their number doubles each time that samples are distributed."""
        return self.choosing * math.ceil(math.log2(spp / LEAST) + 1) if self.shared and spp > LEAST else 0.0

    @property
    def least(self) -> int:
        """The fewest samples per pixel for which an error is expected."""
        if self.shared:
            return FROM
        batch = SAMPLERS[self.sampler].batch
        # A single batch has no variances.
        return max(1, 2 * batch if self.method == "wcv" else batch)

    def expected(self, spp: float) -> float:
        """The error after this number of samples per pixel; infinite if they are fewer than ``least``."""
        if spp < self.least:
            return math.inf
        return self._begins * (spp / self.spp) ** self.fall

    def needed(self, error: float) -> float:
        """The samples per pixel that are expected to leave the ``error``, at least ``least``."""
        return max(self.least, self.spp * (error / self._begins) ** (1 / self.fall))

    @property
    def _begins(self) -> float:
        """The expected error after ``spp`` samples per pixel."""
        return (self.error + _DOUBT * self.doubt) * self.gain


def usual_fall(sampler: str, method: str) -> float:
    """The power of the samples by which errors of a method usually fall, on stacks of the sampler."""
    if SAMPLERS[sampler].biased:
        return _BY_PHOTONS
    if method == "primal":
        return -1.0  # -0.96 with points that keep apart, in the main evaluation
    return BY_GRADIENTS if "dx" in METHODS[method].needs else BY_DENOISERS


def measure(
    trials: dict[str, Trial],
    clock: Callable[[], float] = time.perf_counter,
    methods: Callable[[str], list[str]] | None = None,
    shared: bool = True,
    goes_on: Callable[[], bool] = lambda: True,
) -> list[Pipeline]:
    """The pipelines of trials by name of sampler: every method that runs here on every stack that it can use.

    ``methods`` restricts the methods of each sampler. With ``shared``, samples are also distributed adaptively, else
    only evenly. The first sampler gets at least one method, and all else is measured as long as it ``goes_on``.
    """
    witnesses = Witnesses.of(trials)
    found: list[Pipeline] = []
    for name, trial in trials.items():
        halves = [merge(trial.stacks[:2]), merge(trial.stacks[2:])]
        need = None
        for method in (methods or methods_for)(name):
            if found and not goes_on():
                break
            single, double, after = [], [], []
            for half in range(2):
                single.append([reconstruct(stack, method).image for stack in trial.stacks[2 * half : 2 * half + 2]])
                start = clock()
                double.append([reconstruct(halves[half], method).image])
                after.append(clock() - start)
            one, two = witnesses.error(name, single), witnesses.error(name, double)
            spp, doubt = int(halves[0].attributes["ngpt:spp"]), 0.0
            if SAMPLERS[name].biased:
                doubt = witnesses.doubt(name, double[0][0])
            else:
                # The geometric mean of the error measured at twice the samples, and the error extrapolated to there
                two = math.sqrt(two * one * 2 ** usual_fall(name, method))
            pipeline = Pipeline(name, method, spp, two, math.log2(two / one), trial.seconds, min(after), doubt=doubt)
            found.append(pipeline)
            if shared and not SAMPLERS[name].even:
                if need is None and not goes_on():
                    continue
                if need is None:
                    need = _need(merge(halves), clock)
                found.append(replace(pipeline, adaptive=need[0], choosing=need[1]))
    return found


def _need(stack: GradientStack, clock: Callable[[], float]) -> tuple[float, float]:
    """The expected error of adaptive samples relative to even ones, and the seconds of each choice of counts."""
    method = Adaptive().chosen_by(stack)
    start = clock()
    found = assess(stack, method)
    return gain(found.relative), max(clock() - start, 1e-9)


def methods_for(sampler: str, only: str = "auto") -> list[str]:
    """The methods that can reconstruct the sampler's stacks and run here."""
    names: tuple[str, ...] = WITH_GRADIENTS if SAMPLERS[sampler].gradients else WITHOUT
    if only != "auto":
        needs = runnable(only).needs
        names = (only,) if SAMPLERS[sampler].gradients or "dx" not in needs else ()
    return [m for m in names if not METHODS[m].missing()]


def choose(pipelines: Sequence[Pipeline], seconds: float) -> list[Pipeline]:
    """The pipelines for which at least one sample fits into the time, the best first."""
    fit = [p for p in pipelines if p.samples(seconds) >= 1 and math.isfinite(p.expected(p.samples(seconds)))]
    return sorted(fit, key=lambda p: p.expected(p.samples(seconds)))
