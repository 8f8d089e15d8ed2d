"""The entries of all samplers that use only photons."""

from collections.abc import Mapping
from typing import Any

from data_gen.samplers.registry import Option, Rule, Sampler, register
from data_gen.samplers.shared import (
    GATHERING,
    PHOTONS,
    first_radius,
    no_media,
    notes_on_photons,
    unseen_media,
    varying_media,
)

_GATHERED: dict[str, Option] = {
    "radius": first_radius(3.0),
    "photons": Option(1, "light paths of a pass for each pixel", range=(1, 1 << 16)),
    "roughness_threshold": GATHERING,
}
_PLANES = {"planes": Option(64, "light paths of a photon map that planes are swept from", range=(1, 1 << 16))}


def _by_photons(
    name: str, summary: str, refusals: tuple[Rule, ...], options: Mapping[str, Option] = _GATHERED, **facts: Any
) -> None:
    """Registers one. Each pass is a photon map of its own, which blurs, less from pass to pass."""
    room = "surfaces" if name in ("ppm", "gpm") else "media"
    gradients = name.startswith("g")
    register(
        Sampler(
            name,
            summary,
            f"data_gen.samplers.photons.{room}.{name}",
            refusals=(*refusals, *PHOTONS),
            notes=notes_on_photons,
            options=options,
            gradients=gradients,
            diagnoses=gradients,
            batch=1,
            biased=True,
            **facts,
        )
    )


_by_photons(
    "ppm",
    "photons gathered within a shrinking radius, without gradients (caustics seen in mirrors and through glass)",
    (unseen_media,),
    standing="use",
    tried=True,
    compiles=3.0,
    finds=("caustics",),
)
_by_photons(
    "gpm",
    "gradients of photons gathered within a shrinking radius (caustics seen in mirrors and through glass)",
    (unseen_media,),
    finds=("caustics",),
)
_by_photons(
    "vpm",
    "photons in media and on surfaces, without gradients (caustics in fog, beams of lamps in haze)",
    (no_media,),
    standing="study",
    finds=("grids",),
)
_by_photons(
    "gvpm",
    "gradients of photons in media and on surfaces, gathered near to points (caustics in fog, beams of lamps)",
    (no_media,),
    standing="study",
    finds=("grids",),
)
_by_photons(
    "bre",
    "photons in media gathered along whole rays, without gradients (caustics in fog, beams of lamps in haze)",
    (no_media,),
    finds=("caustics", "grids"),
)
_by_photons(
    "gbre",
    "gradients of photons in media gathered along whole rays (caustics in fog, beams of lamps in haze)",
    (no_media, varying_media),
    standing="study",
    finds=("caustics",),
)
_by_photons(
    "beams",
    "photon beams: light in media gathered from whole light paths, without gradients (thin fog, beams of lamps)",
    (no_media,),
    standing="study",
    finds=("grids",),
)
_by_photons(
    "gbeams",
    "gradients of photon beams (thin fog, beams of lamps)",
    (no_media, varying_media),
    standing="study",
)
_by_photons(
    "planes",
    "photon planes: light scattered in media again and again without blur, without gradients (thin fog)",
    (no_media, varying_media),
    standing="study",
    options=_GATHERED | _PLANES,
)
_by_photons(
    "gplanes",
    "gradients of photon planes (thin fog)",
    (no_media, varying_media),
    standing="study",
    options=_GATHERED | _PLANES,
)
