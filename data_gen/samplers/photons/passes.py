"""The state shared by the passes of one render, for integrators that gather photons."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi

from data_gen.film import GradientFilm
from data_gen.paths.camera import CameraSamples
from data_gen.paths.features import features
from data_gen.paths.frozen import Frozen
from data_gen.paths.light_ends import World


@dataclass
class Passes:
    """The passes of a render, and the memory of one pass.

    ``integrator`` has ``sample_pass(passes, camera, film)``, ``lane_bytes`` and ``instead(lane_bytes)``. ``instead``
    gives advice, besides a smaller image, that makes a camera sample fit into this number of bytes.
    """

    integrator: Any
    world: World
    width: float  # of a pixel, in world units, see ``map.radius.pixel_width``
    frozen: Frozen = field(init=False)

    def __post_init__(self) -> None:
        self.frozen = Frozen(self.world.scene, self.world, self.integrator)

    def __call__(self, camera: CameraSamples, film: GradientFilm) -> None:
        self.integrator.sample_pass(self, camera, film)

    @property
    def lane_bytes(self) -> int:
        return self.integrator.lane_bytes

    def instead(self, lane_bytes: int) -> str:
        return self.integrator.instead(lane_bytes)


@dataclass
class Start:
    """The start of camera paths."""

    ray: mi.RayDifferential3f
    importance: mi.Spectrum
    random: Any  # the stream of random numbers of the paths


def begun(passes: Passes, camera: CameraSamples) -> tuple[Start, dict]:
    """The start of the camera paths of a pass, and the layers of their features."""
    ray, importance, _ = camera.rays()
    random = camera.random.clone()
    dr.eval(ray, importance)
    layers = passes.frozen(features, passes.world.scene, camera.sensor, camera.random, ray)
    return Start(ray, importance, random), layers
