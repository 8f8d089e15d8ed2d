"""What the choice of a sampler depends on."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi


@dataclass(frozen=True)
class Facts:
    """Facts about a scene, known without rendering it.

    ``integrator``  the plugin name of the scene's own integrator, or the name of its class; "path" if it has none
    ``media``       the names of its media, sorted
    ``polarised``   the name of a variant that renders polarised light, or ""
    ``mirrors``     whether there are mirrors or clear glass; known of scene files that were inspected
    """

    integrator: str
    media: tuple[str, ...]
    polarised: str = ""
    mirrors: bool = False


def scene_facts(scene: mi.Scene) -> Facts:
    """The facts about a scene that is loaded."""
    integrator = scene.integrator()
    # A loaded integrator knows its class, not its plugin; only this one matters here.
    name = "path" if integrator is None or integrator.class_name() == "PathIntegrator" else integrator.class_name()
    media = [scene.sensors()[0].get_medium()]
    for shape in scene.shapes():
        if shape.is_medium_transition():
            media += [shape.interior_medium(), shape.exterior_medium()]
    names = {medium.id() or medium.class_name() for medium in media if medium is not None}
    return Facts(name, tuple(sorted(names)), polarised())


def polarised() -> str:
    """The current variant's name if it renders polarised light, else ""."""
    return mi.variant() if mi.is_polarized else ""
