"""What samples cost on this machine: the kinds of stacks that are compared at equal time, and their seconds."""

from __future__ import annotations

import time
from typing import Any

import mitsuba as mi

from data_gen.render import render_stack
from ngpt.stack import GradientStack

# Kind of stack -> how it is rendered: with gradients; path tracing with albedo, normal and depth; path tracing alone.
KINDS: dict[str, dict[str, Any]] = {
    "gradients": {"sampler": "auto"},
    "features": {"sampler": "primal"},
    "path": {"sampler": "primal", "with_features": False},
}


def warm_up(scene: mi.Scene, kind: str) -> None:
    """Has the kernels of a kind compiled; the number of samples is no part of them."""
    render_stack(scene, 1, 0, **KINDS[kind])


def timed(scene: mi.Scene, kind: str, spp: int, seed: int) -> tuple[GradientStack, float]:
    """A stack and its wall-clock seconds."""
    start = time.perf_counter()
    stack = render_stack(scene, spp, seed, **KINDS[kind])
    return stack, time.perf_counter() - start


def measure(scene: mi.Scene, spp: int, repeats: int) -> tuple[dict[str, list[float]], GradientStack]:
    """Seconds per sample per pixel count of each kind, ``repeats`` times in turn, and the last stack with gradients.

    In turn, so that a busy moment hits all kinds alike.
    """
    seconds: dict[str, list[float]] = {kind: [] for kind in KINDS}
    for kind in KINDS:
        warm_up(scene, kind)
    for seed in range(repeats):
        for kind in KINDS:
            rendered, duration = timed(scene, kind, spp, seed)
            seconds[kind].append(duration / spp)
            if kind == "gradients":
                stack = rendered
    return seconds, stack
