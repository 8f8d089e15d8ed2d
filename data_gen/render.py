"""From a scene, a Mitsuba file or a built-in one, to a gradient stack."""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import mitsuba as mi

from data_gen.film import GradientFilm
from data_gen.paths.camera import DEFAULT_MEMORY, CameraSamples, Progress, render_passes
from data_gen.paths.features import features
from data_gen.paths.lights import emission_seen
from data_gen.paths.spectrum import to_rgb
from data_gen.scenes.builtin import SCENES
from ngpt.errors import NgptError
from ngpt.io.exr import with_channels
from ngpt.stack import GradientStack
from ngpt.version import __version__

# Name -> what it renders, as the command line explains it.
SAMPLERS = {
    "gpt": "gradients by shifted paths that join their base path (surfaces; the sampler to use)",
    "gpt-basic": "gradients by random sequence replay (five paths per sample; the teaching sampler)",
    "primal": "the scene's own integrator without gradients (references, primal denoisers)",
}


def load_scene(name: str, size: tuple[int, int] | None = None, parameters: dict[str, str] | None = None) -> mi.Scene:
    """Loads a Mitsuba 3 scene file, or the built-in scene of that name.

    ``size`` is (width, height) in pixels and replaces that of the scene's film, crop window included; ``parameters``
    sets the file's ``<default>`` values. Raises NgptError with the file and Mitsuba's own complaint when it cannot.
    """
    parameters = parameters or {}
    try:
        if Path(name).is_file():
            # Merged as Mitsuba would, shapes and emitters come in another order each time, and with them other bits.
            scene = mi.load_file(name, optimize=False, **parameters)
        elif name in SCENES:
            if parameters:
                raise NgptError(f"built-in scene '{name}' has no parameters to set (got {', '.join(parameters)})")
            scene = mi.load_dict(SCENES[name](), optimize=False)
        else:
            raise NgptError(f"{name}: no such file, nor a built-in scene; those are: {', '.join(SCENES)}")
    except (RuntimeError, TypeError, ValueError) as error:
        if isinstance(error, NgptError):
            raise
        raise NgptError(f"{name}: Mitsuba cannot load it: {complaint(error)}") from error
    if not isinstance(scene, mi.Scene):
        raise NgptError(f"{name}: describes a {type(scene).__name__}, not a whole scene")
    if not scene.sensors():
        raise NgptError(f"{name}: the scene has no sensor (camera)")
    if size is not None:
        set_film_size(scene, size)
    return scene


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


def reference_integrator(scene: mi.Scene) -> mi.SamplingIntegrator:
    """The scene's own integrator, or Mitsuba's ``path`` if it has none; it decides what transport is rendered."""
    integrator = scene.integrator() or mi.load_dict({"type": "path"})
    if not isinstance(integrator, mi.SamplingIntegrator):
        raise NgptError(
            f"integrator '{integrator.class_name()}' does not trace paths from the camera, so it has no gradients; "
            "give the scene a 'path' or 'volpath' integrator"
        )
    return integrator


def describe(scene: mi.Scene) -> tuple[str, list[str]]:
    """What the choice of a sampler depends on: the scene's integrator, as a plugin name, and the names of its media."""
    integrator = scene.integrator()
    # A loaded integrator knows its class, not its plugin; only this one matters here.
    name = "path" if integrator is None or integrator.class_name() == "PathIntegrator" else integrator.class_name()
    media = [scene.sensors()[0].get_medium()]
    for shape in scene.shapes():
        if shape.is_medium_transition():
            media += [shape.interior_medium(), shape.exterior_medium()]
    return name, sorted({medium.id() or medium.class_name() for medium in media if medium is not None})


def choose_sampler(integrator: str, media: list[str]) -> tuple[str, str]:
    """The sampler that "auto" stands for, and why, for what ``describe`` tells of a scene."""
    if mi.is_polarized:
        return "gpt-basic", f"variant '{mi.variant()}' is polarised, which 'gpt' does not follow"
    if integrator != "path":
        return "gpt-basic", f"the integrator is '{integrator}', and 'gpt' knows only 'path'"
    if media:
        return "gpt-basic", f"there are media ({', '.join(media)}), which 'gpt' does not see"
    return "gpt", "the integrator is 'path' and there are no media"


def gpt_integrator(scene: mi.Scene, diagnostics: bool = False) -> mi.SamplingIntegrator:
    """Our integrator with the parameters of the scene's own; raises NgptError where it cannot stand in for that.

    With ``diagnostics`` it also records which share of each sample's shifts failed.
    """
    name, media = describe(scene)
    sampler, reason = choose_sampler(name, media)
    if sampler != "gpt":
        raise NgptError(
            f"sampler 'gpt' cannot render this scene: {reason}; use --sampler gpt-basic, or primal: no gradients"
        )
    path = reference_integrator(scene)
    # Mitsuba exposes neither depth as a parameter, only in print.
    depths = {key: int(value) for key, value in re.findall(r"(\w+_depth) = (\d+)", str(path))}
    if depths.keys() != {"max_depth", "rr_depth"}:
        raise NgptError(
            f"cannot read max_depth and rr_depth from the integrator, which describes itself as {str(path)!r}; "
            "use --sampler gpt-basic"
        )
    unlimited = depths["max_depth"] >= 0x7FFFFFFF
    depths["max_depth"] = -1 if unlimited else depths["max_depth"]
    gpt = mi.load_dict({"type": "gpt", "hide_emitters": path.hide_emitters, **depths})
    gpt.diagnostics = diagnostics
    return gpt


def render_stack(
    scene: mi.Scene,
    spp: int | None,
    seed: int = 0,
    sampler: str = "auto",
    progress: Progress = lambda done, total: None,
    *,
    seconds: float | None = None,
    memory: int = DEFAULT_MEMORY,
    stop: Callable[[], bool] = lambda: False,
    diagnostics: bool = False,
    with_features: bool = True,
) -> GradientStack:
    """Renders a stack from the scene's first sensor.

    ``spp`` is the number of (base) paths per pixel, ``seconds`` a limit of wall-clock time (one of them may be None),
    ``sampler`` "auto" or one of ``SAMPLERS``, and ``progress`` is called with (samples done, spp) before the first pass
    and after each; for it, ``memory`` and ``stop`` see ``data_gen.paths.camera.render_passes()``. With ``diagnostics``
    the stack carries the images of ``data_gen.film.GradientFilm.diagnose()`` as further channels; without
    ``with_features``, which sampler "primal" alone can do without, it holds the primal alone. The scene's
    reconstruction filter is not used: the pixels of a stack, and so their differences, are box-filtered.

    The same seed and number of samples give the same bits, however they came about.
    """
    check_options(spp, seed, sampler, seconds, memory)
    if sampler == "auto":
        sampler, _ = choose_sampler(*describe(scene))
    if not with_features and sampler != "primal":
        raise NgptError(f"sampler '{sampler}' always renders features; only 'primal' can leave them out")
    start = time.perf_counter()
    passes = {"progress": progress, "seconds": seconds, "memory": memory, "stop": stop}
    film = render_film(sampler, scene, seed, spp, diagnostics, passes, with_features)
    layers = film.develop()
    attributes = {
        "ngpt:spp": film.samples,
        "ngpt:seed": str(seed),
        "ngpt:sampler": sampler,
        "ngpt:seconds": time.perf_counter() - start,
        "ngpt:normalSpace": "camera",
        "ngpt:discarded": film.discarded,
        "software": f"ngpt {__version__}, Mitsuba {mi.__version__} {mi.variant()}",
    }
    stack = GradientStack(layers, attributes=attributes)
    return with_channels(stack, film.diagnose()) if diagnostics else stack


def check_options(spp: int | None, seed: int, sampler: str, seconds: float | None, memory: int) -> None:
    """Raises NgptError for what no scene could be rendered with."""
    if spp is None and seconds is None:
        raise NgptError("neither a number of samples per pixel nor a time to render for is given")
    if spp is not None and not 1 <= spp < 2**31:
        raise NgptError(f"{spp} samples per pixel: from 1 to 2^31 - 1 can be rendered")
    if seconds is not None and not 0 < seconds < float("inf"):
        raise NgptError(f"cannot render for {seconds:g} s; give a positive number of seconds")
    if not 0 <= seed < 2**64:
        raise NgptError(f"seed {seed} is out of range; use 0 .. 2^64 - 1")
    if memory < 1:
        raise NgptError(f"{memory} MiB of memory: give a positive number")
    if sampler not in ("auto", *SAMPLERS):
        raise NgptError(f"unknown sampler '{sampler}'; choose one of: auto, {', '.join(SAMPLERS)}")


def render_film(
    sampler: str,
    scene: mi.Scene,
    seed: int,
    spp: int | None,
    diagnostics: bool = False,
    passes: dict | None = None,
    with_features: bool = True,
) -> GradientFilm:
    """Runs the sampler of that name; ``passes`` are options of ``data_gen.paths.camera.render_passes()``."""
    sensor, passes = scene.sensors()[0], passes or {}
    integrator = reference_integrator(scene)
    if sampler == "gpt":
        return gpt_integrator(scene, diagnostics).render_film(scene, sensor, seed, spp, **passes)
    if sampler == "gpt-basic":
        gpt = mi.load_dict({"type": "gpt_basic", "integrator": integrator})
        return gpt.render_film(scene, sensor, seed, spp, **passes)
    sample = partial(sample_primal, scene, integrator, with_features)
    return render_passes(sample, sensor, seed, spp, **passes)


def sample_primal(scene, integrator, with_features: bool, camera: CameraSamples, film: GradientFilm) -> None:
    """One sample of radiance, and of features, for each camera sample, by Mitsuba's integrator alone."""
    ray, importance, _ = camera.rays()
    L, _, _ = integrator.sample(scene, camera.random.clone(), ray, camera.sensor.get_medium())
    film.put("primal", to_rgb(L * importance, ray.wavelengths))
    if with_features:
        Le = emission_seen(scene, integrator, camera.sensor.get_medium(), ray, mi.Bool(True))
        film.put("direct", to_rgb(Le * importance, ray.wavelengths))
        film.put_all(features(scene, camera.sensor, camera.random.clone(), ray))
