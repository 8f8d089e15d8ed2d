"""Scenes: loaded from a Mitsuba file or built in, with errors that say what is wrong."""

from __future__ import annotations

import re
from pathlib import Path

import mitsuba as mi

from data_gen.scenes.builtin import SCENES
from data_gen.scenes.merging import load_merged
from ngpt.errors import NgptError, stop_if_interrupted


def load_scene(
    name: str,
    size: tuple[int, int] | None = None,
    parameters: dict[str, str] | None = None,
    *,
    merged: bool = True,
) -> mi.Scene:
    """Loads a Mitsuba 3 scene file, or the built-in scene of that name.

    ``size`` is (width, height) in pixels and replaces that of the scene's film, crop window included; ``parameters``
    sets the file's ``<default>`` values. Meshes of one material are ``merged`` into one, which renders the same and
    starts much sooner; where they are to move, or to be found by name, they must not be. Raises NgptError with the file
    and Mitsuba's own complaint when it cannot.
    """
    parameters = parameters or {}
    try:
        if Path(name).is_file():
            scene = (
                load_merged(name, parameters)
                if merged
                else mi.load_file(name, parallel=False, optimize=False, **parameters)
            )
        elif name in SCENES:
            if parameters:
                raise NgptError(f"built-in scene '{name}' has no parameters to set (got {', '.join(parameters)})")
            scene = mi.load_dict(SCENES[name](), parallel=False, optimize=False)
        else:
            raise NgptError(f"{name}: no such file, nor a built-in scene; those are: {', '.join(SCENES)}")
    except (RuntimeError, TypeError, ValueError) as error:
        if isinstance(error, NgptError):
            raise
        stop_if_interrupted(error)
        raise NgptError(f"{name}: Mitsuba cannot load it: {complaint(error)}") from error
    if not isinstance(scene, mi.Scene):
        raise NgptError(f"{name}: describes a {type(scene).__name__}, not a whole scene")
    if not scene.sensors():
        raise NgptError(f"{name}: the scene has no sensor (camera)")
    if size is not None:
        set_film_size(scene, size)
    return scene


def check_scene(scene: object) -> mi.Scene:
    """The scene, where it is one of the current variant. Raises NgptError for what has to be loaded first."""
    if isinstance(scene, mi.Scene):
        return scene
    kind = type(scene).__name__
    if isinstance(scene, dict):
        raise NgptError("a dictionary describes a scene and is none; load it: mi.load_dict(scene)")
    if isinstance(scene, str | Path):
        raise NgptError(f"'{scene}' is a scene's name; load it: data_gen.load_scene('{scene}')")
    if kind == "Scene":
        raise NgptError(f"the scene is of another variant than the current one, '{mi.variant()}'; load it again")
    article = "an" if kind[0] in "aeiou" else "a"
    raise NgptError(f"{article} {kind} is given where a scene is wanted; give an mi.Scene")


def complaint(error: Exception) -> str:
    """What Mitsuba says is wrong with a scene, in one line, and in our words where its own do not help."""
    text = " ".join(str(error).split())
    if "<animation>" in text:
        return f"animated transforms (motion blur) are not known to Mitsuba {mi.__version__}; remove <animation>"
    return text


def set_film_size(scene: mi.Scene, size: tuple[int, int]) -> None:
    """Sets the film of the scene's first sensor to ``size`` = (width, height) pixels, without a crop window."""
    sensor = scene.sensors()[0]
    params = mi.traverse(sensor)
    params["film.size"] = list(size)
    params.update()


def path_depths(path: mi.SamplingIntegrator) -> dict[str, int]:
    """``max_depth`` (-1: no limit) and ``rr_depth`` of an integrator like ``path``; {} where they cannot be read."""
    # Mitsuba exposes neither depth as a parameter, only in print.
    depths = {key: int(value) for key, value in re.findall(r"(\w+_depth) = (\d+)", str(path))}
    if depths.keys() != {"max_depth", "rr_depth"}:
        return {}
    return depths | {"max_depth": -1 if depths["max_depth"] >= 0x7FFFFFFF else depths["max_depth"]}


def reference_integrator(scene: mi.Scene) -> mi.SamplingIntegrator:
    """The scene's own integrator, or Mitsuba's ``path`` if it has none; it decides what transport is rendered."""
    integrator = scene.integrator() or mi.load_dict({"type": "path"})
    if not isinstance(integrator, mi.SamplingIntegrator):
        raise NgptError(
            f"integrator '{integrator.class_name()}' does not trace paths from the camera, so it has no gradients; "
            "give the scene a 'path' or 'volpath' integrator"
        )
    return integrator
