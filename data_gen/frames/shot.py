"""Shots (frame sequences): a scene over time, and its stacks frame by frame."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import mitsuba as mi
import numpy as np

from data_gen.begun import Unfinished, frame_seed
from data_gen.budget import Watch
from data_gen.frames.camera_path import CameraPath, horizontal
from data_gen.frames.motion import Snapshot, depth, motion_vectors, seen, snapshot, window_moved
from data_gen.frames.time_differences import difference, light
from data_gen.render import options_as_attribute, render, stack_of
from data_gen.request import RenderRequest
from data_gen.samplers import FRAME_SAMPLERS, FrameSampler
from data_gen.scenes.dark import warn_without_lamps
from data_gen.scenes.facts import scene_facts
from data_gen.scenes.geometry import Geometry
from data_gen.scenes.load import load_scene
from ngpt.errors import NgptError, stop_if_interrupted
from ngpt.merging import UNFINISHED
from ngpt.stack import GradientStack


class Remembering:
    """Renders the frames of one shot by a sampler that remembers previous frames.

    ``changes`` says whether more than the camera may change from frame to frame.
    """

    def __init__(self, entry: FrameSampler, changes: bool, request: RenderRequest):
        self.entry, self.changes, self.request = entry, changes, request
        self.options = entry.settings(request.options)
        self._sampler: Any = None
        self._making = 0.0  # seconds to make the sampler, counted for the first frame

    def begin(self, scene: mi.Scene) -> None:
        """Makes the sampler if there is none yet. Raises NgptError if it refuses the scene or lacks memory."""
        if self._sampler is None:
            if reason := self.entry.refuses(scene_facts(scene)):
                raise NgptError(f"sampler '{self.entry.name}' cannot render this scene: {reason}; use --sampler gpt")
            start = time.perf_counter()
            spp, memory = self.request.spp, self.request.budget.memory
            self._sampler = self.entry.made(scene, self.request.seed, spp, memory, **self.options)
            self._making = time.perf_counter() - start

    def render(
        self,
        scene: mi.Scene,
        shapes: Sequence[Geometry],
        index: int,
        motion: np.ndarray,
        depth: np.ndarray | None,
        progress: Callable[[int, int], None],
    ) -> GradientStack:
        """The stack of frame number ``index`` of the shot, after ``begin``. ``shapes`` are those of the ``scene``.

        If the shot ``changes``, ``scene`` must not be the same object as the scene of the frame before. That scene must
        stay as it was in its frame.
        """
        start, self._making = time.perf_counter() - self._making, 0.0
        spp = int(self.request.spp or 0)
        progress(0, spp)
        film = self._sampler.film(index, motion, depth, (scene, shapes) if self.changes else None)
        progress(spp, spp)
        more = {"ngpt:confidence": self._sampler.confidence} | options_as_attribute(self.entry, self.options)
        sensor, name = scene.sensors()[0], self.entry.name
        return stack_of(film, sensor, self.request.seed, name, start, more, diagnostics=self.request.diagnostics)


class Shot:
    """A scene over time: ``at(frame)`` is the scene in the state of that frame.

    ``describe``  frame -> the scene's file or name, and its ``<default>`` values. The scene is loaded again only if
                  they change. Kernels are compiled once if all frames consist of the same kinds of things.
    ``camera``    moves the first sensor
    ``sensor``    number or id of the sensor to render; None: the first
    ``update``    changes ``mi.traverse(scene)`` for a frame; it must set the same parameters in every frame
    """

    def __init__(
        self,
        describe: Callable[[int], tuple[str, Mapping[str, str]]],
        size: tuple[int, int] | None = None,
        camera: CameraPath | None = None,
        update: Callable[[mi.SceneParameters, int], None] | None = None,
        sensor: int | str | None = None,
    ):
        self.describe, self.size, self.camera, self.update, self.sensor = describe, size, camera, update, sensor
        self._loaded: Any = None
        self._scene: mi.Scene | None = None
        self._shapes: tuple[Geometry, ...] | None = None

    def at(self, frame: int) -> mi.Scene:
        """The scene in the state of a frame. A scene that was returned earlier must not be used any more."""
        name, parameters = self.describe(frame)
        wanted = (name, dict(parameters))
        if self._scene is None or wanted != self._loaded:
            self._scene = self._shapes = None
            gc.collect()  # two scenes in memory would make kernels larger
            self._scene = load_scene(name, self.size, wanted[1], merged=False, sensor=self.sensor)
            if self._loaded is None:
                warn_without_lamps(self._scene)
            self._loaded = wanted
        scene = self._scene
        if self.update is not None:
            params = mi.traverse(scene)
            self.update(params, frame)
            params.update()
            self._shapes = None
        if self.camera is not None:
            self._place_camera(scene.sensors()[0], frame)
        return scene

    def snapshot(self, frame: int) -> Snapshot:
        taken = snapshot(self.at(frame), self._shapes)
        self._shapes = taken.shapes
        return taken

    def twin(self) -> Shot:
        return Shot(self.describe, self.size, self.camera, self.update, self.sensor)

    def changes(self, frames: Sequence[int]) -> bool:
        """Whether anything but the camera may change in these frames."""
        return self.update is not None or any(self.describe(frame) != self.describe(frames[0]) for frame in frames)

    def _place_camera(self, sensor: mi.Sensor, frame: int) -> None:
        assert self.camera is not None
        view, params = self.camera.at(frame), mi.traverse(sensor)
        params["to_world"] = type(params["to_world"])(mi.ScalarTransform4f(view.to_world).matrix)
        if view.fov is not None:
            if "x_fov" not in params:
                raise NgptError(f"sensor '{sensor.class_name()}' has no field of view; leave fov out of the path")
            width, height = sensor.film().size()
            params["x_fov"] = horizontal(view.fov, view.fov_axis, float(width) / float(height))
        params.update()


def render_shot(
    shot: Shot,
    request: RenderRequest,
    watch: Watch = Watch(),  # noqa: B008 - it is frozen
    *,
    skip: Callable[[int], bool] = lambda frame: False,
    progress: Callable[[int], Callable[[int, int], None]] = lambda frame: lambda done, total: None,
) -> Iterator[tuple[int, GradientStack]]:
    """Yields (frame, stack) for each frame of a request. A frame is left out if ``skip`` returns True at its turn.

    Stacks have the layer ``motion`` to the previous frame of the request. For the first frame, it is the motion to the
    frame one step earlier, which is not rendered; all NaN if there is no such frame. Motion refers to the whole
    picture; crop windows may show another part of it in each frame. Each frame has its own seed, so its bits do not
    depend on which other frames are rendered. Only the cache of tails has the same ``seed`` in all frames, because its
    smooth noise would flicker if it changed from frame to frame. Errors are as in ``render_stack``; cameras without a
    projection raise NgptError.

    A ``sampler`` of ``data_gen.samplers.FRAME_SAMPLERS`` reuses the previous frames, up to ``warm_up`` of them where
    frames are skipped, and uses ``seed`` for all frames. If more than the camera changes, such a sampler also needs the
    scene of the previous frame. Then two scenes are in memory and take turns.

    With ``dt`` pairs of samples per pixel, 2 or more, stacks have ``dt`` and ``dt_var``, of separate samples
    (``data_gen.frames.time_differences``) by Mitsuba's integrator. If parameters change, scenes are then loaded twice
    per frame. The time to render ``dt`` is included in ``ngpt:seconds``.
    """
    before: Snapshot | None = None
    last = None
    frames, dt, seed = request.frames, request.dt, request.seed
    step = frames[1] - frames[0] if len(frames) > 1 else 1
    remembers = FRAME_SAMPLERS.get(request.sampler)
    remembering, turns = None, [shot]
    if remembers is not None:
        changes = shot.changes(frames)
        remembering = Remembering(remembers, changes, request)
        turns += [shot.twin()] if changes else []
    done = 0
    for i, wanted in enumerate(frames):
        if skip(wanted):
            continue
        # Previous frames that were skipped are rendered again for the sampler's history.
        for j in range(max(done, i - remembers.warm_up if remembers else i), i + 1):
            frame, previous = frames[j], frames[j - 1] if j else frames[0] - step
            shot, other = turns[j % len(turns)], turns[(j - 1) % len(turns)]
            if last != previous:
                before = _before(other, previous, first=j == 0)
            now = shot.snapshot(frame)
            scene = shot.at(frame)
            other_size = before is not None and now.place.data.size != before.place.data.size
            if before is not None and (dt or remembers) and other_size:
                raise NgptError(
                    f"frame {frame} is {now.place.data} and frame {previous} {before.place.data}: --dt and "
                    "samplers that reuse frames need crop windows of one size; only move them"
                )
            # A frame that cannot be rendered, for example for lack of memory, fails before its motion is computed.
            failed: Exception | None = None
            if remembering is not None:
                remembering.begin(scene)
                motion, shift, what = _motion(scene, now, before)
                far = None if what is None else depth(scene, now, what)
                stack = remembering.render(scene, now.shapes, j, motion, far, progress(frame))
            else:
                try:
                    own = replace(request, seed=frame_seed(seed, frame))
                    stack = render(scene, own, replace(watch, progress=progress(frame)), tails_seed=seed)
                except Unfinished as error:
                    stack, failed = error.stack, error
                try:
                    motion, shift, _ = _motion(scene, now, before)
                except Exception as error:  # the frame has all its samples, which are not lost
                    stop_if_interrupted(error)
                    failed, (motion, shift, _) = error, _motion(scene, now, None)
                    stack.attributes[UNFINISHED] = "failed"
            before, last = now, frame
        done = i + 1
        stack.attributes |= {"ngpt:frame": frame, "ngpt:previousFrame": previous} | request.header(frame)
        # In the file, motion is measured in the whole picture.
        stack = stack.replace(motion=motion + np.asarray(shift, np.float32))
        if failed is not None:
            raise Unfinished(f"frame {frame}: {failed}", stack) from failed
        del scene  # two scenes in memory would make kernels larger
        if dt and UNFINISHED in stack.attributes:
            return
        if dt:
            stack = _with_dt(stack, motion, (shot, frame), (other, previous), dt, frame_seed(seed, frame, 1))
        yield frame, stack


def _motion(scene: mi.Scene, now: Snapshot, before: Snapshot | None) -> tuple[np.ndarray, Any, Any]:
    """Motion vectors from array to array, how far the crop window has moved, and what ``seen`` returns.

    Without a frame ``before``, motion is NaN, and the last value is None.
    """
    if before is None:
        width, height = (int(n) for n in scene.sensors()[0].film().crop_size())
        return np.full((height, width, 2), np.nan), (0, 0), None
    what = seen(scene)
    return motion_vectors(scene, now, before, what), window_moved(now, before), what


def _with_dt(
    stack: GradientStack, motion: np.ndarray, here: tuple[Shot, int], before: tuple[Shot, int], pairs: int, seed: int
) -> GradientStack:
    """The stack with ``dt`` and ``dt_var``. ``motion`` is measured between pixels of the two arrays. ``here`` and
    ``before`` are the two frames: the shot that has the scene, and the frame's number."""
    mean = variance = np.full((*motion.shape[:2], 3), np.nan, np.float32)
    if np.isfinite(motion).any():
        scene, begun = here[0].at(here[1]), time.perf_counter()
        now, seconds = light(scene, seed, pairs), time.perf_counter() - begun
        del scene
        scene, begun = before[0].at(before[1]), time.perf_counter()
        mean, variance = difference(now, light(scene, seed, pairs, motion))
        stack.attributes["ngpt:seconds"] += seconds + time.perf_counter() - begun
    stack.attributes["ngpt:pairs"] = pairs
    return stack.replace(dt=mean, dt_var=variance)


def _before(shot: Shot, frame: int, first: bool) -> Snapshot | None:
    try:
        return shot.snapshot(frame)
    except NgptError:
        if not first:
            raise
        return None
