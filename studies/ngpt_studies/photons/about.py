"""The entries of the studies of photons. Nothing here imports Mitsuba."""

from data_gen.samplers import SAMPLERS, Option, Sampler
from data_gen.samplers.photons.about import OF_PHOTONS
from data_gen.samplers.shared import PHOTONS, no_media, unseen_media
from data_gen.scenes.facts import Facts


def varying_media(facts: Facts, name: str) -> str:
    return f"there are media whose density varies, which '{name}' does not render" if facts.grids else ""


_HOMOGENEOUS = (no_media, varying_media, *PHOTONS)
_PLANES = {"planes": Option(64, "light paths of a photon map that planes are swept from", range=(1, 1 << 16))}


def _entry(name: str, summary: str, module: str, refusals: tuple, **options: Option) -> Sampler:
    """An entry with all that samplers of photons have in common, and further ``options``."""
    gradients = name.startswith("g")
    common = {**OF_PHOTONS, "options": OF_PHOTONS["options"] | options, "gradients": gradients, "diagnoses": gradients}
    return Sampler(name, summary, f"ngpt_studies.photons.{module}", standing="study", refusals=refusals, **common)


GPM = _entry(
    "gpm",
    "gradients of photons gathered within a shrinking radius (caustics seen in mirrors and through glass)",
    "gpm",
    (unseen_media, *PHOTONS),
)
VPM = _entry(
    "vpm",
    "photons in media and on surfaces, without gradients (caustics in fog, beams of lamps in haze)",
    "media.vpm",
    (no_media, *PHOTONS),
)
GVPM = _entry(
    "gvpm",
    "gradients of photons in media and on surfaces, gathered near to points (caustics in fog, beams of lamps)",
    "media.gvpm",
    (no_media, *PHOTONS),
)
GBRE = _entry(
    "gbre",
    "gradients of photons in media gathered along whole rays (caustics in fog, beams of lamps in haze)",
    "media.gbre",
    _HOMOGENEOUS,
)
BEAMS = _entry(
    "beams",
    "photon beams: light in media gathered from whole light paths, without gradients (thin fog, beams of lamps)",
    "media.beams",
    (no_media, *PHOTONS),
)
GBEAMS = _entry("gbeams", "gradients of photon beams (thin fog, beams of lamps)", "media.gbeams", _HOMOGENEOUS)
PLANES = _entry(
    "planes",
    "photon planes: light scattered many times in media, unblurred, without gradients (thin fog)",
    "media.planes",
    _HOMOGENEOUS,
    **_PLANES,
)
GPLANES = _entry("gplanes", "gradients of photon planes (thin fog)", "media.gplanes", _HOMOGENEOUS, **_PLANES)
GVCM = Sampler(
    "gvcm",
    "gradients of paths from both ends, joined and merged with photons (hidden lamps and all caustics)",
    "ngpt_studies.photons.gvcm",
    standing="study",
    refusals=SAMPLERS["vcm"].refusals,
    notes=SAMPLERS["vcm"].notes,
    options=SAMPLERS["vcm"].options,
    batch=1,
    biased=True,
)
