"""What the kernel of ``gpt`` contains for a scene: code that its transport cannot reach is not compiled."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi

from data_gen.paths.lights import Lights
from data_gen.paths.media import Media, index_matched
from data_gen.paths.vertex import Materials
from ngpt.errors import NgptError


@dataclass
class Plan:
    """Facts about a scene, and options, that do not change while it is rendered.

    ``replays``       offset paths may stay apart for more than a step: there are mirrors, glass, holes or polish
    ``half_vectors``  smooth events that cannot be reconnected are shifted by half-vector copy, else by replay
    ``caustic``       light that no shift can follow goes into a layer of its own, see ``data_gen.paths.caustic``
    ``manifold``      some of that light is followed all the same, see ``data_gen.samplers.gpt.manifold_shift``
    ``media``         what fills the space between surfaces, see ``data_gen.paths.media``; None if there is nothing
    ``hides``         the environment hides from the camera, so that a path must know whether it has seen a surface
    """

    materials: Materials
    lights: Lights
    max_depth: int
    rr_depth: int
    replays: bool
    half_vectors: bool
    hide_emitters: bool
    caustic: bool
    manifold: bool
    media: Media | None

    @property
    def hides(self) -> bool:
        return self.hide_emitters and self.lights.far


def make_plan(
    scene: mi.Scene,
    roughness_threshold: float,
    max_depth: int,
    rr_depth: int,
    shift: str,
    hide_emitters: bool,
    caustic: bool,
    volumes: bool = False,
) -> Plan:
    """Inspects the scene; the parameters are those of ``gpt``. Without ``volumes`` its media are not seen.

    Raises NgptError for shifts that know no media.
    """
    media = Media(scene) if volumes else None
    if media and shift != "replay":
        raise NgptError(f"gpt: shift '{shift}' does not go through media; use 'replay'")
    passed = index_matched if media else lambda shape: False
    materials = Materials(scene, roughness_threshold, passed, media=media is not None)
    # Where all is connectable, a replay would end at a vertex to which the reverse shift reconnects: never allowed.
    replays = not materials.all_connectable
    half_vectors = replays and shift == "half-vector"
    caustic = caustic and replays
    manifold = caustic and shift == "manifold"
    lights = Lights(scene)
    return Plan(materials, lights, max_depth, rr_depth, replays, half_vectors, hide_emitters, caustic, manifold, media)
