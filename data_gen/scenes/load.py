"""Loads scenes, from Mitsuba files or built in, with errors that say what is wrong."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType

import drjit as dr
import mitsuba as mi

from data_gen.scenes.bounds import mend_bounds
from data_gen.scenes.builtin import SCENES, no_scene
from data_gen.scenes.cameras import sensor_number
from data_gen.scenes.integrators import check_integrator, followed
from data_gen.scenes.merge import merge
from data_gen.scenes.nodes import parts_of
from ngpt.errors import NgptError, stop_if_interrupted

# With at least this many threads every scene finishes loading: see ``_enough_threads``
_LOADING = 2


def load_scene(
    name: str,
    size: tuple[int, int] | None = None,
    parameters: dict[str, str] | None = None,
    *,
    merged: bool = True,
    sensor: int | str | None = None,
) -> mi.Scene:
    """Loads a Mitsuba 3 scene file, or the built-in scene of that name.

    ``size`` is (width, height) in pixels and replaces the scene's film size; a crop window stays the same part of the
    film. ``parameters`` sets the file's ``<default>`` values. ``merged`` joins the meshes of each material into one.
    The image is the same, and the render starts much sooner. ``merged`` must be False if meshes move or are looked up
    by name. If ``sensor`` (a number or an id) is given, a scene file is loaded with only this sensor. Raises NgptError
    with Mitsuba's message.
    """
    parameters = parameters or {}
    try:
        if Path(name).is_file():
            with _enough_threads():
                scene = load_file(name, parameters, merged, sensor)
        elif name in SCENES:
            if parameters:
                raise NgptError(f"built-in scene '{name}' has no parameters to set (got {', '.join(parameters)})")
            with _enough_threads():
                scene = mi.load_dict(SCENES[name](), parallel=False, optimize=False)
            sensor_number(sensor, [camera.id() for camera in scene.sensors()], name)
        else:
            raise no_scene(name)
    except (RuntimeError, TypeError, ValueError) as error:
        if isinstance(error, NgptError):
            raise
        stop_if_interrupted(error)
        raise NgptError(f"{name}: Mitsuba cannot load it: {complaint(error)}") from error
    if not isinstance(scene, mi.Scene):
        raise NgptError(f"{name}: describes a {type(scene).__name__}, not a whole scene")
    if not scene.sensors():
        raise NgptError(f"{name}: the scene has no sensor (camera)")
    mend_bounds(scene)
    if size is not None:
        set_film_size(scene, size)
    return scene


def check_scene(scene: object) -> mi.Scene:
    """Returns the scene, with corrected bounding boxes (see ``bounds``).

    Raises NgptError for an object that is no loaded scene of the current variant.
    """
    if isinstance(scene, mi.Scene):
        mend_bounds(scene)
        return scene
    kind = type(scene).__name__
    if isinstance(scene, dict):
        raise NgptError("a dictionary is not a loaded scene; load it: mi.load_dict(scene)")
    if isinstance(scene, str | Path):
        raise NgptError(f"'{scene}' is a scene's name; load it: data_gen.load_scene('{scene}')")
    if kind == "Scene":
        raise NgptError(f"the scene is of another variant than the current one, '{mi.variant()}'; load it again")
    article = "an" if kind[0] in "aeiou" else "a"
    raise NgptError(f"{article} {kind} is not a scene; give an mi.Scene")


def complaint(error: Exception) -> str:
    """Mitsuba's error about a scene, in one line. An unclear message is replaced by a clear one."""
    text = " ".join(str(error).split())
    if "<animation>" in text:
        return f"animated transforms (motion blur) are not known to Mitsuba {mi.__version__}; remove <animation>"
    return text


@contextmanager
def _enough_threads() -> Iterator[None]:
    """A context with at least two threads. With one thread, some files never finish loading (Mitsuba 3.9.1)."""
    before = dr.thread_count()
    if before >= _LOADING:
        yield
        return
    dr.set_thread_count(_LOADING)
    try:
        yield
    finally:
        dr.set_thread_count(before)


def set_film_size(scene: mi.Scene, size: tuple[int, int]) -> None:
    """Sets the film of the scene's first sensor to ``size`` = (width, height) pixels.

    A crop window stays the same part of the film. Its edges are rounded to pixels, so adjacent windows stay adjacent.
    """
    sensor = scene.sensors()[0]
    film = sensor.film()
    crop = [_scaled(*each) for each in zip(film.crop_offset(), film.crop_size(), film.size(), size, strict=True)]
    params = mi.traverse(sensor)
    params["film.size"] = list(size)
    # A new size resets the window to the whole film, so the window is set afterwards.
    params.update()
    if crop != [(0, length) for length in size]:
        params["film.crop_offset"], params["film.crop_size"] = ([*each] for each in zip(*crop, strict=True))
        params.update()


@contextmanager
def at_most(scene: mi.Scene, pixels: int):
    """Shrinks the scene's film to at most ``pixels`` within the block; yields the old number of pixels / the new.

    A cropped film keeps its size, since its window could not be restored.
    """
    film = scene.sensors()[0].film()
    (width, height), window = (tuple(int(n) for n in numbers) for numbers in (film.size(), film.crop_size()))
    shrink = math.sqrt(pixels / (width * height))
    if shrink >= 1 or (width, height) != window:
        yield 1.0
        return
    small = max(1, round(width * shrink)), max(1, round(height * shrink))
    set_film_size(scene, small)
    try:
        yield width * height / (small[0] * small[1])
    finally:
        set_film_size(scene, (width, height))


def _scaled(begin: int, length: int, whole: int, new: int) -> tuple[int, int]:
    """Scales a part of a film of ``whole`` pixels to a film of ``new`` pixels. The result has at least one pixel."""
    first, end = ((2 * int(edge) * new + int(whole)) // (2 * int(whole)) for edge in (begin, begin + length))
    first = min(first, new - 1)
    return first, max(end - first, 1)


def path_depths(path: mi.SamplingIntegrator) -> dict[str, int]:
    """``max_depth`` (-1: no limit) and ``rr_depth`` of an integrator like ``path``; {} if they cannot be read."""
    # Mitsuba does not expose the depths as parameters, but prints them.
    depths = {key: int(value) for key, value in re.findall(r"(\w+_depth) = (\d+)", str(path))}
    if depths.keys() != {"max_depth", "rr_depth"}:
        return {}
    return depths | {"max_depth": -1 if depths["max_depth"] >= 0x7FFFFFFF else depths["max_depth"]}


def reference_integrator(scene: mi.Scene) -> mi.SamplingIntegrator:
    """The integrator that defines the rendered transport: the scene's own, the one followed instead of it, or Mitsuba's
    ``path`` if the scene has none. Raises NgptError for an integrator without camera rays."""
    integrator = scene.integrator() or mi.load_dict({"type": "path"})
    check_integrator(integrator)
    return followed(integrator)


def load_file(path: str, parameters: dict[str, str], merged: bool, sensor: int | str | None) -> object:
    """Loads what ``mi.load_file`` loads. If ``sensor`` (a number or an id) is given, the scene has only this sensor.

    ``merged`` merges meshes by ``data_gen.scenes.merge``. Mitsuba's own merging (``optimize=True``) changes the order
    of shapes and emitters from call to call, and with it the bits of the image.
    """
    with found_beside(path):
        config, state = parsed(path, parameters)
        if state.root.props.plugin_name() == "scene":
            if sensor is not None:
                _keep(state, sensor, path)
            if merged:
                merge(config, state)
        return mi.parser.instantiate(config, state)


def parsed(path: str, parameters: Mapping[str, str] = MappingProxyType({})) -> tuple:
    """Mitsuba's configuration and state of a scene file that is parsed but not instantiated."""
    config = mi.parser.ParserConfig(mi.variant())
    config.merge_equivalent = config.merge_meshes = False
    # With parallel loading, the numbers of objects differ from process to process. The kernels then differ too, and
    # each process would compile them again.
    config.parallel = False
    state = mi.parser.parse_file(config, path, **parameters)
    mi.parser.transform_all(config, state)
    return config, state


def _keep(state: mi.parser.ParserState, sensor: int | str, path: str) -> None:
    """Removes all sensors of the scene except one. Raises WrongUse if there is no such sensor."""
    scene, nodes = state.root.props, state.nodes
    sensors = [(name, nodes[number]) for name, number in parts_of(scene) if nodes[number].type == mi.ObjectType.Sensor]
    found = {name: node.props.id() for name, node in sensors}
    if found:
        kept = sensor_number(sensor, list(found.values()), path)
        for number, name in enumerate(found):
            if number != kept:
                del scene[name]


@contextmanager
def found_beside(path: str):
    """A context in which Mitsuba looks for files in the scene's folder first."""
    resolver = mi.file_resolver()
    before = list(resolver)
    resolver.prepend(str(Path(path).resolve().parent))
    try:
        yield
    finally:
        resolver.clear()
        for folder in before:
            resolver.append(folder)
