"""Pipelines from scene to image: a sampler and a reconstruction method, and the error that they are expected to leave.

In the *pilot* (``data_gen.choosing.trials``), each sampler renders four small stacks (a stack holds the layers of one
image). Every method that can use these stacks reconstructs each stack, and also the first two merged and the last two
merged. The error at the number of samples that fit into the time is extrapolated by a power law. Its exponent comes
partly from the pilot, which compares the errors from one stack and from two, and partly from what is usual for this
kind of method.

Images of a biased sampler (photons) are not used to measure the errors of other samplers. If the biased sampler finds
most of the light, the images that measure its error are noisy. So twice the standard error is added to its measured
error. Light that no sampler has found in the pilot is not handled.
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

# The methods that are best at some number of samples, for stacks with and without gradients. All other methods have
# more error or are far slower. The most frequent winners come first, because later ones are not measured if time is
# short.
WITH_GRADIENTS = ("ngpt-combine", "ngpt-fast", "wcv", "l1")
WITHOUT = ("oidn", "ngpt-primal", "primal")
# These numbers come from bench/pipelines.py of commit e61ee6f3, on scenes that are not ``--apart``.
# The error is a power of the number of samples. These are its usual exponents for methods that use gradients and for
# denoisers, the weight of the pilot's measurement in an exponent, and the steepest and flattest exponents allowed.
BY_GRADIENTS, BY_DENOISERS = -0.95, -0.55
SEEN, STEEPEST, FLATTEST = 0.3, -1.2, -0.2
# The exponent for images by photons, from theory, and the number of standard errors that are added to their error
_BY_PHOTONS, _DOUBT = -2 / 3, 2.0
# If the pilot predicts that adaptive samples leave F times the error of even samples, F to the power REALISED is
# expected for samplers with gradients: the need for samples that a pilot measures varies less over the image than the
# true need. Below FROM samples per pixel, adaptive samples are not considered.
REALISED, FROM = 2.0, 2 * LEAST


@dataclass(frozen=True)
class Pipeline:
    sampler: str
    method: str
    spp: int  # samples per pixel at which the ``error`` was measured
    error: float  # trimmed relMSE
    step: float  # the exponent of the error as a power of the samples, as the pilot measured it
    seconds: float  # for one sample per pixel of the whole image
    after: float  # seconds for what follows the render, such as the method
    adaptive: float = 1.0  # expected error of adaptive samples relative to even ones; 1: samples are even
    choosing: float = 0.0  # seconds for each distribution of adaptive samples; 0 if samples are even
    doubt: float = 0.0  # for biased samplers the standard error of ``error``, which is added to it twice; otherwise 0

    @property
    def shared(self) -> bool:
        return self.choosing > 0

    @property
    def fall(self) -> float:
        """The exponent of the error as a power of the number of samples."""
        usual = usual_fall(self.sampler, self.method)
        if self.method == "primal" or SAMPLERS[self.sampler].biased:
            return usual
        return min(max(SEEN * self.step + (1 - SEEN) * usual, STEEPEST), FLATTEST)

    @property
    def doubtful(self) -> bool:
        """Whether the other samplers find too little of the light to measure the error of this sampler."""
        return _DOUBT * self.doubt > self.error

    @property
    def gain(self) -> float:
        """The error of adaptive samples relative to the error of the same number of even samples."""
        return self.adaptive ** (REALISED if SAMPLERS[self.sampler].gradients else 1)

    def samples(self, seconds: float) -> float:
        """How many samples per pixel fit into the time; less than 1 if not even one sample fits."""
        spp = (seconds - self.after) / self.seconds
        return spp - self._choices(spp) / self.seconds

    def takes(self, spp: float) -> float:
        return spp * self.seconds + self._choices(spp) + self.after

    def _choices(self, spp: float) -> float:
        """Seconds for distributing ``spp`` samples. The number of samples doubles at each distribution."""
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
        """The error after ``spp`` samples per pixel; infinite if ``spp`` is below ``least``."""
        if spp < self.least:
            return math.inf
        return self._begins * (spp / self.spp) ** self.fall

    def needed(self, error: float) -> float:
        """The number of samples per pixel that is expected to leave this ``error``, but at least ``least``."""
        return max(self.least, self.spp * (error / self._begins) ** (1 / self.fall))

    @property
    def _begins(self) -> float:
        """The expected error after ``spp`` samples per pixel."""
        return (self.error + _DOUBT * self.doubt) * self.gain


def usual_fall(sampler: str, method: str) -> float:
    """The usual exponent of a method's error as a power of the number of samples, for stacks of the sampler."""
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
    """Measures the pipelines of the ``trials``: for each sampler, all methods that run here and can use its stacks.

    ``methods`` restricts the methods of each sampler. With ``shared``, there are also pipelines with adaptive samples.
    At least one method is measured for the first sampler. Everything else is measured only while ``goes_on()`` is true.
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
                # The geometric mean of two errors at twice the samples: the measured error, and the error extrapolated
                # from a single stack
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
    """The expected error of adaptive samples relative to even ones, and the seconds to distribute samples once."""
    method = Adaptive().chosen_by(stack)
    start = clock()
    found = assess(stack, method)
    return gain(found.relative), max(clock() - start, 1e-9)


def methods_for(sampler: str, only: str = "auto") -> list[str]:
    """The methods that run here and can reconstruct the sampler's stacks."""
    names: tuple[str, ...] = WITH_GRADIENTS if SAMPLERS[sampler].gradients else WITHOUT
    if only != "auto":
        needs = runnable(only).needs
        names = (only,) if SAMPLERS[sampler].gradients or "dx" not in needs else ()
    return [m for m in names if not METHODS[m].missing()]


def choose(pipelines: Sequence[Pipeline], seconds: float) -> list[Pipeline]:
    """The pipelines for which at least one sample fits into the time, the best first."""
    fit = [p for p in pipelines if p.samples(seconds) >= 1 and math.isfinite(p.expected(p.samples(seconds)))]
    return sorted(fit, key=lambda p: p.expected(p.samples(seconds)))
