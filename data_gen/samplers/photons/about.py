"""The entries of all samplers by photons alone."""

from typing import Any

from data_gen.samplers.registry import Option, Sampler, register
from data_gen.samplers.shared import GATHERING, first_radius, notes_on_photons, photons_in_media, photons_on_surfaces

_GATHERED: dict[str, Option] = {
    "radius": first_radius(3.0),
    "photons": Option(1, "light paths of a pass for each pixel", range=(1, 1 << 16)),
    "roughness_threshold": GATHERING,
}
_PLANES = {"planes": Option(64, "light paths of a photon map that planes are swept from", range=(1, 1 << 16))}


def _by_photons(name: str, summary: str, **facts: Any) -> None:
    """Registers one. Each pass is a photon map of its own, which blurs, less from pass to pass."""
    room = "surfaces" if name in ("ppm", "gpm") else "media"
    module = f"data_gen.samplers.photons.{room}.{name}"
    register(Sampler(name, summary, module, notes=notes_on_photons, batch=1, biased=True, **facts))


_by_photons(
    "ppm",
    "photons gathered within a shrinking radius, without gradients (caustics seen in mirrors and through glass)",
    standing="use",
    refuses=photons_on_surfaces("ppm"),
    options=_GATHERED,
    gradients=False,
    tried=True,
    compiles=3.0,
    finds=("caustics",),
)
_by_photons(
    "gpm",
    "gradients of photons gathered within a shrinking radius (caustics seen in mirrors and through glass)",
    refuses=photons_on_surfaces("gpm"),
    options=_GATHERED,
    diagnoses=True,
    finds=("caustics",),
)
_by_photons(
    "vpm",
    "photons in media and on surfaces, without gradients (caustics in fog, beams of lamps in haze)",
    standing="study",
    refuses=photons_in_media("vpm"),
    options=_GATHERED,
    gradients=False,
    finds=("grids",),
)
_by_photons(
    "gvpm",
    "gradients of photons in media and on surfaces, gathered near to points (caustics in fog, beams of lamps)",
    standing="study",
    refuses=photons_in_media("gvpm"),
    options=_GATHERED,
    diagnoses=True,
    finds=("grids",),
)
_by_photons(
    "bre",
    "photons in media gathered along whole rays, without gradients (caustics in fog, beams of lamps in haze)",
    refuses=photons_in_media("bre"),
    options=_GATHERED,
    gradients=False,
    finds=("caustics", "grids"),
)
_by_photons(
    "gbre",
    "gradients of photons in media gathered along whole rays (caustics in fog, beams of lamps in haze)",
    standing="study",
    refuses=photons_in_media("gbre", grids=False),
    options=_GATHERED,
    diagnoses=True,
    finds=("caustics",),
)
_by_photons(
    "beams",
    "photon beams: light in media gathered from whole light paths, without gradients (thin fog, beams of lamps)",
    standing="study",
    refuses=photons_in_media("beams"),
    options=_GATHERED,
    gradients=False,
    finds=("grids",),
)
_by_photons(
    "gbeams",
    "gradients of photon beams (thin fog, beams of lamps)",
    standing="study",
    refuses=photons_in_media("gbeams", grids=False),
    options=_GATHERED,
    diagnoses=True,
)
_by_photons(
    "planes",
    "photon planes: light scattered in media again and again without blur, without gradients (thin fog)",
    standing="study",
    refuses=photons_in_media("planes", grids=False),
    options=_GATHERED | _PLANES,
    gradients=False,
)
_by_photons(
    "gplanes",
    "gradients of photon planes (thin fog)",
    standing="study",
    refuses=photons_in_media("gplanes", grids=False),
    options=_GATHERED | _PLANES,
    diagnoses=True,
)
