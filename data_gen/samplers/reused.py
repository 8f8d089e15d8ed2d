"""Samplers that several renders of one scene share, so that their kernels are recorded only once.

Small images, such as crops of a training set, take less time to render than their kernels take to record.
"""

from __future__ import annotations

import logging
from typing import Any

import mitsuba as mi

from data_gen.passes import SamplePass
from data_gen.paths.frozen import leaves
from data_gen.samplers.registry import Sampler
from ngpt.errors import stop_if_interrupted

_LOG = logging.getLogger(f"ngpt.{__name__}")

# Parameters of the film that kernels read from arrays of the camera, so a change of them needs no new kernel
_IN_ARRAYS = ("film.size", "film.crop_offset")


class Made:
    """The newest sampler of each name.

    A kept sampler stays valid if only the camera moves; after any other change a new sampler is made.
    """

    def __init__(self) -> None:
        self._kept: dict[str, tuple[Any, SamplePass]] = {}

    def sampler(self, entry: Sampler, scene: mi.Scene, options: dict[str, Any]) -> SamplePass:
        """Returns the kept sampler if it is still valid, or else a new one. ``options`` are for ``entry.make``."""
        if entry.name in self._kept:
            key, sample = self._kept[entry.name]
            if key == _key(scene, options):
                return sample
        return entry.make(scene, **options)

    def keep(self, entry: Sampler, scene: mi.Scene, options: dict[str, Any], sample: SamplePass) -> None:
        """Keeps a sampler after a render.

        Two kinds are not kept: samplers that choose lamps for the current view (``places``), and samplers whose pixels
        all need the same number of samples (``even``), since they may carry state from pass to pass.

        A failure here only gives a warning, since the render already has all its samples. The next render then makes a
        new sampler.
        """
        if entry.even or "places" in options:
            return
        try:
            self._kept[entry.name] = (_key(scene, options), sample)
        except Exception as error:
            stop_if_interrupted(error)
            _LOG.warning("the sampler is not kept for the next render: %s: %s", type(error).__name__, error)


def _key(scene: mi.Scene, options: dict[str, Any]) -> tuple:
    """All values on which a recorded kernel depends, except arrays of the camera.

    Numbers are compared by value, arrays by identity.
    """
    camera = scene.sensors()[0]
    of_scene, of_camera = map(_values, (scene, camera))
    numbers = {key: value for key, value in of_camera.items() if not leaves(value) and key not in _IN_ARRAYS}
    others = {key: value for key, value in of_scene.items() if not key.startswith(f"{camera.id()}.")}
    return options, camera.class_name(), {key: _Same(value) for key, value in (numbers | others).items()}


def _values(thing: mi.Object) -> dict[str, Any]:
    """The parameters of a scene or a camera by name.

    ``mi.SceneParameters`` fails if a parameter is None, such as ``sigma_a`` of hair whose colour comes from melanin.
    """
    found = mi.traverse(thing).properties.items()
    return {
        name: value if kind is None else mi.get_property(value, kind, node) for name, (value, kind, node, _) in found
    }


class _Same:
    """The value of a parameter, for comparisons.

    It keeps the arrays alive, since Dr.Jit gives the index of a freed array to another array.
    """

    def __init__(self, value: Any):
        self.arrays = leaves(value)
        self.identity = [array.index for array in self.arrays] or repr(value)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Same) and self.identity == other.identity
