"""The entries of all samplers that use only photons."""

from data_gen.samplers.registry import Option, Sampler, register
from data_gen.samplers.shared import (
    GATHERING,
    IN_MIRRORS,
    PHOTONS,
    first_radius,
    no_media,
    unseen_media,
    varying_media,
)

_OPTIONS: dict[str, Option] = {
    "radius": first_radius(3.0),
    "photons": Option(1, "light paths of a pass for each pixel", range=(1, 1 << 16)),
    "roughness_threshold": GATHERING,
}
_PLANES = {"planes": Option(64, "light paths of a photon map that planes are swept from", range=(1, 1 << 16))}

# By name, in the order in which users see them
_SUMMARIES = {
    "ppm": "photons gathered within a shrinking radius, without gradients (caustics seen in mirrors and through glass)",
    "gpm": "gradients of photons gathered within a shrinking radius (caustics seen in mirrors and through glass)",
    "vpm": "photons in media and on surfaces, without gradients (caustics in fog, beams of lamps in haze)",
    "gvpm": "gradients of photons in media and on surfaces, gathered near to points (caustics in fog, beams of lamps)",
    "bre": "photons in media gathered along whole rays, without gradients (caustics in fog, beams of lamps in haze)",
    "gbre": "gradients of photons in media gathered along whole rays (caustics in fog, beams of lamps in haze)",
    "beams": "photon beams: light in media gathered from whole light paths, without gradients "
    "(thin fog, beams of lamps)",
    "gbeams": "gradients of photon beams (thin fog, beams of lamps)",
    "planes": "photon planes: light scattered many times in media, unblurred, without gradients (thin fog)",
    "gplanes": "gradients of photon planes (thin fog)",
}
_STANDINGS = {"ppm": "use", "gpm": "niche", "bre": "niche"}  # others are studies
_CAUSTICS, _GRIDS = ("ppm", "gpm", "bre", "gbre"), ("vpm", "gvpm", "bre", "beams")

for _name, _summary in _SUMMARIES.items():
    _surfaces, _gradients = _name in ("ppm", "gpm"), _name.startswith("g")
    _media = (no_media, varying_media) if _name in ("gbre", "gbeams", "planes", "gplanes") else (no_media,)
    # Each pass is a photon map of its own, which blurs, less from pass to pass.
    register(
        Sampler(
            _name,
            _summary,
            f"data_gen.samplers.photons.{'surfaces' if _surfaces else 'media'}.{_name}",
            standing=_STANDINGS.get(_name, "study"),
            refusals=((unseen_media,) if _surfaces else _media) + PHOTONS,
            notes={"transport": "found by photons; blurred, less with every sample", "mirrors": IN_MIRRORS},
            options=_OPTIONS | (_PLANES if "planes" in _name else {}),
            gradients=_gradients,
            tried=_name == "ppm",
            compiles=3.0,
            finds=("caustics",) * (_name in _CAUSTICS) + ("grids",) * (_name in _GRIDS),
            diagnoses=_gradients,
            batch=1,
            biased=True,
        )
    )
