"""The entry of ``gpt``."""

from data_gen.samplers.registry import Option, Sampler, register
from data_gen.samplers.shared import CONNECTABLE, TAILS, polarised, unrendered_media

register(
    Sampler(
        "gpt",
        "gradients by shifted paths that join their base path (surfaces and media)",
        "data_gen.samplers.gpt.integrator",
        standing="use",
        refusals=(polarised, unrendered_media),
        notes={
            "transport": "offset paths join it where materials are rough",
            "mirrors": "shifted by replay, so gradients are noisier there",
            "media": "offset paths join where light scatters; albedo counts them, normal and depth do not",
        },
        options={
            "shift": Option(
                "replay",
                "how offset paths continue before they join: half-vector copies the half vectors of smooth events",
                choices=("replay", "half-vector"),
            ),
            "reuse": Option(False, "the primal is the mean over base paths and the offset paths of neighbours"),
            "roughness_threshold": CONNECTABLE,
            "tails": TAILS,
            "caustic": Option(
                True,
                "light that meets rough surfaces and then mirrors or glass has a layer; if false, gradients hold it",
            ),
        },
        rank=1,
        diagnoses=True,
        by_place=True,
        tried=True,
        compiles=2.0,
    )
)
