"""Python functions that do what ``ngpt render`` does: they render a scene's stack, or the stacks of a shot's frames.

stack, plan = data_gen.render_scene("scene.xml", spp=64)
stack, plan = data_gen.render_scene(scene, seconds=60, method="auto")  # the method to denoise with: plan.method
for frame, stack in data_gen.render_frames("shot.xml", range(120), spp=16, camera="path.json"): ...
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from data_gen.backend import use_variant
from data_gen.pattern import filled
from data_gen.request import RenderRequest, asked
from ngpt.errors import NgptError, WrongUse
from ngpt.stack import GradientStack
from ngpt.system.interrupts import noted

if TYPE_CHECKING:
    import mitsuba as mi

    from data_gen.budget import Watch
    from data_gen.choosing.plans import Plan
    from data_gen.frames.shot import Shot

_LOG = logging.getLogger(f"ngpt.{__name__}")


class Rendered(NamedTuple):
    """A stack, and the plan that it was rendered by."""

    stack: GradientStack
    plan: Plan


def render_scene(
    scene: mi.Scene | str | Path | RenderRequest,
    spp: int | None = None,
    seed: int = 0,
    sampler: str = "auto",
    **given: Any,
) -> Rendered:
    """Renders the stack of a scene: a Mitsuba scene, a scene file, or a built-in scene by name.

    ``given`` are fields of ``data_gen.request.RenderRequest``, which says what they mean, functions of
    ``data_gen.budget.Watch``, which follow the render (``progress``, ``stop``, ...), and options of the sampler. If a
    request is given in place of the scene, ``given`` may contain only functions.

    The same seed and number of samples give the same bits. Raises NgptError for options that do not exist or make no
    sense, and for scenes that cannot be loaded or that the sampler cannot render.
    """
    request, watch = asked(scene, {"spp": spp, "seed": seed, "sampler": sampler, **given})
    if request.frames:
        raise WrongUse(f"{len(request.frames)} frames were asked for, and one image is rendered; use render_frames")
    use_variant(str(request.variant))
    from data_gen.inspect import warn_of_lost_light
    from data_gen.render import render
    from data_gen.scenes.dark import warn_if_black, warn_without_lamps

    header = request.header()
    loaded = _loaded(request, watch)
    warn_without_lamps(loaded)
    plan = _planned(loaded, request, watch)
    if request.sampler == "auto":
        watch.chosen(plan)
        changes: Any = {"seconds" if request.cpu_seconds is None else "cpu_seconds": plan.render}
        changes |= {} if request.shares else {"adaptive": plan.shared, "method": None}
        request = replace(request, sampler=plan.sampler, options={**request.options, **plan.options}, **changes)
        header |= {"ngpt:for": plan.method} if plan.method else {}
    warn_of_lost_light(loaded, request.sampler)
    stack = render(loaded, request, watch, more=header)
    warn_if_black(loaded, stack["primal"])
    return Rendered(stack, plan)


def render_frames(
    scene: str | Shot | RenderRequest,
    frames: Sequence[int] = (),
    spp: int | None = None,
    seed: int = 0,
    sampler: str = "auto",
    *,
    skip: Callable[[int], bool] = lambda frame: False,
    progress: Callable[[int], Callable[[int, int], None]] = lambda frame: lambda done, total: None,
    **given: Any,
) -> Iterator[tuple[int, GradientStack]]:
    """Yields (frame, stack with motion vectors) for each of the ``frames`` of a shot, one after the other.

    ``skip``     called when a frame's turn has come; returns whether to leave the frame out
    ``progress`` frame -> a function that is called as the ``progress`` of ``render_scene``

    All else is as in ``render_scene``; ``data_gen.frames.shot`` describes seeds and motion. If ``stop`` ends a frame
    early, this frame is the last one and has the attribute ``ngpt:unfinished``; with ``dt`` it is not yielded. A shot
    whose frames differ in more than a scene file's parameters is given as a ``data_gen.frames.shot.Shot``. Raises
    NgptError as ``render_scene`` does, and for cameras without a projection.
    """
    request, watch = asked(scene, {"spp": spp, "seed": seed, "sampler": sampler, **given}, frames)
    if not request.frames:
        raise WrongUse("there are no frames to render; give their numbers")
    use_variant(str(request.variant))
    from data_gen.frames.shot import Shot, render_shot

    shot = request.scene if isinstance(request.scene, Shot) else _shot(request)
    found = render_shot(shot, request, watch, skip=skip, progress=progress)

    def whole() -> Iterator[tuple[int, GradientStack]]:
        for frame, stack in found:
            yield frame, stack
            if watch.stop():
                return

    return whole()


# A context that yields a function for ``stop``. It returns True after Ctrl-C or SIGTERM; a second signal interrupts.
stop_on_ctrl_c = noted


def _shot(request: RenderRequest) -> Shot:
    """The shot of a file or a built-in scene."""
    from data_gen.frames.camera_path import read_camera_path
    from data_gen.frames.gltf import read_gltf_camera
    from data_gen.frames.shot import Shot

    if not isinstance(request.scene, str):
        raise NgptError(
            f"a shot needs a scene file or a built-in scene, not a {type(request.scene).__name__}; give a name, or "
            "describe the shot by data_gen.frames.shot.Shot"
        )

    def describe(frame: int) -> tuple[str, dict[str, str]]:
        return filled(request.scene, frame), {name: filled(text, frame) for name, text in request.parameters.items()}

    describe(request.frames[0])
    camera = request.camera
    if isinstance(camera, str | Path):
        animated = Path(camera).suffix.lower() in (".glb", ".gltf")
        camera = read_gltf_camera(camera, request.fps) if animated else read_camera_path(camera)
    return Shot(describe, request.size, camera, sensor=request.sensor)


def _loaded(request: RenderRequest, watch: Watch) -> mi.Scene:
    from data_gen.scenes.cameras import sensor_names
    from data_gen.scenes.load import check_scene, load_scene

    if not isinstance(request.scene, str):
        scene = check_scene(request.scene)
    else:
        scene = load_scene(request.scene, request.size, dict(request.parameters), sensor=request.sensor)
    if request.sensor is None and len(scene.sensors()) > 1:
        names = sensor_names([camera.id() for camera in scene.sensors()])
        watch.said(f"there are {len(scene.sensors())} sensors ({names}), and none is named: 0 is rendered")
    return scene


def _planned(scene: mi.Scene, request: RenderRequest, watch: Watch) -> Plan:
    """How to render: as requested, or as a pilot or the description of the scene suggests."""
    from data_gen.choosing import plans
    from data_gen.choosing.trials import Pilot

    budget = request.budget
    if request.sampler != "auto":
        return plans.Plan(request.sampler, request.method or "", request.shares, budget.seconds, "as it was asked for")
    pilot = Pilot(budget.clock, watch.said, watch.stop, request.unbiased)
    if request.shares:
        plan = plans.plan_adaptive(scene, request)
    elif request.method is None:
        plan = plans.plan_sampler(scene, request, pilot)
    else:
        plan = plans.plan(scene, request, pilot)
    plan = plan if request.needs_features else plans.without_features(scene, plan)
    _LOG.info("plan: sampler %s, method %s: %s", plan.sampler, plan.method or "any", plan.reason)
    return plan
