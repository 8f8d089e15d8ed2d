"""What ``ngpt render`` does, for programs: a scene's stack, and the stacks of a shot's frames.

stack, plan = data_gen.render_scene("scene.xml", spp=64)
stack, plan = data_gen.render_scene(scene, seconds=60, method="auto")  # the method to denoise with: plan.method
for frame, stack in data_gen.render_frames("shot.xml", range(120), spp=16, camera="path.json"): ...
"""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from data_gen.backend import DEFAULT_VARIANT, use_variant
from data_gen.budget import DEFAULT_MEMORY, Budget, wall
from data_gen.frames.pattern import filled
from data_gen.samplers import FRAME_SAMPLERS, check_options
from ngpt.errors import NgptError, WrongUse
from ngpt.stack import GradientStack
from ngpt.system.interrupts import noted

if TYPE_CHECKING:
    import mitsuba as mi

    from data_gen.adaptive import Adaptive
    from data_gen.choosing.plans import Plan
    from data_gen.frames.camera_path import CameraPath
    from data_gen.render import Newest

_LOG = logging.getLogger(f"ngpt.{__name__}")

DEFAULT_SPP = 32


class Rendered(NamedTuple):
    """A stack, and the plan that it was rendered by."""

    stack: GradientStack
    plan: Plan


def render_scene(
    scene: mi.Scene | str | Path,
    spp: int | None = None,
    seed: int = 0,
    sampler: str = "auto",
    *,
    size: tuple[int, int] | None = None,
    parameters: Mapping[str, str] | None = None,
    sensor: int | str | None = None,
    seconds: float | None = None,
    cpu_seconds: float | None = None,
    adaptive: bool = False,
    error: float | None = None,
    method: str | None = None,
    memory: int | None = None,
    diagnostics: bool = False,
    unbiased: bool = False,
    gradients: bool = False,
    needs_features: bool = True,
    subpixels: int | str = "auto",
    variant: str | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
    stop: Callable[[], bool] = lambda: False,
    newest: Newest = lambda stack: None,
    chosen: Callable[[Plan], None] = lambda plan: None,
    said: Callable[[str], None] = lambda line: None,
    **options: Any,
) -> Rendered:
    """Renders the stack of a scene: a Mitsuba scene, a scene file, or a built-in scene by name.

    ``size``        (width, height) in pixels, and ``parameters``, the ``<default>`` values: of files or built-in scenes
    ``sensor``      number or id of the sensor to render, for a file; None: the first
    ``spp``         base paths per pixel (32 if nothing else ends the render); with ``adaptive`` their mean
    ``seconds``     wall-clock time, compilation included; with ``method`` the time of pilot, render and method together
    ``cpu_seconds`` as ``seconds``, but processor time of this process, on all cores: other work hardly changes it
    ``adaptive``    more samples where the error of the result is large
    ``error``       as ``adaptive``, until the result is expected to have this relative error (0.05: 5 %)
    ``method``      the method that will denoise the stack: samples go by its error. With only ``seconds``, a pilot
                    chooses the sampler for it; "auto": the method too
    ``sampler``     "auto" or one of ``data_gen.samplers.SAMPLERS``; ``options`` are its options
    ``memory``      MiB for paths and film, beside the scene (6144)
    ``diagnostics`` adds rates of failed shifts and discarded values as channels
    ``unbiased``    turns off the cache that paths share. The cache lowers the noise of most renders and adds a small
                    bias: see docs/samplers/tails.md
    ``gradients``   whether the stack must have dx and dy, also where a sampler without them leaves less error ("auto")
    ``needs_features``  False: albedo, normal and depth may be missing where a lens blurs them, so they do not pay
    ``subpixels``   2 or 4: keeps 2x2 or 4x4 subpixels of each pixel, for denoisers; 1: none; "auto": where they are
                    known to help (docs/use/subpixels.md)
    ``variant``     variant of Mitsuba; by default the current one, or llvm_ad_rgb if none is set
    ``progress``    called with (samples done, spp), or whole (seconds gone, seconds)
    ``stop``        asked after each pass whether to end there: the stack holds the samples done by then. See
                    ``stop_on_ctrl_c``
    ``newest``      called after each pass with a function that makes the stack of the samples done by then
    ``chosen``      called before the render with what a pilot or the scene's description has chosen
    ``said``        called with a line on each sampler that a pilot tries

    The same seed and number of samples give the same bits. Raises NgptError for options that do not exist or make no
    sense, and for scenes that cannot be loaded or that the sampler cannot render.
    """
    _start(variant)
    from data_gen.adaptive import Adaptive
    from data_gen.choosing import plans
    from data_gen.choosing.trials import Pilot
    from data_gen.inspect import warn_of_lost_light
    from data_gen.render import check_limits, render_stack
    from data_gen.scenes.cameras import sensor_names
    from data_gen.scenes.dark import warn_if_black, warn_without_lamps

    memory = DEFAULT_MEMORY if memory is None else memory
    clock = wall
    if cpu_seconds is not None:
        seconds, clock = _of_processors(cpu_seconds, seconds), time.process_time
    if spp is None and seconds is None and error is None:
        spp = DEFAULT_SPP
    by_itself = sampler == "auto" and seconds is not None and spp is None
    sharing = _sharing(adaptive, error, method, by_itself)
    # Before the scene is loaded, which may take long.
    check_limits(Budget(spp, seconds, memory), seed, sampler, error is not None)
    check_options(sampler, options)
    scene = _loaded(scene, size, parameters, sensor)
    if sensor is None and len(scene.sensors()) > 1:
        names = sensor_names([camera.id() for camera in scene.sensors()])
        said(f"there are {len(scene.sensors())} sensors ({names}), and none is named: 0 is rendered")
    warn_without_lamps(scene)
    plan = None
    if sampler == "auto":
        pilot = Pilot(clock, said, stop, unbiased)
        if sharing is not None:
            plan = plans.plan_adaptive(scene, sharing, seconds, gradients=gradients)
        elif method is None or seconds is None:
            plan = plans.plan_sampler(scene, spp, seconds, memory, pilot, gradients=gradients)
        else:
            plan = plans.plan(scene, seconds, method, memory, pilot)
        plan = plan if needs_features else plans.without_features(scene, plan)
        options |= plan.options
        _LOG.info("plan: sampler %s, method %s: %s", plan.sampler, plan.method or "any", plan.reason)
        chosen(plan)
        sampler, seconds = plan.sampler, plan.render
        sharing = sharing or (Adaptive() if plan.shared else None)
    warn_of_lost_light(scene, sampler)
    stack = render_stack(
        scene,
        spp,
        seed,
        sampler,
        progress,
        seconds=seconds,
        clock=clock,
        memory=memory,
        stop=stop,
        newest=newest,
        diagnostics=diagnostics,
        adaptive=sharing,
        unbiased=unbiased,
        subpixels=subpixels,
        **options,
    )
    warn_if_black(scene, stack["primal"])
    if plan is None:
        used = stack.attributes["ngpt:sampler"]
        plan = plans.Plan(used, method or "", sharing is not None, seconds, "as it was asked for")
    elif plan.method:
        stack.attributes["ngpt:for"] = plan.method
    return Rendered(stack, plan)


def render_frames(
    scene: str,
    frames: Sequence[int],
    spp: int | None = None,
    seed: int = 0,
    sampler: str = "auto",
    *,
    size: tuple[int, int] | None = None,
    parameters: Mapping[str, str] | None = None,
    sensor: int | str | None = None,
    camera: CameraPath | str | Path | None = None,
    fps: float = 24.0,
    dt: int = 0,
    seconds: float | None = None,
    memory: int | None = None,
    diagnostics: bool = False,
    unbiased: bool = False,
    subpixels: int | str = "auto",
    variant: str | None = None,
    skip: Callable[[int], bool] = lambda frame: False,
    stop: Callable[[], bool] = lambda: False,
    progress: Callable[[int], Callable[[int, int], None]] = lambda frame: lambda done, total: None,
    **options: Any,
) -> Iterator[tuple[int, GradientStack]]:
    """(frame, its stack with motion vectors) of each of the ``frames`` of a shot, one after the other.

    ``scene``    file or built-in scene; it and the values of ``parameters`` may hold {frame}, {frame:04d}, {frame * 3}
    ``camera``   its path: key frames (.json), or a file with an animated camera (.glb, .gltf) at so many ``fps``
    ``dt``       pairs of paths a pixel, 2 or more, for differences to the frame before; 0: none
    ``seconds``  for each frame
    ``sampler``  may be one of ``data_gen.samplers.FRAME_SAMPLERS`` too, which reuse the frames before
    ``skip``     asked when a frame's turn has come whether to leave it out
    ``stop``     asked after each pass: a frame that is broken off has ``ngpt:unfinished`` (with ``dt`` it is not
                 given), and none is given after it
    ``progress`` frame -> what is called as the ``progress`` of ``render_scene``

    All else as of ``render_scene``; ``data_gen.frames.shot`` says more of seeds and motion. A shot that changes by
    other means than a file's parameters: ``data_gen.frames.shot.Shot``. Raises NgptError as ``render_scene``, and for
    cameras without a projection.
    """
    if dt == 1:
        raise WrongUse("--dt 1: a variance needs at least 2 pairs; use --dt 2")
    parameters = dict(parameters or {})

    def describe(frame: int) -> tuple[str, dict[str, str]]:
        return filled(scene, frame), {name: filled(text, frame) for name, text in parameters.items()}

    if not isinstance(scene, str):
        raise NgptError(
            f"a shot needs a scene file or a built-in scene, not a {type(scene).__name__}; give a name, or "
            "describe the shot by data_gen.frames.shot.Shot"
        )
    describe(frames[0])
    _start(variant)
    from data_gen.frames.camera_path import read_camera_path
    from data_gen.frames.gltf import read_gltf_camera
    from data_gen.frames.shot import Shot, render_shot
    from data_gen.render import check_limits

    memory = DEFAULT_MEMORY if memory is None else memory
    remembers = FRAME_SAMPLERS.get(sampler)
    if spp is None and (seconds is None or remembers):
        spp = remembers.spp if remembers else DEFAULT_SPP
    check_limits(Budget(spp, seconds, memory), seed, "auto" if remembers else sampler)
    check_options(sampler, options)
    if isinstance(camera, str | Path):
        animated = Path(camera).suffix.lower() in (".glb", ".gltf")
        camera = read_gltf_camera(camera, fps) if animated else read_camera_path(camera)
    options |= {"seconds": seconds, "memory": memory, "stop": stop, "diagnostics": diagnostics, "progress": progress}
    if not remembers:
        options |= {"unbiased": unbiased, "subpixels": subpixels}
    elif subpixels not in ("auto", 1):
        raise WrongUse(f"sampler '{sampler}' reuses earlier frames and has no subpixels: leave --subpixels out")
    found = render_shot(
        Shot(describe, size, camera, sensor=sensor), frames, spp, seed, dt, skip=skip, sampler=sampler, **options
    )

    def whole() -> Iterator[tuple[int, GradientStack]]:
        for frame, stack in found:
            yield frame, stack
            if stop():
                return

    return whole()


# Yields a function that says whether Ctrl-C was pressed, or SIGTERM has come, for ``stop``; the next one interrupts.
stop_on_ctrl_c = noted


def _start(variant: str | None) -> None:
    """Has a variant of Mitsuba ready: the one that is asked for, else the current one, else ours."""
    mitsuba = sys.modules.get("mitsuba")
    use_variant(variant or (mitsuba.variant() if mitsuba else None) or DEFAULT_VARIANT)


def _loaded(
    scene: mi.Scene | str | Path,
    size: tuple[int, int] | None,
    parameters: Mapping[str, str] | None,
    sensor: int | str | None,
) -> mi.Scene:
    from data_gen.scenes.load import check_scene, load_scene

    if isinstance(scene, str | Path):
        return load_scene(str(scene), size, dict(parameters or {}), sensor=sensor)
    check_scene(scene)
    if size is not None or parameters or sensor is not None:
        raise NgptError("size, parameters and sensor of a loaded scene are fixed; give them to data_gen.load_scene")
    return scene


def _of_processors(cpu_seconds: float, seconds: float | None) -> float:
    """The processor seconds; raises WrongUse where they cannot end a render."""
    import mitsuba as mi

    if seconds is not None:
        raise WrongUse("--cpu-time and --time are two limits of time; give one of them")
    if not mi.variant().startswith("llvm"):
        raise WrongUse(f"--cpu-time: variant '{mi.variant()}' does not render on processors; give --time")
    return cpu_seconds


def _sharing(adaptive: bool, error: float | None, method: str | None, by_itself: bool) -> Adaptive | None:
    """How samples are shared out; None: evenly. ``by_itself``: a time is all that is said of samples and sampler."""
    from data_gen.adaptive import Adaptive

    if adaptive or error is not None:
        return Adaptive(error, method or "auto")
    if method is not None and not by_itself:
        raise WrongUse(
            "--for needs --adaptive or --error; or give --time without --sampler and --spp, and a pilot chooses the "
            "sampler for it"
        )
    return None
