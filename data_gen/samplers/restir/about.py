"""The entry of ``restir``."""

import math

from data_gen.samplers.registry import FrameSampler, Option, register
from data_gen.samplers.shared import CONNECTABLE, SURFACES, THROUGH_HOLES

register(
    FrameSampler(
        "restir",
        "gradients of paths that are reused from frame to frame (shots)",
        "data_gen.samplers.restir.sampler",
        refusals=SURFACES,
        loses=THROUGH_HOLES,
        options={
            "history": Option(32.0, "the most frames that a reservoir can count for", range=(1, math.inf)),
            "gradients": Option(
                "pairs",
                "pairs: from reservoirs of pairs of pixels; after: from the paths that pixels have kept",
                choices=("pairs", "after"),
            ),
            "roughness_threshold": CONNECTABLE,
        },
        spp=2,
        warm_up=16,
        alone="without earlier frames it takes 2 to 3 times as long as 'gpt' for the same error",
    )
)
