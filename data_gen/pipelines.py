"""The whole way to an image, a sampler and a method, chosen by the error that it is expected to leave in the end.

Each sampler that could render the scene renders four small stacks. Every method that can use them reconstructs each of
the four, and both halves of them merged. The error of such an image is that against primals of the other half and of
the other samplers, whose noise has no mean (``data_gen.pilot``): so what a method blurs or loses counts. From the
pilot's samples to those that fit into the time errors fall by a power of the samples. Part of that power is what the
pilot saw from one stack to two, the rest what is usual for methods of its kind.

Samples are even, or shared out (``data_gen.adaptive``) where that is expected to pay for itself: the gain is that of
the pilot's expected errors, pixel by pixel, were they known.

Not handled: light that no sampler has found in the pilot.
"""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import mitsuba as mi
import numpy as np

from data_gen.adaptive import LEAST, Adaptive, assess, gain
from data_gen.passes import DEFAULT_MEMORY, film_within
from data_gen.pilot import PIXELS, SEED, SPP, at_most, candidates, error_of, mean_of, noise_of
from data_gen.render import render_stack
from data_gen.samplers import SAMPLERS
from ngpt.errors import NgptError
from ngpt.merging import merge
from ngpt.methods import METHODS, reconstruct
from ngpt.stack import GradientStack

# Of the time that there is, after which no further sampler is tried, and what each may take
SHARE, DEAREST = 0.1, 0.2
# Seconds from which on the pilot's images are as large as they ever are, and the least share of that
LONG, LEAST_PIXELS = 200.0, 1 / 16
# The best of each kind of stack at some number of samples; what is not here is behind one of them, or far slower.
WITH_GRADIENTS = ("wcv", "l1", "ngpt-fast", "ngpt-combine")
WITHOUT = ("primal", "oidn", "ngpt-primal")
# These numbers are those of python -m bench.pipelines on scenes not apart.
# The powers of the samples by which errors usually fall, of methods that use gradients and of denoisers; the share that
# the pilot has in such a power, and the steepest and flattest that it may be
BY_GRADIENTS, BY_DENOISERS = -0.95, -0.55
SEEN, STEEPEST, FLATTEST = 0.3, -1.2, -0.2
# The power by which shared out samples with gradients are better than the pilot says, whose need is smoother than it
# is; and the samples from which on they are thought of
REALISED, FROM = 2.0, 2 * LEAST


@dataclass(frozen=True)
class Trial:
    """Four stacks of as many samples by one sampler, and the seconds of one sample of the whole image."""

    stacks: list[GradientStack]
    seconds: float


@dataclass(frozen=True)
class Pipeline:
    """A sampler and a method, as a pilot saw them.

    ``spp``       samples per pixel at which the ``error`` (trimmed relMSE) was measured
    ``step``      the power of the samples by which it falls, as the pilot saw it
    ``seconds``   of one sample of the whole image
    ``after``     those of the method
    ``adaptive``  error of shared out samples over that of even ones, as the need for them says; 1: samples are even
    ``choosing``  seconds of the method that shares them out, each time
    """

    sampler: str
    method: str
    spp: int
    error: float
    step: float
    seconds: float
    after: float
    adaptive: float = 1.0
    choosing: float = 0.0

    @property
    def shared(self) -> bool:
        """Whether samples are shared out."""
        return self.choosing > 0

    @property
    def fall(self) -> float:
        """The power of the samples by which the error falls."""
        usual = usual_fall(self.method)
        if self.method == "primal":
            return usual
        return min(max(SEEN * self.step + (1 - SEEN) * usual, STEEPEST), FLATTEST)

    @property
    def gain(self) -> float:
        """The error over that of as many even samples."""
        return self.adaptive ** (REALISED if SAMPLERS[self.sampler].gradients else 1)

    def samples(self, seconds: float) -> float:
        """How many samples per pixel fit into the time; less than 1 where none do."""
        spp = (seconds - self.after) / self.seconds
        return spp - self._choices(spp) / self.seconds

    def takes(self, spp: float) -> float:
        """The seconds of so many samples and of the method."""
        return spp * self.seconds + self._choices(spp) + self.after

    def _choices(self, spp: float) -> float:
        """Seconds in which samples are shared out: each time, their number doubles."""
        return self.choosing * math.ceil(math.log2(spp / LEAST) + 1) if self.shared and spp > LEAST else 0.0

    @property
    def least(self) -> int:
        """Samples below which nothing is expected."""
        return FROM if self.shared else max(1, SAMPLERS[self.sampler].batch)

    def expected(self, spp: float) -> float:
        """The error after so many samples; infinite where there are too few."""
        if spp < self.least:
            return math.inf
        return self.error * self.gain * (spp / self.spp) ** self.fall

    def needed(self, error: float) -> float:
        """The samples that are expected to leave the error, or the least there are."""
        return max(self.least, self.spp * (error / (self.error * self.gain)) ** (1 / self.fall))


def usual_fall(method: str) -> float:
    """The power of the samples by which errors of a method usually fall."""
    if method == "primal":
        return -1.0  # The samples are independent.
    return BY_GRADIENTS if "dx" in METHODS[method].needs else BY_DENOISERS


def try_pipelines(
    scene: mi.Scene,
    samplers: Sequence[str],
    goes_on: Callable[[], bool] = lambda: True,
    limit: float = math.inf,
    clock: Callable[[], float] = time.perf_counter,
    only: str = "auto",
) -> list[Pipeline]:
    """All pipelines of the samplers, as far as there is time: the first two are always tried.

    Each other one may take ``limit`` seconds. ``clock`` is what seconds are measured by, ``only`` the one method to
    consider. Raises NgptError where no sampler can render the scene.
    """
    trials: dict[str, Trial] = {}
    for i, name in enumerate(samplers):
        if i > 1 and not goes_on():
            break
        if (trial := try_out(scene, name, SEED + 8 * i, clock, limit if i > 1 else math.inf)) is not None:
            trials[name] = trial
    if not trials:
        raise NgptError(f"none of the samplers {', '.join(samplers)} can render the scene")
    return measure(trials, clock, only)


def try_out(
    scene: mi.Scene, sampler: str, seed: int, clock: Callable[[], float], limit: float = math.inf
) -> Trial | None:
    """Four small stacks by a sampler; None where it finds, of this scene, that it cannot render it, and where they are
    expected to take longer than the ``limit``."""
    spp, least = max(SPP, 2 * SAMPLERS[sampler].batch), max(1, SAMPLERS[sampler].batch)
    try:
        render_stack(scene, 1, seed, sampler)  # compiles
    except NgptError:
        return None
    if limit < math.inf:
        start = clock()
        render_stack(scene, least, seed, sampler)
        if 4 * (spp / least + 1) * (clock() - start) > limit:
            return None
    stacks, seconds, begin = [], [], []
    for i in range(4):
        start = clock()
        render_stack(scene, least, seed + i, sampler)
        begin.append(clock() - start)
        start = clock()
        stacks.append(render_stack(scene, spp, seed + i, sampler))
        seconds.append(clock() - start)
    # What a render takes to begin is no part of what a sample takes.
    each = (statistics.median(seconds) - statistics.median(begin)) / (spp - least)
    return Trial(stacks, max(each, 0.2 * statistics.median(seconds) / spp))


def measure(trials: dict[str, Trial], clock: Callable[[], float] = time.perf_counter, only: str = "auto"):
    """The pipelines of trials by name of sampler: every method that runs here on every stack that it can use."""
    primals = {name: [stack["primal"].astype(np.float64) for stack in trial.stacks] for name, trial in trials.items()}
    middle = sum(sum(images) / 4 for images in primals.values()) / len(primals)
    noise = {name: max(noise_of(*images[:2], middle), 1e-12) for name, images in primals.items()}
    scale = mean_of({name: sum(images) / 4 for name, images in primals.items()}, noise)
    found = []
    for name, trial in trials.items():
        halves = [merge(trial.stacks[:2]), merge(trial.stacks[2:])]
        need = None
        for method in methods_for(name, only):
            single, double, after = [], [], []
            for half in range(2):
                single += [reconstruct(stack, method).image for stack in trial.stacks[2 * half : 2 * half + 2]]
                start = clock()
                double.append(reconstruct(halves[half], method).image)
                after.append(clock() - start)
            witnesses = [_witnesses(primals, noise, name, half) for half in (1, 0)]
            one = _expected([single[:2], single[2:]], [[w, w] for w in witnesses], scale)
            two = _expected([double], [witnesses], scale)
            spp = int(halves[0].attributes["ngpt:spp"])
            # Of both: at twice the samples, the one that was measured there and the one that falls to it.
            error = math.sqrt(two * one * 2 ** usual_fall(method))
            pipeline = Pipeline(name, method, spp, error, math.log2(two / one), trial.seconds, min(after))
            found.append(pipeline)
            if not SAMPLERS[name].batch:
                if need is None:
                    need = _need(merge(halves), clock)
                found.append(replace(pipeline, adaptive=need[0], choosing=need[1]))
    return found


def _expected(pairs: list, witnesses: list, scale: np.ndarray) -> float:
    """The error of images in independent pairs, each by its two witnesses: at least what those of a pair differ by,
    which is sure, where noise of the witnesses hides the rest."""
    errors = [
        error_of(x, w, scale) for pair, by in zip(pairs, witnesses, strict=True) for x, w in zip(pair, by, strict=True)
    ]
    return max(statistics.mean(errors), statistics.mean(noise_of(*pair, scale) for pair in pairs), 1e-9)


def _need(stack: GradientStack, clock: Callable[[], float]) -> tuple[float, float]:
    """What sharing samples out is expected to gain, and the seconds of each choice."""
    method = Adaptive().chosen_by(stack)
    start = clock()
    found = assess(stack, method)
    return gain(found.relative), max(clock() - start, 1e-9)


def methods_for(sampler: str, only: str = "auto") -> list[str]:
    """What may reconstruct the sampler's stacks, of what runs here."""
    names: tuple[str, ...] = WITH_GRADIENTS if SAMPLERS[sampler].gradients else WITHOUT
    if only != "auto":
        lack = METHODS[only].missing() if only in METHODS else f"there is no method '{only}'"
        if lack:
            raise NgptError(f"method '{only}' cannot be used: {lack}; name another, or auto")
        names = (only,) if SAMPLERS[sampler].gradients or "dx" not in METHODS[only].needs else ()
    return [m for m in names if not METHODS[m].missing()]


def _witnesses(primals: dict, noise: dict[str, float], sampler: str, half: int) -> list[np.ndarray]:
    """Two independent images that the sampler's other half has no part in: that ``half`` of its own, all of others."""
    sides = []
    for i in range(2):
        images = {n: (four[2 * i] + four[2 * i + 1]) / 2 for n, four in primals.items() if n != sampler}
        weights = {n: noise[n] / 2 for n in images}
        images[sampler], weights[sampler] = primals[sampler][2 * half + i], noise[sampler]
        fair = [n for n in images if not SAMPLERS[n].biased] or list(images)
        sides.append(mean_of({n: images[n] for n in fair}, weights))
    return sides


def choose(pipelines: Sequence[Pipeline], seconds: float) -> list[Pipeline]:
    """Those of which at least a sample fits into the time, the one to take first."""
    fit = [p for p in pipelines if p.samples(seconds) >= 1 and math.isfinite(p.expected(p.samples(seconds)))]
    return sorted(fit, key=lambda p: p.expected(p.samples(seconds)))


def explore(
    scene: mi.Scene,
    seconds: float = LONG,
    method: str = "auto",
    memory: int = DEFAULT_MEMORY,
    clock: Callable[[], float] = time.perf_counter,
) -> list[Pipeline]:
    """The pipelines of a scene, for an image of its size; see ``plan``, which chooses of them."""
    start = clock()
    names = candidates(scene)
    able = [n for n in sorted(dict.fromkeys([*names, "primal"]), key=_turn(names[0])) if methods_for(n, method)]
    if not able:
        raise NgptError(f"method '{method}' cannot use what the samplers of this scene render; name another, or auto")
    entry = SAMPLERS[able[0]]
    film_within(memory, scene.sensors()[0], 1 << 31, entry.lane_bytes, entry.batch)
    with at_most(scene, round(PIXELS * min(1.0, max(seconds / LONG, LEAST_PIXELS)))) as scale:
        found = try_pipelines(scene, able, lambda: clock() - start < SHARE * seconds, DEAREST * seconds, clock, method)
    return [replace(p, seconds=p.seconds * scale, after=p.after * scale, choosing=p.choosing * scale) for p in found]


@dataclass(frozen=True)
class Plan:
    """What to do with the seconds that are left, why, and the seconds that it took to know.

    ``sampler``, ``method``  of the image
    ``shared``               whether samples are to be shared out
    ``render``               seconds for the render, those of the method taken off
    """

    sampler: str
    method: str
    shared: bool
    render: float
    reason: str


def plan(
    scene: mi.Scene,
    seconds: float,
    method: str = "auto",
    memory: int = DEFAULT_MEMORY,
    clock: Callable[[], float] = time.perf_counter,
) -> Plan:
    """How to use so many ``seconds`` of the ``clock``, those of the pilot and of the method included.

    Of the ``method`` alone if it is not "auto". The pilot tries the sampler that the scene's description stands for,
    then ``primal``, then all unbiased others that ``--sampler auto`` compares, and begins none after a tenth of the
    time. The less time, the smaller are its images. What it measures changes from run to run. Raises NgptError for a
    method that does not run here or cannot use any of the stacks, and where nothing fits into the time.
    """
    start = clock()
    whole = explore(scene, seconds, method, memory, clock)
    left = seconds - (clock() - start)
    ranked = choose(whole, left)
    if not ranked:
        raise NgptError(f"nothing fits into {seconds:g} s, of which a pilot took {seconds - left:.2g} s; give more")
    first = ranked[0]
    return Plan(first.sampler, first.method, first.shared, left - first.after, _why(ranked, left))


def _turn(first: str) -> Callable[[str], int]:
    return lambda name: (first, "primal").index(name) if name in (first, "primal") else 2


def _why(ranked: Sequence[Pipeline], seconds: float) -> str:
    """A line: what is expected of the first, and of the best by each other sampler."""
    errors: dict[str, tuple[float, Pipeline]] = {}
    for p in ranked:
        errors.setdefault(p.sampler, (p.expected(p.samples(seconds)), p))
    (least, first), *others = errors.values()
    what = f"expected to leave an error of {math.sqrt(least):.2g} by '{first.method}'"
    rivals = [f"{math.sqrt(e):.2g} by '{p.sampler}' and '{p.method}'" for e, p in others]
    return ", ".join([what, *rivals])
