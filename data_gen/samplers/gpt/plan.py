"""The plan of ``gpt`` for a scene: it decides which code the kernel contains. Code that no path reaches is left out."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi

from data_gen.paths.lights import Lights
from data_gen.paths.space import Filled, Space
from data_gen.paths.vertex import Materials
from data_gen.paths.walk import Limits
from data_gen.scenes.facts import media_of
from data_gen.scenes.lamps import Places
from data_gen.tails.matt import Matt
from ngpt.errors import NgptError


@dataclass
class Plan:
    """Facts about a scene, and options, that do not change while it is rendered."""

    materials: Materials
    lights: Lights
    space: Space  # what is between its surfaces: nothing, or media
    limits: Limits
    # Whether offset paths may stay apart for more than a step: at mirrors, glass, holes or polish (very low roughness)
    replays: bool
    # Whether smooth (not specular) events that cannot be reconnected are shifted by half-vector copy; else by replay
    half_vectors: bool
    caustic: bool  # whether light that no shift can follow has a layer of its own, see ``data_gen.paths.caustic``
    matt: Matt | None = None  # where paths may end in the cache of ``data_gen.tails``; None: nowhere

    @property
    def hides(self) -> bool:
        """Whether the environment is hidden from the camera, so that a path must know whether it has met a surface."""
        return self.limits.hide_emitters and self.lights.far


def make_plan(
    scene: mi.Scene,
    limits: Limits,
    roughness_threshold: float = 0.05,
    shift: str = "replay",
    *,
    caustic: bool = True,
    volumes: bool = False,
    places: Places | None = None,
    shared: bool = False,
) -> Plan:
    """Returns the plan for a scene. ``shift``, ``roughness_threshold`` and ``caustic`` are options of ``gpt``.

    Lamps are chosen by ``places``, if given. Without ``volumes`` the scene's media are ignored. With ``shared`` paths
    may end in the cache. Raises NgptError for a shift that does not work in media, if there are ``volumes``.
    """
    if volumes and shift != "replay":
        raise NgptError(f"gpt: shift '{shift}' does not go through media; use 'replay'")
    space = Filled(scene) if volumes else Space(scene)
    materials = Materials(scene, roughness_threshold, space.passed, media=volumes)
    # If all vertices are connectable, no replay is allowed: the reverse shift would reconnect instead.
    replays = not materials.all_connectable
    return Plan(
        materials,
        Lights(scene, places),
        space,
        limits,
        replays=replays,
        half_vectors=replays and shift == "half-vector",
        caustic=caustic and replays,
        matt=Matt(scene, media_of(scene) if volumes else ()) if shared else None,
    )
