"""Samplers that renders of one scene share: their kernels are recorded once for all of them.

Small images, such as crops of a training set, take less time to render than to record.
"""

from __future__ import annotations

from typing import Any

import mitsuba as mi

from data_gen.passes import SamplePass
from data_gen.paths.frozen import leaves
from data_gen.samplers.registry import Sampler

# Numbers of a film that the arrays of a camera hold, and no kernel
_IN_ARRAYS = ("film.size", "film.crop_offset")


class Made:
    """The newest sampler of each name. The camera may move between renders; any other change needs a new one."""

    def __init__(self) -> None:
        self._kept: dict[str, tuple[Any, SamplePass]] = {}

    def sampler(self, entry: Sampler, scene: mi.Scene, options: dict[str, Any]) -> SamplePass:
        """What ``entry.make`` makes, or has made. ``options`` are the sampler's own."""
        if entry.name in self._kept:
            key, sample = self._kept[entry.name]
            if key == _key(scene, options):
                return sample
        return entry.make(scene, **options)

    def keep(self, entry: Sampler, scene: mi.Scene, options: dict[str, Any], sample: SamplePass) -> None:
        """To be called after a render. Samplers that know the view, or remember passes, are not kept."""
        if not entry.even and "places" not in options:
            self._kept[entry.name] = (_key(scene, options), sample)


def _key(scene: mi.Scene, options: dict[str, Any]) -> tuple:
    """What a recorded kernel depends on, except arrays of the camera: numbers by value, arrays by identity."""
    camera = scene.sensors()[0]
    of_scene, of_camera = ({key: params[key] for key in params.keys()} for params in map(mi.traverse, (scene, camera)))  # noqa: SIM118
    numbers = {key: value for key, value in of_camera.items() if not leaves(value) and key not in _IN_ARRAYS}
    others = {key: value for key, value in of_scene.items() if not key.startswith(f"{camera.id()}.")}
    return options, camera.class_name(), {key: _Same(value) for key, value in (numbers | others).items()}


class _Same:
    """The value of a parameter, to be compared.

    It holds the arrays, since Dr.Jit gives their indices to others once they are gone.
    """

    def __init__(self, value: Any):
        self.arrays = leaves(value)
        self.identity = [array.index for array in self.arrays] or repr(value)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Same) and self.identity == other.identity
