"""The entries of ``vcm`` and ``gvcm``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from data_gen.samplers.registry import Sampler, register
from data_gen.samplers.shared import BOTH_ENDS, GATHERING, first_radius, joined_depth, notes_on_mirrors, spectra

if TYPE_CHECKING:
    from data_gen.scenes.facts import Facts

# Light through glass and back has long paths, which the camera finds only by rare and bright ones. 16 vertices of a
# light path are kept.
_OPTIONS = {"radius": first_radius(2.0), "joined_depth": joined_depth(17), "roughness_threshold": GATHERING}


def _notes(facts: Facts) -> list[str]:
    how = "found from both ends and by photons; blurred where by photons"
    return [f"transport: Mitsuba's '{facts.integrator}', {how}", *notes_on_mirrors(facts)]


register(
    Sampler(
        "vcm",
        "paths from both ends, joined and merged with photons, without gradients (hidden lamps and all caustics)",
        "data_gen.samplers.vcm.integrator",
        standing="use",
        refusals=(*BOTH_ENDS, spectra),
        notes=_notes,
        options=_OPTIONS,
        gradients=False,
        finds=("caustics", "hidden lamps"),
        batch=1,
        biased=True,
    )
)
register(
    Sampler(
        "gvcm",
        "gradients of paths from both ends, joined and merged with photons (hidden lamps and all caustics)",
        "data_gen.samplers.vcm.gvcm",
        refusals=(*BOTH_ENDS, spectra),
        notes=_notes,
        options=_OPTIONS,
        finds=("caustics", "hidden lamps"),
        batch=1,
        biased=True,
    )
)
