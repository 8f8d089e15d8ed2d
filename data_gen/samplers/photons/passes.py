"""What the passes of one render share, for integrators that gather photons."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import mitsuba as mi

from data_gen.film import GradientFilm
from data_gen.paths.camera import CameraSamples
from data_gen.paths.frozen import Frozen
from data_gen.paths.vertex import Materials
from data_gen.samplers.bdpt.lights import LightEnds


@dataclass
class Passes:
    """The passes of a render, and the memory that one takes.

    ``integrator`` has ``sample_pass(passes, camera, film)``, ``lane_bytes`` and ``instead(lane_bytes)``: what else than
    a smaller image would fit into so many bytes for each camera sample.
    """

    integrator: Any
    scene: mi.Scene
    lights: LightEnds
    materials: Materials
    width: float  # of a pixel
    frozen: Frozen = field(init=False)

    def __post_init__(self) -> None:
        self.frozen = Frozen(self.scene, self.lights, self.materials, self.integrator)

    def __call__(self, camera: CameraSamples, film: GradientFilm) -> None:
        self.integrator.sample_pass(self, camera, film)

    @property
    def lane_bytes(self) -> int:
        return self.integrator.lane_bytes

    def instead(self, lane_bytes: int) -> str:
        return self.integrator.instead(lane_bytes)
