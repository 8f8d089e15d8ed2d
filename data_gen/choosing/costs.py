"""What samples cost on this machine: stacks that are compared at equal time, and their seconds."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

import mitsuba as mi

from data_gen.render import render_stack
from ngpt.stack import GradientStack

# What "time" may be: of the wall, or of this process on all processors, which other work on the machine does not change
CLOCKS: dict[str, Callable[[], float]] = {"wall": time.perf_counter, "processor": time.process_time}


def warm_up(scene: mi.Scene, options: Mapping[str, Any]) -> GradientStack:
    """Compiles the kernels of a render, which do not depend on the number of samples; returns a stack of one sample.

    ``options`` go to ``render_stack``. Raises NgptError for a sampler that cannot render this scene.
    """
    return render_stack(scene, 1, 0, **options)


def timed(
    scene: mi.Scene, options: Mapping[str, Any], spp: int, seed: int, clock: str = "wall"
) -> tuple[GradientStack, float]:
    """A stack and its seconds by one of ``CLOCKS``."""
    start = CLOCKS[clock]()
    stack = render_stack(scene, spp, seed, **options)
    return stack, CLOCKS[clock]() - start


def measure(
    scene: mi.Scene,
    renders: Mapping[str, Mapping[str, Any]],
    spp: int,
    repeats: int,
    seed: int = 0,
    clock: str = "wall",
) -> tuple[dict[str, list[float]], GradientStack]:
    """Seconds per sample of the whole image for each render, name -> options, and the last stack of the first of them.

    Seconds are by one of ``CLOCKS``. Each is rendered ``repeats`` times, with seeds from ``seed`` on, in turn, so that
    a busy moment hits all alike.
    """
    seconds: dict[str, list[float]] = {name: [] for name in renders}
    first = next(iter(renders))
    for options in renders.values():
        warm_up(scene, options)
    for i in range(repeats):
        for name, options in renders.items():
            rendered, duration = timed(scene, options, spp, seed + i, clock)
            seconds[name].append(duration / spp)
            if name == first:
                stack = rendered
    return seconds, stack
