"""The registry's entries of the samplers. This module does not import Mitsuba."""

import math

from data_gen.budget import LANE_BYTES
from data_gen.samplers import FrameSampler, Option, Sampler
from data_gen.samplers.shared import (
    BOTH_ENDS,
    CONNECTABLE,
    SURFACES,
    THROUGH_HOLES,
    hidden_emitters,
    joined_depth,
    spectra,
)

# Bytes of a lane of ``gbdpt``. The splats of the four differences are kept per pixel, and a pass has 8 lanes per pixel,
# so a lane counts an eighth of them. Each lane also has some entries in the list of vertices that the camera sees. For
# each of nine vertices of the light path, the light and the pixel are kept, by which vertices are chosen for shifts
_GBDPT_BYTES = LANE_BYTES + 224 + 9 * 8

GBDPT = Sampler(
    "gbdpt",
    "gradients of paths from the camera and from the lights (hidden lamps)",
    "ngpt_studies.gbdpt.integrator",
    standing="study",
    refusals=BOTH_ENDS,
    notes={
        "transport": "found from both ends and shifted as a whole",
        "mirrors": "shifted in front of the camera, and between a light and the surface that the camera sees",
    },
    options={"joined_depth": joined_depth(10), "roughness_threshold": CONNECTABLE},
    batch=8,
    lane_bytes=_GBDPT_BYTES,
)
GPT_TILES = Sampler(
    "gpt-tiles",
    "gradients of paths that the pixels of a tile share (matte rooms, images that are not denoised)",
    "ngpt_studies.gpt_tiles",
    standing="study",
    refusals=(*SURFACES, spectra, hidden_emitters),
    loses=THROUGH_HOLES,
    leaves_lamps=True,
    notes={
        "transport": "paths are shared in tiles where materials are rough",
        "noise": "correlated within tiles, which denoisers of independent noise do not expect",
        "mirrors": "nothing is shared there, and gradients are as noisy as pixels",
    },
    options={
        "tile": Option(2, "pixels along a side of a tile", choices=(2, 4)),
        "roughness_threshold": CONNECTABLE,
    },
    together=True,
)
GMLT = Sampler(
    "gmlt",
    "gradients of chains of paths that stay where light was found (rooms lit through a slit)",
    "ngpt_studies.gmlt.integrator",
    standing="study",
    refusals=SURFACES,
    notes={
        "transport": "by chains of paths that change little by little",
        "noise": "correlated between pixels, which denoisers of independent noise do not expect",
    },
    batch=8,
    counts=True,
    lane_bytes=LANE_BYTES + 224,
)
SPLIT = Sampler(
    "split",
    "paths whose light is in two layers, diffuse and specular, without gradients (kernel-predicting networks)",
    "ngpt_studies.split",
    standing="study",
    refusals=(*SURFACES, hidden_emitters),
    loses=THROUGH_HOLES,
    leaves_lamps=True,
    notes={"transport": "split by the lobe of the first scattering event"},
    gradients=False,
)
RESTIR = FrameSampler(
    "restir",
    "gradients of paths that are reused from frame to frame (shots)",
    "ngpt_studies.restir.sampler",
    standing="study",
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
