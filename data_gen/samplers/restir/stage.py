"""A scene in the state of one frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mitsuba as mi

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
