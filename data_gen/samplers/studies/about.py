"""The entries of samplers that were measured and lost."""

from __future__ import annotations

from typing import TYPE_CHECKING

from data_gen.samplers.gbdpt.about import SPLATTING_BYTES
from data_gen.samplers.registry import Option, Sampler, register
from data_gen.samplers.shared import CONNECTABLE, SURFACES, hidden_emitters, spectra

if TYPE_CHECKING:
    from data_gen.scenes.facts import Facts


def _notes_on_tiles(facts: Facts) -> list[str]:
    lines = [
        f"transport: Mitsuba's '{facts.integrator}', paths are shared in tiles where materials are rough",
        "noise: correlated within tiles, which denoisers of independent noise do not expect",
    ]
    if facts.mirrors:
        lines.append("mirrors or clear glass: nothing is shared there, and gradients are as noisy as pixels")
    return lines


def _notes_on_chains(facts: Facts) -> list[str]:
    return [
        f"transport: Mitsuba's '{facts.integrator}', by chains of paths that change little by little",
        "noise: correlated between pixels, which denoisers of independent noise do not expect",
    ]


register(
    Sampler(
        "gpt-tiles",
        "gradients of paths that the pixels of a tile share (matte rooms, images that are not denoised)",
        "data_gen.samplers.studies.gpt_tiles",
        standing="study",
        refusals=(*SURFACES, spectra, hidden_emitters),
        notes=_notes_on_tiles,
        options={
            "tile": Option(2, "pixels along a side of a tile", choices=(2, 4)),
            "roughness_threshold": CONNECTABLE,
        },
        together=True,
    )
)
register(
    Sampler(
        "gmlt",
        "gradients of chains of paths that stay where light was found (rooms lit through a slit)",
        "data_gen.samplers.studies.gmlt.integrator",
        standing="study",
        refusals=SURFACES,
        notes=_notes_on_chains,
        batch=8,
        counts=True,
        lane_bytes=SPLATTING_BYTES,
    )
)
register(
    Sampler(
        "split",
        "paths whose light is in two layers, diffuse and specular, without gradients (kernel-predicting networks)",
        "data_gen.samplers.studies.split",
        standing="study",
        refusals=(*SURFACES, hidden_emitters),
        notes=lambda facts: [
            f"transport: Mitsuba's '{facts.integrator}', split by the lobe of the first scattering event",
        ],
        gradients=False,
    )
)
