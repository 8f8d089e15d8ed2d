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

# Name, summary, standing, light that it finds
for _name, _summary, _standing, _finds in (
    (
        "ppm",
        "photons gathered within a shrinking radius, without gradients (caustics seen in mirrors and through glass)",
        "use",
        ("caustics",),
    ),
    (
        "gpm",
        "gradients of photons gathered within a shrinking radius (caustics seen in mirrors and through glass)",
        "niche",
        ("caustics",),
    ),
    (
        "vpm",
        "photons in media and on surfaces, without gradients (caustics in fog, beams of lamps in haze)",
        "study",
        ("grids",),
    ),
    (
        "gvpm",
        "gradients of photons in media and on surfaces, gathered near to points (caustics in fog, beams of lamps)",
        "study",
        ("grids",),
    ),
    (
        "bre",
        "photons in media gathered along whole rays, without gradients (caustics in fog, beams of lamps in haze)",
        "niche",
        ("caustics", "grids"),
    ),
    (
        "gbre",
        "gradients of photons in media gathered along whole rays (caustics in fog, beams of lamps in haze)",
        "study",
        ("caustics",),
    ),
    (
        "beams",
        "photon beams: light in media gathered from whole light paths, without gradients (thin fog, beams of lamps)",
        "study",
        ("grids",),
    ),
    ("gbeams", "gradients of photon beams (thin fog, beams of lamps)", "study", ()),
    (
        "planes",
        "photon planes: light scattered in media again and again without blur, without gradients (thin fog)",
        "study",
        (),
    ),
    ("gplanes", "gradients of photon planes (thin fog)", "study", ()),
):
    _surfaces, _gradients = _name in ("ppm", "gpm"), _name.startswith("g")
    _media = (no_media, varying_media) if _name in ("gbre", "gbeams", "planes", "gplanes") else (no_media,)
    # Each pass is a photon map of its own, which blurs, less from pass to pass.
    register(
        Sampler(
            _name,
            _summary,
            f"data_gen.samplers.photons.{'surfaces' if _surfaces else 'media'}.{_name}",
            standing=_standing,
            refusals=((unseen_media,) if _surfaces else _media) + PHOTONS,
            notes={"transport": "found by photons; blurred, less with every sample", "mirrors": IN_MIRRORS},
            options=_OPTIONS | (_PLANES if "planes" in _name else {}),
            gradients=_gradients,
            tried=_name == "ppm",
            compiles=3.0,
            finds=_finds,
            diagnoses=_gradients,
            batch=1,
            biased=True,
        )
    )
