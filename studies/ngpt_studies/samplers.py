"""The registry's entries of the samplers. This module does not import Mitsuba."""

from data_gen.budget import LANE_BYTES
from data_gen.samplers import Option, Sampler
from data_gen.samplers.shared import CONNECTABLE, SURFACES, THROUGH_HOLES, hidden_emitters, spectra

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
