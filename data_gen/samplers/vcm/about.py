"""The entry of ``vcm``."""

from data_gen.samplers.registry import Sampler, register
from data_gen.samplers.shared import BOTH_ENDS, GATHERING, IN_MIRRORS, first_radius, joined_depth, spectra

# Light that goes through glass and back has long paths. Camera paths find them rarely, and then make bright dots. So up
# to 16 vertices of a light path are kept.
_OPTIONS = {"radius": first_radius(2.0), "joined_depth": joined_depth(17), "roughness_threshold": GATHERING}
_NOTES = {"transport": "found from both ends and by photons, which blur", "mirrors": IN_MIRRORS}

register(
    Sampler(
        "vcm",
        "paths from both ends, joined and merged with photons, without gradients (hidden lamps and all caustics)",
        "data_gen.samplers.vcm.integrator",
        standing="use",
        refusals=(*BOTH_ENDS, spectra),
        notes=_NOTES,
        options=_OPTIONS,
        gradients=False,
        gathers=True,
        finds=("caustics", "hidden lamps"),
        batch=1,
        biased=True,
    )
)
