"""Frames by a sampler that remembers the frames before."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import mitsuba as mi
import numpy as np

from data_gen.budget import DEFAULT_MEMORY
from data_gen.render import options_as_attribute, stack_of
from data_gen.samplers import FrameSampler
from data_gen.scenes.facts import scene_facts
from data_gen.scenes.geometry import Geometry
from ngpt.errors import NgptError
from ngpt.stack import GradientStack


class Remembering:
    """The frames of one shot; ``options`` are as in ``render_stack``.

    ``changes``: whether more than the camera may change from frame to frame. Raises NgptError for options that the
    sampler does not have.
    """

    def __init__(
        self,
        entry: FrameSampler,
        changes: bool,
        spp: int | None,
        seed: int,
        options: dict[str, Any],
    ):
        self.entry, self.changes, self.seed, self.options = entry, changes, seed, dict(options)
        if self.options.pop("seconds", None) is not None:
            raise NgptError(f"sampler '{entry.name}' renders a number of samples, not for a time: use --spp")
        self.spp = spp or entry.spp
        self.memory = self.options.pop("memory", None) or DEFAULT_MEMORY
        self.diagnostics = self.options.pop("diagnostics", False)
        self.options.pop("stop", None)
        self.options = entry.settings(self.options)
        self._sampler: Any = None

    def render(
        self,
        scene: mi.Scene,
        shapes: Sequence[Geometry],
        index: int,
        motion: np.ndarray,
        depth: np.ndarray | None,
        progress: Callable[[int, int], None],
    ) -> GradientStack:
        """The stack of frame number ``index`` of the shot; the ``scene`` has its ``shapes`` there.

        Where the shot ``changes``, it is not the scene of the frame before, which must be as it was then.
        """
        start = time.perf_counter()
        if self._sampler is None:
            if reason := self.entry.refuses(scene_facts(scene)):
                raise NgptError(f"sampler '{self.entry.name}' cannot render this scene: {reason}; use --sampler gpt")
            self._sampler = self.entry.made(scene, self.seed, self.spp, self.memory, **self.options)
        progress(0, self.spp)
        film = self._sampler.film(index, motion, depth, (scene, shapes) if self.changes else None)
        more = {"ngpt:confidence": self._sampler.confidence} | options_as_attribute(self.entry, self.options)
        stack = stack_of(
            film, scene.sensors()[0], self.seed, self.entry.name, start, more, diagnostics=self.diagnostics
        )
        progress(self.spp, self.spp)
        return stack
