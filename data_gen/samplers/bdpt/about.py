"""The entry of ``bdpt``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from data_gen.samplers.registry import Sampler, register
from data_gen.samplers.shared import BOTH_ENDS, joined_depth

if TYPE_CHECKING:
    from data_gen.scenes.facts import Facts


def _notes(facts: Facts) -> list[str]:
    lines = [f"transport: Mitsuba's '{facts.integrator}', found from both ends"]
    if facts.mirrors:
        lines.append("mirrors or clear glass: caustics seen in them are found from the camera alone, with much noise")
    return lines


register(
    Sampler(
        "bdpt",
        "paths from the camera and from the lights, without gradients (hidden lamps, caustics seen directly)",
        "data_gen.samplers.bdpt.integrator",
        refusals=BOTH_ENDS,
        notes=_notes,
        options={"joined_depth": joined_depth(10)},
        gradients=False,
        tried=True,
        compiles=2.0,
        finds=("hidden lamps",),
        batch=4,
    )
)
