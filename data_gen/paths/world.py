"""What paths meet: the scene, where its light begins, and of what it is made."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mitsuba as mi

from data_gen.paths.light_ends import LightEnds
from data_gen.paths.vertex import Materials


@dataclass
class World:
    """It does not change in a render. Functions that are ``frozen`` take it as one argument."""

    scene: mi.Scene
    lights: LightEnds
    materials: Materials | None = None  # for samplers that ask nothing of them
    fog: Any = None  # ``photons.map.fog.Fog``: the media, for samplers that gather photons there
