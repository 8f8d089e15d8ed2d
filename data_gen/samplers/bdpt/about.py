"""The entry of ``bdpt``."""

from data_gen.samplers.registry import Sampler, register
from data_gen.samplers.shared import BOTH_ENDS, joined_depth

register(
    Sampler(
        "bdpt",
        "paths from the camera and from the lights, without gradients (hidden lamps, caustics seen directly)",
        "data_gen.samplers.bdpt.integrator",
        standing="use",
        refusals=BOTH_ENDS,
        notes={
            "transport": "found from both ends",
            "mirrors": "caustics seen in them are found from the camera alone, with much noise",
        },
        options={"joined_depth": joined_depth(10)},
        gradients=False,
        tried=True,
        compiles=2.0,
        finds=("hidden lamps",),
        batch=4,
    )
)
