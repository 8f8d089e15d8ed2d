"""``--sampler auto`` where a scene's description leaves it open: small renders by each sampler that could do it.

Stacks with gradients are reconstructed by ``wcv``, images without stay as they are: the whole way to an image
(``data_gen.choosing.pipelines``) with one method for each sampler, and even samples. What is compared is the time to
the error that the scene's own sampler is expected to have at the end.

Photons are chosen where they are better beyond doubt, and not in scenes whose light they alone can find. What a pilot
cannot see is light that none of the samplers has found.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass

import mitsuba as mi

from data_gen.choosing.pipelines import Pipeline, measure
from data_gen.choosing.trials import PIXELS, Trial, at_most, candidates, try_all
from data_gen.passes import DEFAULT_MEMORY, film_within
from data_gen.samplers import SAMPLERS, choose
from data_gen.scenes.facts import scene_facts

# Of what the whole render may take: after this share no trial is begun, and what each may take
SHARE, DEAREST = 0.05, 0.15
# Renders for which that is enough to compile the kernels of other samplers and to try them: by seconds, and by paths,
# of which a core or two make a million a second
_LEAST_SECONDS, _LEAST_PATHS = 100.0, 10**8
# A rival must need this much less time: a choice is not worth changing for what chance could have made.
_MARGIN = 1.1


@dataclass(frozen=True)
class Choice:
    """The sampler to take, why, and the seconds that it took to know."""

    sampler: str
    reason: str
    seconds: float = 0.0


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
        trials = try_all(scene, able[:1])
        if not trials:
            return Choice(sampler, reason, time.perf_counter() - start)
        by_samples = math.inf if spp is None else trials[sampler].seconds * spp * scale
        whole = min(by_samples, math.inf if seconds is None else seconds)
        trials |= try_all(scene, able[1:], lambda: time.perf_counter() < start + SHARE * whole, DEAREST * whole)
    best, why = best_of(seen(trials), whole / scale)
    return Choice(best, why, time.perf_counter() - start)


def simple(sampler: str) -> str:
    """The method by which samplers are compared."""
    return "wcv" if SAMPLERS[sampler].gradients else "primal"


def seen(trials: dict[str, Trial]) -> list[Pipeline]:
    """What the trials say of each sampler with its simple method."""
    return measure(trials, methods=lambda sampler: [simple(sampler)], shared=False)


def best_of(pipelines: Sequence[Pipeline], seconds: float) -> tuple[str, str]:
    """The sampler to take for a render of so many ``seconds``, of the pilot's size, and why; the first is the scene's
    own."""
    times, unsure = times_to_the_end(pipelines, seconds), [p.sampler for p in pipelines if p.doubtful]
    best, why = judge(pipelines[0].sampler, times)
    if best not in unsure:
        best, why = judge(pipelines[0].sampler, {name: t for name, t in times.items() if name not in unsure})
        if unsure:
            names = " and ".join(f"'{name}'" for name in unsure)
            why += f"; the others find too little of the light to judge {names}"
    return best, why


def times_to_the_end(pipelines: Sequence[Pipeline], seconds: float) -> dict[str, float]:
    """Seconds that each sampler takes to the error that the first has after so many of them."""
    first = pipelines[0]
    # Of methods as quick as these, what they take is no part.
    error = first.expected(max(first.least, seconds / first.seconds))
    return {p.sampler: p.needed(error) * p.seconds for p in pipelines}


def judge(default: str, times: dict[str, float]) -> tuple[str, str]:
    """The sampler of the least of the ``times``, but the ``default`` unless that is clearly worse; and why."""
    best = min(times, key=lambda name: times[name])
    if times[best] * _MARGIN > times[default]:
        best = default
    others = [f"{times[name] / times[best]:.2g} times as long by '{name}'" for name in times if name != best]
    found = f"to a given error it takes {', '.join(others)}" if others else "there was time for no other"
    return best, f"chosen by a pilot: {found}"
