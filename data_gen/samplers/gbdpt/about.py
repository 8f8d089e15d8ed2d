"""The entry of ``gbdpt``."""

from data_gen.budget import LANE_BYTES
from data_gen.samplers.registry import Sampler, register
from data_gen.samplers.shared import BOTH_ENDS, CONNECTABLE, joined_depth

# Bytes of a lane that also splats the four differences. The splats are kept per pixel, and a pass has 8 lanes per
# pixel, so a lane counts an eighth of them. Each lane also has some entries in the list of vertices that the camera
# sees
SPLATTING_BYTES = LANE_BYTES + 224
# For each of nine vertices of the light path, the light and the pixel, by which vertices are chosen for shifts
_ROULETTE_BYTES = 9 * 8

register(
    Sampler(
        "gbdpt",
        "gradients of paths from the camera and from the lights (hidden lamps)",
        "data_gen.samplers.gbdpt.integrator",
        standing="use",
        refusals=BOTH_ENDS,
        notes={
            "transport": "found from both ends and shifted as a whole",
            "mirrors": "shifted in front of the camera, and between a light and the surface that the camera sees",
        },
        options={"joined_depth": joined_depth(10), "roughness_threshold": CONNECTABLE},
        tried=True,
        compiles=6.0,
        finds=("hidden lamps",),
        batch=8,
        lane_bytes=SPLATTING_BYTES + _ROULETTE_BYTES,
    )
)
