"""The entries of ``gpt-basic`` and ``gpt-simple``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from data_gen.samplers.registry import Sampler, register
from data_gen.samplers.shared import SURFACES, hidden_emitters

if TYPE_CHECKING:
    from data_gen.scenes.facts import Facts


def _notes_on_replay(facts: Facts) -> list[str]:
    lines = [f"transport: Mitsuba's '{facts.integrator}', replayed as a whole"]
    if facts.media:
        lines.append("media: replayed with everything else; albedo counts them, normal and depth do not")
    return lines


def _mirrors(facts: Facts, name: str) -> str:
    return "there are mirrors or clear glass, at which paths cannot be reconnected" if facts.mirrors else ""


register(
    Sampler(
        "gpt-basic",
        "gradients by random sequence replay (any transport; five paths per sample)",
        "data_gen.samplers.teaching.gpt_basic",
        notes=_notes_on_replay,
        rank=9,
        lane_bytes=320,  # five paths that are recorded as one function: all that they return is there at once
    )
)
register(
    Sampler(
        "gpt-simple",
        "gradients by reconnection only (surfaces that scatter widely; code to read before gpt)",
        "data_gen.samplers.teaching.gpt_simple",
        refusals=(*SURFACES, hidden_emitters, _mirrors),
        notes=lambda facts: [
            f"transport: Mitsuba's '{facts.integrator}', offset paths join it at the second vertex",
        ],
    )
)
