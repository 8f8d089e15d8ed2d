"""Parts that the entries of several samplers share: rules to refuse a scene (``registry.Rule``), options and notes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from data_gen.samplers.registry import Option

if TYPE_CHECKING:
    from data_gen.scenes.facts import Facts

# Integrators with media that our samplers can follow
VOLUMETRIC = ("volpath", "volpathmis")
# Mitsuba's path tracers, with and without media
PATHS = ("path", *VOLUMETRIC)


def polarised(facts: Facts, name: str) -> str:
    return f"variant '{facts.polarised}' is polarised, which '{name}' does not follow" if facts.polarised else ""


def spectra(facts: Facts, name: str) -> str:
    """Paths that share light must have the same wavelengths."""
    reason = f"in variant '{facts.spectral}' each path has wavelengths of its own, and '{name}' lets paths share light"
    return f"{reason}, as variant 'llvm_ad_rgb' allows" if facts.spectral else ""


def unseen_media(facts: Facts, name: str) -> str:
    if facts.integrator != "path":
        return f"the integrator is '{facts.integrator}', and '{name}' knows only 'path'"
    media = ", ".join(facts.media)
    return f"there are media ({media}), which '{name}' does not see" if media else ""


def no_media(facts: Facts, name: str) -> str:
    if facts.integrator not in VOLUMETRIC:
        return f"the integrator is '{facts.integrator}', and '{name}' knows only 'volpath' and 'volpathmis'"
    return "" if facts.media else "there are no media, and 'ppm' has the same image"


def unrendered_media(facts: Facts, name: str) -> str:
    if facts.integrator not in PATHS:
        return f"the integrator is '{facts.integrator}', and '{name}' knows only 'path', 'volpath' and 'volpathmis'"
    unseen = ", ".join(facts.media) if facts.integrator == "path" else ""
    return f"there are media ({unseen}), which the integrator 'path' does not render" if unseen else ""


def hidden_emitters(facts: Facts, name: str) -> str:
    return "its integrator hides emitters" if facts.hides else ""


def mirrors(facts: Facts, name: str) -> str:
    return "there are mirrors or clear glass, at which paths cannot be reconnected" if facts.mirrors else ""


def unreachable_camera(facts: Facts, name: str) -> str:
    """Light paths must be able to end at the camera."""
    reached = facts.camera in ("perspective", "thinlens")
    return "" if reached else f"light paths cannot reach a camera '{facts.camera}', only 'perspective' and 'thinlens'"


def no_pixels(facts: Facts, name: str) -> str:
    """The radius of photons is in pixels. Meters have a single pixel, or pixels that are not side by side."""
    meter = facts.camera in ("radiancemeter", "irradiancemeter", "distant")
    return f"photons need pixels side by side, which a camera '{facts.camera}' does not have" if meter else ""


def hair(facts: Facts, name: str) -> str:
    """Mitsuba's hair is not reciprocal, and does not provide its adjoint."""
    return "light paths lose light at the material 'hair', which is not reciprocal" * facts.hair


SURFACES = (polarised, unseen_media)
BOTH_ENDS = (*SURFACES, unreachable_camera, hair)
PHOTONS = (polarised, spectra, no_pixels, hair)


# Options that several samplers have
CONNECTABLE = Option(0.05, "the microfacet roughness above which materials are connectable", range=(0, math.inf))
GATHERING = Option(0.05, "the microfacet roughness above which photons are gathered at materials", range=(0, math.inf))


TAILS = Option(
    "paths",
    "where a path finds light behind its first steps: by itself, or in a cache shared with other paths (biased)",
    choices=("paths", "shared"),
)


def why_not_shared(settings: Mapping[str, Any], variant: str) -> str:
    """Why paths of a sampler with the option ``tails`` cannot share their tails under these ``settings``, or ""."""
    if "rgb" not in variant or "polarized" in variant:
        return f"variant '{variant}' renders other colours than RGB"
    return "reuse needs whole paths" if settings.get("reuse") else ""


def joined_depth(default: int) -> Option:
    meaning = "paths of up to this number of edges are found from both ends, longer ones only from the camera"
    return Option(default, meaning, range=(1, 64))


def first_radius(default: float) -> Option:
    meaning = "the radius of gathering in the first pass, in pixels (their median width at the surfaces seen)"
    return Option(default, meaning, range=(1e-6, 1e6))


# The light of lamps without size that a sampler loses, as part of a message
THROUGH_HOLES = "that comes through masks and thin panes"

IN_MIRRORS = "followed from the camera and from the lights; caustics that are seen in them are found, too"
