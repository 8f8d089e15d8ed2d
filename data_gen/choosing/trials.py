"""Trials of samplers on a scene: small stacks, the seconds of a sample, and the error of an image without a reference.

The error of an image x, including its bias, is estimated as the mean of (x - a)(x - b) / (m² + 1e-3), where m is a
local mean of the scene's light. The images a and b are independent of x and of each other, so their noise cancels in
the mean, as in ``ngpt.measure.metrics``. They are made from the primals of the sampler's other stacks and of all other
unbiased samplers. Comparing two reconstructions from the same sampler would hide part of the error. If the sampler
finds some light in only one pixel of a thousand, the reconstruction method removes it as an outlier from both images,
so both lack it and they agree.

The time of a sample is measured in processor seconds, which other work on the machine hardly changes, so a busy moment
favours no sampler. But users state their time budget in wall-clock seconds. One factor for all trials converts
processor seconds to wall-clock seconds: the wall-clock seconds of one sample, summed over all trials, divided by the
sum of their processor seconds.
"""

from __future__ import annotations

import math
import statistics
import time
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import mitsuba as mi
import numpy as np

from data_gen.render import render_stack
from data_gen.samplers import SAMPLERS, SIMPLE, described, tried
from data_gen.scenes.facts import scene_facts
from ngpt.errors import NgptError
from ngpt.measure.metrics import EPSILON, trimmed_mean
from ngpt.stack import GradientStack
from ngpt.system.late import ndimage

# Samples per pixel of each stack of a trial. A sampler whose samples come in batches takes at least two batches.
SPP = 8
# Largest image, in pixels, for the trial renders (the pilot). Scenes with fewer pixels than the second number get no
# pilot, because its result would be mostly random.
PIXELS, _LEAST_PIXELS = 1 << 16, 1 << 10
# The worst pixels are left out, as ngpt.measure.metrics.relmse_trimmed does.
_TRIM = 0.001
# The seeds of trials begin here, because users are unlikely to take such large seeds
SEED = 0x9E3779B9


@dataclass(frozen=True)
class Trial:
    stacks: list[GradientStack]  # four, with the same number of samples each
    seconds: float  # wall-clock seconds of one sample per pixel of the whole image
    # The same in processor seconds, summed over all cores; 0 if not known, or if a graphics card renders
    processor: float = 0.0


@dataclass(frozen=True)
class Pilot:
    """How trials are run: the clock, callbacks for progress and for stopping, and whether renders must be unbiased
    (paths then share no cached light).
    """

    clock: Callable[[], float] = time.perf_counter
    said: Callable[[str], None] = lambda line: None  # called with a line for the user before each trial
    stop: Callable[[], bool] = lambda: False  # asked between renders; True ends the trials
    unbiased: bool = False  # as in ``data_gen.render.render_stack``


def candidates(scene: mi.Scene, biased: bool = False, gradients: bool = False) -> list[str]:
    """Samplers that could render the scene: the one that its description suggests, then the ones to compare it with.

    If the suggestion is the default (``SIMPLE``), it is only compared with samplers that find light which the default
    hardly finds. ``biased`` adds biased samplers at the end. With ``gradients`` the only candidate is the sampler that
    renders gradients.
    """
    facts = scene_facts(scene)
    first, method, _ = described(facts, gradients)
    if gradients or math.prod(int(n) for n in scene.sensors()[0].film().crop_size()) < _LEAST_PIXELS:
        return [first]
    able = [s for s in tried(facts) if s.name != first and (s.finds or (first, method) != SIMPLE)]
    return [first] + [s.name for kind in (False, True)[: 1 + biased] for s in able if s.biased == kind]


def try_all(
    scene: mi.Scene,
    samplers: Sequence[str],
    budget: Callable[[dict[str, Trial]], float] = lambda trials: math.inf,
    first: float = math.inf,
    pilot: Pilot = Pilot(),
) -> dict[str, Trial]:
    """The trials of the samplers that can render the scene, by name of sampler.

    ``budget`` is called with the trials so far, and returns the seconds that all trials may take together. A trial
    whose compilation and render would not fit into the remaining time is left out. The first sampler has its own time
    budget, ``first``, and is always compiled.
    """
    clock, stop = pilot.clock, pilot.stop
    start, slow = clock(), 1.0
    trials: dict[str, Trial] = {}
    for i, name in enumerate(samplers):
        rest = (budget(trials) if i else first) - (clock() - start)
        compiles = SAMPLERS[name].compiles
        if i and slow * compiles > rest:
            continue
        pilot.said(f"pilot: trying '{name}'; compiling its kernels may take {slow * compiles:.0f} s")
        begins = clock()
        trial, compiled = try_out(scene, name, rest, pilot)
        if stop():
            break
        # A scene of many materials, or a busy machine, also slows down the next trial. If the kernels were already
        # cached, the measured time is short and says nothing about the machine, so `slow` never falls.
        slow = max(slow, (compiled - begins) / compiles)
        if trial is not None:
            trials[name] = trial
    return by_processor(trials)


def seed_of(sampler: str) -> int:
    """The first of the eight consecutive seeds that are reserved for a sampler's trial.

    It is derived from the sampler's name, so it does not depend on which other samplers are tried.
    """
    return SEED + 8 * zlib.crc32(sampler.encode())


def by_processor(trials: dict[str, Trial]) -> dict[str, Trial]:
    """Makes the seconds of trials proportional to their processor seconds, without changing the sum of the seconds."""
    if not trials or not all(trial.processor for trial in trials.values()):
        return trials
    wall = sum(trial.seconds for trial in trials.values()) / sum(trial.processor for trial in trials.values())
    return {name: replace(trial, seconds=trial.processor * wall) for name, trial in trials.items()}


def try_out(
    scene: mi.Scene, sampler: str, limit: float = math.inf, pilot: Pilot = Pilot()
) -> tuple[Trial | None, float]:
    """The trial of a sampler, and the time at which its kernels were compiled.

    The trial is None if the sampler cannot render the scene, if the stacks would take longer than ``limit`` seconds, or
    if the pilot was stopped.
    """
    clock, unbiased, begins = pilot.clock, pilot.unbiased, pilot.clock()
    batch = SAMPLERS[sampler].batch
    spp, seed = max(SPP, 2 * batch), seed_of(sampler)
    # Timing a second render with a different number of samples separates start-up time from time per sample.
    other = batch or 2 * SPP
    try:
        render_stack(scene, 1, seed, sampler, unbiased=unbiased)
    except NgptError:
        return None, clock()
    compiled = clock()
    if compiled - begins > limit / 2:
        # Each of the stacks would take a large part of the time of this first render again.
        return None, compiled

    def timed(n: int, seed: int) -> tuple[GradientStack, tuple[float, float]]:
        start, busy = clock(), time.process_time()
        stack = render_stack(scene, n, seed, sampler, unbiased=unbiased)
        # On a graphics card, processor seconds do not measure the cost of the samples.
        return stack, (clock() - start, time.process_time() - busy if mi.variant().startswith("llvm") else 0.0)

    made: list[tuple[GradientStack, tuple[float, float]]] = []
    others: list[tuple[float, float]] = []
    for i in range(4):
        if pilot.stop():
            return None, compiled
        made.append(timed(spp, seed + i))
        if i == 0 and (4 + 2 * other / spp) * made[0][1][0] > limit - (compiled - begins):
            return None, compiled
        if i % 2:
            others.append(timed(other, seed + 4 + i)[1])
    each = []
    for i in range(2):
        seconds = statistics.median(took[i] for _, took in made)
        further = (statistics.median(took[i] for took in others) - seconds) / (other - spp)
        each.append(max(further, 0.2 * seconds / spp))
    return Trial([stack for stack, _ in made], *each), compiled


@dataclass(frozen=True)
class Witnesses:
    """The images that the images of each sampler are compared with, to estimate their errors."""

    primals: dict[str, list[np.ndarray]]  # four images of each sampler, by name of sampler
    noise: dict[str, float]  # the relMSE of a single primal, by name of sampler
    scale: np.ndarray  # the mean of all primals, weighted by 1 / noise; errors are relative to this image

    @classmethod
    def of(cls, trials: dict[str, Trial]) -> Witnesses:
        primals = {name: [stack["primal"].astype(np.float64) for stack in t.stacks] for name, t in trials.items()}
        means = {name: np.asarray(sum(images)) / 4 for name, images in primals.items()}
        middle = np.asarray(sum(means.values())) / len(primals)
        noise = {name: max(noise_of(images[0], images[1], middle), 1e-12) for name, images in primals.items()}
        return cls(primals, noise, mean_of(means, noise))

    def against(self, sampler: str, half: int) -> tuple[np.ndarray, np.ndarray]:
        """Two independent images from all unbiased samplers. Of ``sampler`` itself, only one ``half`` of its stacks is
        used. The biased samplers are used too if every sampler is biased.
        """
        names = [*(n for n in self.primals if n != sampler), sampler]
        fair = [n for n in names if not SAMPLERS[n].biased] or names
        noise = {n: self.noise[n] if n == sampler else self.noise[n] / 2 for n in fair}

        def side(i: int) -> np.ndarray:
            images = {n: (four[2 * i] + four[2 * i + 1]) / 2 for n, four in self.primals.items()}
            images[sampler] = self.primals[sampler][2 * half + i]
            return mean_of({n: images[n] for n in fair}, noise)

        return side(0), side(1)

    def error(self, sampler: str, halves: Sequence[Sequence[np.ndarray]]) -> float:
        """The mean error of images by ``sampler``. ``halves`` holds one or two images from each half of its stacks.

        The result is never less than the noise measured between the two images of a half (or between the halves, if
        each has one image). So it cannot be too small where the other samplers are too noisy to reveal the error.
        """
        judged = [
            error_of(image, *self.against(sampler, 1 - half), self.scale)
            for half, images in enumerate(halves)
            for image in images
        ]
        pairs = [(images[0], images[1]) for images in (halves if len(halves[0]) > 1 else [[h[0] for h in halves]])]
        return max(statistics.mean(judged), statistics.mean(noise_of(a, b, self.scale) for a, b in pairs), 1e-9)

    def doubt(self, sampler: str, image: np.ndarray) -> float:
        """The standard error of the estimated error of an ``image`` from the first half of the stacks."""
        a, b = self.against(sampler, 1)
        values = ((image - a) * (image - b) / _denominator(self.scale)).mean(axis=-1)
        return float(values.std()) / math.sqrt(values.size)


def mean_of(images: dict[str, np.ndarray], noise: dict[str, float]) -> np.ndarray:
    """The mean of images by name, weighted by 1 / noise."""
    weights = {name: 1 / noise[name] for name in images}
    return np.asarray(sum(weights[name] * image for name, image in images.items())) / sum(weights.values())


def noise_of(a: np.ndarray, b: np.ndarray, scale: np.ndarray) -> float:
    """The relMSE of one of two independent, unbiased, equally noisy images, estimated from their difference.

    The worst pixels are left out, as in the metric.
    """
    errors = np.square(a - b) / 2 / _denominator(scale)
    return trimmed_mean(errors, errors, _TRIM)


def error_of(x: np.ndarray, a: np.ndarray, b: np.ndarray, scale: np.ndarray) -> float:
    """The relMSE of image x, estimated with the help of two independent unbiased images a and b.

    The worst pixels are left out, as in the metric.
    """
    under = _denominator(scale)
    return trimmed_mean((x - a) * (x - b) / under, np.square(x - (a + b) / 2) / under, _TRIM)


def _denominator(scale: np.ndarray) -> np.ndarray:
    """m² + 1e-3. Here m is ``scale`` averaged over 7x7 pixels, because ``scale`` itself is noisy."""
    return ndimage.uniform_filter(scale.astype(np.float64), (7, 7, 1)) ** 2 + EPSILON
