"""The entry of ``gpt``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from data_gen.samplers.registry import Option, Sampler, register
from data_gen.samplers.shared import CONNECTABLE, TAILS, VOLUMETRIC, polarised

if TYPE_CHECKING:
    from data_gen.scenes.facts import Facts


def _unseen_media(facts: Facts, name: str) -> str:
    if facts.integrator not in ("path", *VOLUMETRIC):
        return f"the integrator is '{facts.integrator}', and '{name}' knows only 'path', 'volpath' and 'volpathmis'"
    unseen = ", ".join(facts.media) if facts.integrator == "path" else ""
    return f"there are media ({unseen}), which the integrator 'path' does not render" if unseen else ""


def _notes(facts: Facts) -> list[str]:
    lines = [f"transport: Mitsuba's '{facts.integrator}', offset paths join it where materials are rough"]
    if facts.mirrors:
        lines.append("mirrors or clear glass: shifted by replay, so gradients are noisier there")
    if facts.media:
        lines.append("media: offset paths join where light scatters; albedo counts them, normal and depth do not")
    return lines


register(
    Sampler(
        "gpt",
        "gradients by shifted paths that join their base path (surfaces and media)",
        "data_gen.samplers.gpt.integrator",
        standing="use",
        refusals=(polarised, _unseen_media),
        notes=_notes,
        options={
            "shift": Option(
                "replay",
                "before paths join; half-vector copies that of smooth events, manifold follows some of the light of "
                "'caustic' to its lamps",
                choices=("replay", "half-vector", "manifold"),
            ),
            "reuse": Option(False, "the primal is the mean over base paths and the offset paths of neighbours"),
            "roughness_threshold": CONNECTABLE,
            "tails": TAILS,
            "caustic": Option(
                True, "light over rough surfaces and then mirrors or glass has a layer; else it is in the gradients"
            ),
        },
        rank=1,
        diagnoses=True,
        by_place=True,
        tried=True,
        compiles=2.0,
    )
)
