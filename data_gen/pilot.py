"""``--sampler auto`` where a scene's description leaves it open: small renders by each sampler that could do it.

Each sampler renders two small stacks. Where it has gradients, they are reconstructed by ``wcv``. The error of such an
image x, which a bias may be part of, is the mean of (x - a)(x - b) / (m² + 1e-3), where a and b are two independent
images by all other samplers together: their noise has no mean, as in ``ngpt.measure.metrics``. The error of a sampler
without gradients is its noise, half the mean squared difference of its two images. Errors fall as 1 / n with the number
of samples, so error times time says how long a sampler takes to a given error.

The image of a biased sampler (photons) is judged as a reconstruction is, and no biased sampler judges others. Its error
falls as n^(-2/3) only, so it is the time to the error that the scene's own sampler has at the end that counts. Where it
finds most of the light, those that judge it have much noise: twice the standard error is added to what they say. So it
is chosen where it is better beyond doubt, and not in scenes whose light it alone can find.

The difference of two reconstructions would not do: light that a sampler finds in one pixel of a thousand is an outlier,
which ``wcv`` takes out of both. What a pilot cannot see is light that none of the samplers has found.
"""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import dataclass

import mitsuba as mi
import numpy as np
from scipy.ndimage import uniform_filter

from data_gen.passes import DEFAULT_MEMORY, film_within
from data_gen.render import render_stack
from data_gen.samplers import SAMPLERS, choose
from data_gen.scenes.facts import scene_facts
from data_gen.scenes.load import set_film_size
from ngpt.errors import NgptError
from ngpt.measure.metrics import EPSILON, trimmed_mean
from ngpt.methods import reconstruct

# Samples per pixel of each of the two stacks; of a sampler with batches at least two of those
SPP = 8
# Pixels of a pilot; larger images are rendered smaller. In images with fewer than the other, chance would choose.
PIXELS, _LEAST_PIXELS = 1 << 16, 1 << 10
# Of what the whole render may take: after this share no trial is begun, and what each may take
SHARE, DEAREST = 0.05, 0.1
# Renders for which that is enough to compile the kernels of other samplers and to try them: by seconds, and by paths,
# of which a core or two make a million a second
_LEAST_SECONDS, _LEAST_PATHS = 100.0, 10**8
# Of the standard error of what is said of a biased sampler, and the power by which its errors fall
_DOUBT, _FALL = 2.0, 2 / 3
# A rival must need this much less time: a choice is not worth changing for what chance could have made.
_MARGIN = 1.25
# The worst pixels are left out, as ngpt.measure.metrics.relmse_trimmed does.
_TRIM = 0.001
# Seeds far from those that users take
SEED = 0x9E3779B9


@dataclass(frozen=True)
class Trial:
    """What a sampler did in a pilot.

    ``images``   its two images, (H, W, 3), reconstructed where it has gradients
    ``primals``  the same as they were rendered
    ``seconds``  of one of them, kernels compiled
    """

    images: tuple[np.ndarray, np.ndarray]
    primals: tuple[np.ndarray, np.ndarray]
    seconds: float


@dataclass(frozen=True)
class Choice:
    """The sampler to take, why, and the seconds that it took to know."""

    sampler: str
    reason: str
    seconds: float = 0.0


def candidates(scene: mi.Scene, biased: bool = False) -> list[str]:
    """What could render the scene: the sampler that its description stands for, and then those to be compared with.

    Those of them that are ``biased`` come last, if at all.
    """
    facts = scene_facts(scene)
    first, _ = choose(facts)
    if math.prod(int(n) for n in scene.sensors()[0].film().crop_size()) < _LEAST_PIXELS:
        return [first]
    able = [s for s in SAMPLERS.values() if s.name != first and s.tried and not s.refuses(facts)]
    return [first] + [s.name for kind in (False, True)[: 1 + biased] for s in able if s.biased == kind]


def choose_by_pilot(scene: mi.Scene, spp: int | None, seconds: float | None, memory: int = DEFAULT_MEMORY) -> Choice:
    """The sampler for a render of ``spp`` samples per pixel, or of so many ``seconds``; one of them may be None.

    The description alone decides, at no cost, where one sampler alone can render the scene, and where the render is too
    short for a pilot. What it measures changes from run to run, what it chooses hardly; the render itself has the bits
    of ``--sampler NAME``. Raises NgptError where no sampler with gradients can render the scene, and before anything is
    tried where the image does not fit into ``memory`` (MiB).
    """
    start = time.perf_counter()
    sampler, reason = choose(scene_facts(scene))
    able = candidates(scene, biased=True)
    if len(able) == 1:
        return Choice(sampler, reason)
    paths = math.inf if spp is None else spp * math.prod(int(n) for n in scene.sensors()[0].film().crop_size())
    if paths < _LEAST_PATHS or (seconds is not None and seconds < _LEAST_SECONDS):
        return Choice(sampler, f"{reason}; the render is too short to try others")
    entry = SAMPLERS[sampler]
    film_within(memory, scene.sensors()[0], spp or 1 << 31, entry.lane_bytes, entry.batch)
    with at_most(scene, PIXELS) as scale:
        first = try_out(scene, sampler)
        if first is None:
            return Choice(sampler, reason, time.perf_counter() - start)
        by_samples = math.inf if spp is None else first.seconds * spp / SPP * scale
        whole = min(by_samples, math.inf if seconds is None else seconds)
        trials = compare_with(scene, able, first, lambda: time.perf_counter() < start + SHARE * whole, DEAREST * whole)
    times, unsure = times_to_an_error(trials, whole / scale), doubtful(trials)
    best, why = judge(sampler, times)
    if best not in unsure:
        best, why = judge(sampler, {name: t for name, t in times.items() if name not in unsure})
        if unsure:
            names = " and ".join(f"'{name}'" for name in unsure)
            why += f"; the others find too little of the light to judge {names}"
    return Choice(best, why, time.perf_counter() - start)


def compare_with(
    scene: mi.Scene,
    names: list[str],
    first: Trial,
    goes_on: Callable[[], bool] = lambda: True,
    limit: float = math.inf,
) -> dict[str, Trial]:
    """The trials of samplers by name, the first of which is known, as far as there is time for them; each may take
    ``limit`` seconds."""
    trials = {names[0]: first}
    for i, name in enumerate(names[1:], 1):
        if not goes_on():
            break
        if (trial := try_out(scene, name, SEED + 2 * i, limit)) is not None:
            trials[name] = trial
    return trials


def try_out(scene: mi.Scene, sampler: str, seed: int = SEED, limit: float = math.inf) -> Trial | None:
    """Two small stacks by a sampler; None where it finds, of this scene, that it cannot render it, and where they are
    expected to take longer than the ``limit``."""
    spp, least = max(SPP, 2 * SAMPLERS[sampler].batch), max(1, SAMPLERS[sampler].batch)
    try:
        render_stack(scene, 1, seed, sampler)  # compiles
    except NgptError:
        return None
    if limit < math.inf:
        start = time.perf_counter()
        render_stack(scene, least, seed, sampler)
        if 2 * spp / least * (time.perf_counter() - start) > limit:
            return None
    stacks, seconds = [], []
    for i in range(2):
        start = time.perf_counter()
        stacks.append(render_stack(scene, spp, seed + i, sampler))
        seconds.append(time.perf_counter() - start)
    method = "wcv" if SAMPLERS[sampler].gradients else "primal"
    images, primals = ([reconstruct(stack, m).image for stack in stacks] for m in (method, "primal"))
    return Trial((images[0], images[1]), (primals[0], primals[1]), min(seconds))


def times_to_an_error(trials: dict[str, Trial], seconds: float = math.inf) -> dict[str, float]:
    """Seconds that each sampler of a pilot, the first of which is unbiased, takes to an error of 1; no more than their
    ratios are of use. Those of biased samplers are of a render, as large as the pilot's, that takes so many ``seconds``
    by the first."""
    noise, scale = _noise_and_scale(trials)
    times: dict[str, float] = {}
    for name, trial in trials.items():
        error = noise_of(*trial.primals, scale)
        if SAMPLERS[name].biased:
            error, doubt = _judged(trials, name, noise, scale)
            error += _DOUBT * doubt
        elif SAMPLERS[name].gradients and len(_fair(trials, name)):
            error, _ = _judged(trials, name, noise, scale)
        times[name] = max(error, 1e-9) * trial.seconds
        if SAMPLERS[name].biased:
            first, power = next(iter(times.values())), 1 / _FALL
            times[name] = first * trial.seconds * (max(error, 1e-9) / first) ** power * seconds ** (power - 1)
    return times


def doubtful(trials: dict[str, Trial]) -> list[str]:
    """The biased samplers of whose error the others are not sure, since they find too little of the light."""
    noise, scale = _noise_and_scale(trials)
    judged = {name: _judged(trials, name, noise, scale) for name in trials if SAMPLERS[name].biased}
    return [name for name, (error, doubt) in judged.items() if _DOUBT * doubt > error]


def _noise_and_scale(trials: dict[str, Trial]) -> tuple[dict[str, float], np.ndarray]:
    """The noise of each sampler's image, and what errors are relative to: of all samplers, those with little noise
    count most, as they do as witnesses."""
    middle = sum((a + b) / 2 for a, b in (trial.primals for trial in trials.values())) / len(trials)
    noise = {name: max(noise_of(*trial.primals, middle), 1e-12) for name, trial in trials.items()}
    return noise, mean_of({name: (trial.primals[0] + trial.primals[1]) / 2 for name, trial in trials.items()}, noise)


def _fair(trials: dict[str, Trial], name: str) -> list[str]:
    """Who may judge a sampler: all others that are unbiased."""
    return [other for other in trials if other != name and not SAMPLERS[other].biased]


def _judged(trials: dict[str, Trial], name: str, noise: dict[str, float], scale: np.ndarray) -> tuple[float, float]:
    """The error of a sampler's images by the others, and the standard error of that."""
    others = _fair(trials, name)
    witnesses = [mean_of({o: trials[o].primals[i] for o in others}, noise) for i in range(2)]
    error = statistics.mean(error_of(image, witnesses, scale) for image in trials[name].images)
    # What its two images differ by is sure, where noise of the others hides the rest.
    error = max(error, noise_of(*trials[name].images, scale))
    return error, doubt_of(trials[name].images[0], witnesses, scale)


def judge(default: str, times: dict[str, float]) -> tuple[str, str]:
    """The sampler of the least of the ``times``, but the ``default`` unless that is clearly worse; and why."""
    best = min(times, key=lambda name: times[name])
    if times[best] * _MARGIN > times[default]:
        best = default
    others = [f"{times[name] / times[best]:.2g} times as long by '{name}'" for name in times if name != best]
    found = f"to a given error it takes {', '.join(others)}" if others else "there was time for no other"
    return best, f"chosen by a pilot: {found}"


def mean_of(images: dict[str, np.ndarray], noise: dict[str, float]) -> np.ndarray:
    """Of images by name, weighted by 1 / their noise."""
    weights = {name: 1 / noise[name] for name in images}
    return sum(weights[name] * image for name, image in images.items()) / sum(weights.values())


def noise_of(a: np.ndarray, b: np.ndarray, scale: np.ndarray) -> float:
    """The relMSE of each of two independent unbiased images, by their difference; trimmed as the metric is."""
    errors = np.square(a - b) / 2 / _denominator(scale)
    return trimmed_mean(errors, errors, _TRIM)


def error_of(x: np.ndarray, witnesses: list[np.ndarray], scale: np.ndarray) -> float:
    """The relMSE of an image by two independent unbiased ones; trimmed as the metric is."""
    a, b = witnesses
    under = _denominator(scale)
    return trimmed_mean((x - a) * (x - b) / under, np.square(x - (a + b) / 2) / under, _TRIM)


def doubt_of(x: np.ndarray, witnesses: list[np.ndarray], scale: np.ndarray) -> float:
    """The standard error of ``error_of``, by how much pixels differ."""
    a, b = witnesses
    values = ((x - a) * (x - b) / _denominator(scale)).mean(axis=-1)
    return float(values.std()) / math.sqrt(values.size)


def _denominator(scale: np.ndarray) -> np.ndarray:
    """m² + 1e-3 of an image that has noise itself, which the mean over 7x7 pixels lessens."""
    return uniform_filter(scale.astype(np.float64), (7, 7, 1)) ** 2 + EPSILON


@contextmanager
def at_most(scene: mi.Scene, pixels: int):
    """While in it, images of the scene have no more ``pixels``; yields how many times more they have without it.

    A cropped film stays as it is: its window could not be set again.
    """
    film = scene.sensors()[0].film()
    size, window = (tuple(int(n) for n in numbers) for numbers in (film.size(), film.crop_size()))
    shrink = math.sqrt(pixels / (size[0] * size[1]))
    if shrink >= 1 or size != window:
        yield 1.0
        return
    small = tuple(max(1, round(n * shrink)) for n in size)
    set_film_size(scene, small)
    try:
        yield size[0] * size[1] / (small[0] * small[1])
    finally:
        set_film_size(scene, size)
