"""The entry of ``gbdpt``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from data_gen.budget import LANE_BYTES
from data_gen.samplers.registry import Sampler, register
from data_gen.samplers.shared import BOTH_ENDS, CONNECTABLE, joined_depth

if TYPE_CHECKING:
    from data_gen.scenes.facts import Facts

# Bytes of a lane that splats all four differences as well, which are kept per pixel: an eighth of it for a lane, of 8 a
# pass and the list of vertices that the camera sees, some of them for each lane
SPLATTING_BYTES = LANE_BYTES + 224
# And of nine vertices of the light path the light and the pixel, by which they are chosen for shifts
_ROULETTE_BYTES = 9 * 8


def _notes(facts: Facts) -> list[str]:
    lines = [f"transport: Mitsuba's '{facts.integrator}', found from both ends and shifted as a whole"]
    if facts.mirrors:
        lines.append(
            "mirrors or clear glass: shifted in front of the camera, and where light comes through them to what it sees"
        )
    return lines


register(
    Sampler(
        "gbdpt",
        "gradients of paths from the camera and from the lights (hidden lamps)",
        "data_gen.samplers.gbdpt.integrator",
        standing="use",
        refusals=BOTH_ENDS,
        notes=_notes,
        options={"joined_depth": joined_depth(10), "roughness_threshold": CONNECTABLE},
        tried=True,
        compiles=6.0,
        finds=("hidden lamps",),
        batch=8,
        lane_bytes=SPLATTING_BYTES + _ROULETTE_BYTES,
    )
)
