"""A scene in the state of one frame."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from data_gen.samplers.gpt.plan import Plan
from data_gen.scenes.geometry import Geometry
from ngpt.errors import NgptError


@dataclass
class Stage:
    """A scene in the state of one frame; ``shapes`` are its shapes, in their order."""

    scene: mi.Scene
    plan: Plan
    sensor: mi.Sensor
    shapes: Sequence[Geometry] = ()


def check(plan: Plan) -> None:
    """Raises NgptError where records would be wrong: other colours than RGB, lamps that hide from the camera, media."""
    if not mi.is_rgb or mi.is_polarized:
        raise NgptError(f"restir: records hold RGB, and the variant is '{mi.variant()}'; use 'llvm_ad_rgb'")
    if plan.limits.hide_emitters:
        raise NgptError("restir: hidden emitters are not supported; leave out hide_emitters")
    if plan.space.media:
        raise NgptError("restir: media are not supported; use --sampler gpt")


class Pose:
    """The parameters of a sensor, except for its film and its sampler."""

    def __init__(self, sensor: mi.Sensor):
        params = mi.traverse(sensor)
        names = [name for name in params.keys() if not name.startswith(("film.", "sampler."))]  # noqa: SIM118
        self.values = {name: type(params[name])(params[name]) for name in names}

    @contextmanager
    def of(self, sensor: mi.Sensor) -> Iterator[None]:
        """The sensor in this pose, for a while. Evaluate all results within the block."""
        now = Pose(sensor)
        now._to(self, sensor)
        try:
            yield
        finally:
            self._to(now, sensor)

    def _to(self, other: Pose, sensor: mi.Sensor) -> None:
        """From this pose, which the sensor has, to another."""
        changed = {k: v for k, v in other.values.items() if not np.array_equal(_numbers(v), _numbers(self.values[k]))}
        if changed:
            params = mi.traverse(sensor)
            params.update(changed)


def _numbers(value) -> np.ndarray:
    dr.eval(value)
    return np.array(getattr(value, "matrix", value))
