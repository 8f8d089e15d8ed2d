"""The entries of the samplers that use only photons: ``ppm`` on surfaces, and ``bre`` in media.

Each pass has its own photon map. A map blurs the light, and the blur becomes smaller from pass to pass.
"""

from typing import Any

from data_gen.samplers.registry import Option, Sampler, register
from data_gen.samplers.shared import GATHERING, IN_MIRRORS, PHOTONS, first_radius, no_media, unseen_media

# Fields that the entries of these samplers share
OF_PHOTONS: dict[str, Any] = {
    "notes": {"transport": "found by photons; blurred, less with every sample", "mirrors": IN_MIRRORS},
    "options": {
        "radius": first_radius(3.0),
        "photons": Option(1, "light paths of a pass for each pixel", range=(1, 1 << 16)),
        "roughness_threshold": GATHERING,
    },
    "compiles": 3.0,
    "batch": 1,
    "biased": True,
}

register(
    Sampler(
        "ppm",
        "photons gathered within a shrinking radius, without gradients (caustics seen in mirrors and through glass)",
        "data_gen.samplers.photons.ppm",
        standing="use",
        refusals=(unseen_media, *PHOTONS),
        gradients=False,
        tried=True,
        finds=("caustics",),
        **OF_PHOTONS,
    )
)
register(
    Sampler(
        "bre",
        "photons in media gathered along whole rays, without gradients (caustics in fog, beams of lamps in haze)",
        "data_gen.samplers.photons.bre",
        refusals=(no_media, *PHOTONS),
        gradients=False,
        finds=("caustics", "grids"),
        **OF_PHOTONS,
    )
)
