"""The entries of ``gpt-basic`` and ``gpt-simple``."""

from data_gen.samplers.registry import Sampler, register
from data_gen.samplers.shared import SURFACES, THROUGH_HOLES, hidden_emitters, mirrors

register(
    Sampler(
        "gpt-basic",
        "gradients by random sequence replay (any transport; five paths per sample)",
        "data_gen.samplers.teaching.gpt_basic",
        leaves_lamps=True,
        notes={
            "transport": "replayed as a whole",
            "media": "replayed with everything else; albedo counts them, normal and depth do not",
        },
        loses=THROUGH_HOLES,
        rank=9,
        lane_bytes=320,  # one function traces all five paths, so their results are in memory at the same time
    )
)
register(
    Sampler(
        "gpt-simple",
        "gradients by reconnection only (surfaces that scatter widely; code to read before gpt)",
        "data_gen.samplers.teaching.gpt_simple",
        refusals=(*SURFACES, hidden_emitters, mirrors),
        leaves_lamps=True,
        notes={"transport": "offset paths join it at the second vertex"},
    )
)
