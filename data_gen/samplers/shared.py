"""What entries of several families share: why they refuse a scene, and options and notes."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from data_gen.samplers.registry import Option

if TYPE_CHECKING:
    from data_gen.scenes.facts import Facts

# Integrators that render media, of those that samplers of ours follow
VOLUMETRIC = ("volpath", "volpathmis")

Refusal = Callable[["Facts"], str]


def refused_if_polarised(facts: Facts, name: str) -> str:
    return f"variant '{facts.polarised}' is polarised, which '{name}' does not follow" if facts.polarised else ""


def surfaces_alone(name: str) -> Refusal:
    """Of a sampler that sees no media."""

    def refuses(facts: Facts) -> str:
        if facts.integrator != "path":
            reason = f"the integrator is '{facts.integrator}', and '{name}' knows only 'path'"
        else:
            media = ", ".join(facts.media)
            reason = f"there are media ({media}), which '{name}' does not see" if media else ""
        return refused_if_polarised(facts, name) or reason

    return refuses


def surfaces_from_both_ends(name: str) -> Refusal:
    """Of a sampler whose light paths end at the camera."""
    alone = surfaces_alone(name)

    def refuses(facts: Facts) -> str:
        return alone(facts) or refused_by_light_paths(facts.camera) or refused_by_hair(facts)

    return refuses


def refused_by_light_paths(camera: str) -> str:
    reached = camera in ("perspective", "thinlens")
    return "" if reached else f"light paths cannot reach a camera '{camera}', but 'perspective' and 'thinlens'"


def refused_by_hair(facts: Facts) -> str:
    """Mitsuba's hair scatters otherwise from the light to the eye than back, and tells nothing of its adjoint."""
    return "light paths lose light at the material 'hair', which is not the same in both directions" * facts.hair


def refused_by_photons(camera: str) -> str:
    """Their radius is in pixels: meters have one for all that they see, or none side by side."""
    meter = camera in ("radiancemeter", "irradiancemeter", "distant")
    return f"photons are gathered over pixels, which a camera '{camera}' has not side by side" if meter else ""


def photons_on_surfaces(name: str) -> Refusal:
    """Of a sampler that gathers photons where there are no media."""
    alone = surfaces_alone(name)

    def refuses(facts: Facts) -> str:
        return alone(facts) or refused_by_photons(facts.camera) or refused_by_hair(facts)

    return refuses


def photons_in_media(name: str, grids: bool = True) -> Refusal:
    """Of a sampler that gathers photons in scenes with media; ``grids``: also ones whose density varies."""

    def refuses(facts: Facts) -> str:
        if facts.integrator not in VOLUMETRIC:
            reason = f"the integrator is '{facts.integrator}', and '{name}' knows only 'volpath' and 'volpathmis'"
        elif not facts.media:
            reason = "there are no media, and 'ppm' has the same image"
        else:
            varies = facts.grids and not grids
            reason = f"there are media whose density varies, which '{name}' does not render" if varies else ""
        reason = refused_if_polarised(facts, name) or reason
        return reason or refused_by_photons(facts.camera) or refused_by_hair(facts)

    return refuses


# Options that several samplers have
CONNECTABLE = Option(0.05, "the microfacet roughness above which materials are connectable", range=(0, math.inf))
GATHERING = Option(0.05, "the microfacet roughness above which photons are gathered at materials", range=(0, math.inf))


TAILS = Option(
    "paths",
    "how a path finds light behind its first steps: by itself, or in a cache of what others have found (biased)",
    choices=("paths", "shared"),
)


def why_not_shared(media: bool, settings: Mapping[str, Any], variant: str) -> str:
    """Why paths with these ``settings`` cannot share what they find, of a sampler with the option ``tails``.

    ``media``: the paths go through media. "" where they can share.
    """
    if media:
        return "there are media"
    if "rgb" not in variant or "polarized" in variant:
        return f"variant '{variant}' renders other colours than RGB"
    unable = {"reuse": (True, "reuse"), "shift": ("manifold", "shift=manifold")}
    return next(
        (f"{name} needs whole paths" for key, (value, name) in unable.items() if settings.get(key) == value), ""
    )


def joined_depth(default: int) -> Option:
    """Of samplers by paths from both ends."""
    meaning = "edges of a path, up to which it is found from both ends; longer ones from the camera"
    return Option(default, meaning, range=(1, 64))


def first_radius(default: float) -> Option:
    """Of samplers by photons."""
    meaning = "how far photons are gathered from in the first pass, in pixels where most is seen"
    return Option(default, meaning, range=(1e-6, 1e6))


def notes_on_photons(facts: Facts) -> list[str]:
    how = "found by photons; blurred, less with every sample"
    return [f"transport: Mitsuba's '{facts.integrator}', {how}", *notes_on_mirrors(facts)]


def notes_on_mirrors(facts: Facts) -> list[str]:
    """Of samplers by photons."""
    line = "mirrors or clear glass: followed from the camera and from the lights, caustics seen in them too"
    return [line] if facts.mirrors else []
