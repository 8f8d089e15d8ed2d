"""A camera as it was in an earlier frame."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import drjit as dr
import mitsuba as mi
import numpy as np


class Pose:
    """The parameters of a sensor, except for its film and its sampler."""

    def __init__(self, sensor: mi.Sensor):
        params = mi.traverse(sensor)
        names = [name for name in params.keys() if not name.startswith(("film.", "sampler."))]  # noqa: SIM118
        self.values = {name: type(params[name])(params[name]) for name in names}

    @contextmanager
    def of(self, sensor: mi.Sensor) -> Iterator[None]:
        """The sensor in this pose, for a while. What is computed with it must be evaluated before the end of that."""
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
