"""The entry of ``primal``."""

from data_gen.samplers.registry import Option, Sampler, register
from data_gen.samplers.shared import TAILS

register(
    Sampler(
        "primal",
        "the scene's own integrator, without gradients (rooms, references)",
        "data_gen.samplers.primal.sampler",
        standing="use",
        notes={"media": "albedo counts them, normal and depth do not"},
        options={"features": Option(True, "albedo, normal, depth and emission seen directly"), "tails": TAILS},
        gradients=False,
        tried=True,
        compiles=1.0,
        by_place=True,
    )
)
