"""Facts about a scene that decide which sampler renders it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mitsuba as mi

from data_gen.scenes.cameras import camera_name, check_camera
from data_gen.scenes.integrators import check_integrator, followed, objects_in, plugin_name


@dataclass(frozen=True)
class Facts:
    """Facts about a scene, known without rendering it."""

    # The plugin name (or class name) of the integrator whose image is rendered, see
    # ``data_gen.scenes.integrators.followed``; "path" if the scene has no integrator
    integrator: str
    media: tuple[str, ...]  # the names of its media, sorted
    polarised: str = ""  # the name of a variant that renders polarised light, or ""
    mirrors: bool = False  # whether there are mirrors or clear glass; set only when a scene file is inspected
    grids: bool = False  # whether there are media whose density varies
    camera: str = "perspective"  # the plugin name (or class name) of its first camera
    hair: bool = False  # whether there is Mitsuba's material ``hair``, which is not reciprocal
    spectral: str = ""  # the name of a variant whose paths have wavelengths, or ""
    hides: bool = False  # whether emitters are hidden from the camera


def scene_facts(scene: mi.Scene, sensor: mi.Sensor | None = None, integrator: mi.Integrator | None = None) -> Facts:
    """The facts about a loaded scene with this ``sensor`` and ``integrator`` (default: the scene's own). Raises
    NgptError for a camera or integrator that no sampler renders."""
    camera, integrator = sensor or scene.sensors()[0], integrator or scene.integrator()
    check_camera(camera)
    if integrator is not None:
        check_integrator(integrator)
    media = media_of(scene)
    names = {medium.id() or medium.class_name() for medium in media}
    grids = any(not medium.is_homogeneous() for medium in media)
    hair = any(_has_hair(shape.bsdf()) for shape in shapes_of(scene))
    reference = None if integrator is None else followed(integrator)
    return Facts(
        "path" if reference is None else plugin_name(reference),
        tuple(sorted(names)),
        grids=grids,
        camera=camera_name(camera),
        hair=hair,
        hides=bool(getattr(reference, "hide_emitters", False)),
        **colours(),
    )


def shapes_of(scene: mi.Scene) -> list[mi.Shape]:
    """All shapes of a scene, including those in shape groups, which Mitsuba does not list."""
    groups = (shape for shape in objects_in(scene, mi.Shape) if shape.class_name() == "ShapeGroupPlugin")
    return [*scene.shapes(), *(shape for group in groups for shape in objects_in(group, mi.Shape))]


def _has_hair(bsdf: mi.BSDF | None) -> bool:
    """Whether a material is hair or contains hair, as a mask, a blend or a two-sided material may."""
    if bsdf is None:
        return False
    return bsdf.class_name() == "Hair" or any(map(_has_hair, objects_in(bsdf, mi.BSDF)))


def integrator_name(scene: mi.Scene) -> str:
    """The plugin name (or class name) of the integrator whose image is rendered."""
    return "path" if scene.integrator() is None else plugin_name(followed(scene.integrator()))


def media_of(scene: mi.Scene) -> list[mi.Medium]:
    """All media of a scene, including the camera's."""
    found = [scene.sensors()[0].get_medium()]
    for shape in shapes_of(scene):
        if shape.is_medium_transition():
            found += [shape.interior_medium(), shape.exterior_medium()]
    return [medium for medium in found if medium is not None]


def colours() -> dict[str, Any]:
    """The facts ``polarised`` and ``spectral`` about the current variant."""
    name = mi.variant()
    return {"polarised": name if mi.is_polarized else "", "spectral": name if mi.is_spectral else ""}
