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
    """Raises NgptError if records would be wrong: for colours other than RGB, hidden emitters, and media."""
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
        """A context in which the sensor has this pose. All results must be evaluated within it."""
        now = Pose(sensor)
        now._to(self, sensor)
        try:
            yield
        finally:
            self._to(now, sensor)

    def _to(self, other: Pose, sensor: mi.Sensor) -> None:
        """Moves the sensor, which has this pose, to another pose."""
        changed = {k: v for k, v in other.values.items() if not np.array_equal(_numbers(v), _numbers(self.values[k]))}
        if changed:
            params = mi.traverse(sensor)
            params.update(changed)


def _numbers(value) -> np.ndarray:
    dr.eval(value)
    return np.array(getattr(value, "matrix", value))
