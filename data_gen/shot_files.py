"""The frames of a shot as files: all frames, missing frames, the part of one machine, or all on a Dask cluster."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import as_completed
from dataclasses import dataclass, field
from inspect import signature
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from data_gen.backend import DEFAULT_VARIANT
from data_gen.begun import Asked, Rest, Unfinished, begun_stack, scene_name
from data_gen.cluster import cluster
from data_gen.frames.pattern import filled
from data_gen.outputs import Denoising, Output
from data_gen.samplers import FRAME_SAMPLERS
from data_gen.session import DEFAULT_SPP, render_frames
from ngpt.errors import NgptError, WrongUse
from ngpt.io.whole import finished
from ngpt.stack import GradientStack
from ngpt.system.files import check_output, make_folder

# On a cluster: the frames that a worker renders with one scene in memory, and with kernels compiled once
FRAMES_OF_A_PART = 8


@dataclass
class Written:
    """``frames``: of each that was written its ``output``, size and attributes; how many were ``skipped`` since their
    files are there; and the first that has not all its samples since it was ``interrupted``, if any."""

    frames: list[dict[str, Any]] = field(default_factory=list)
    skipped: int = 0
    interrupted: int | None = None

    @property
    def done(self) -> int:
        return len(self.frames) + self.skipped


def write_frames(
    scene: str,
    files: Mapping[int, Path],
    *,
    shard: tuple[int, int] = (0, 1),
    overwrite: bool = False,
    skip_existing: bool = False,
    denoising: Denoising | None = None,
    made: Callable[[Written, int], None] = lambda written, total: None,
    stop: Callable[[], bool] = lambda: False,
    **options: Any,
) -> Written:
    """Writes the stack of each frame to its file; ``files`` maps all frames of the shot, in order, to their files.

    With ``denoising`` it writes images instead of stacks, see ``data_gen.outputs``. With ``shard`` (i, n) it writes
    only part i of n. ``made`` is called with what is written so far and the number of frames, before the first sample
    and after each frame. Missing folders are made before the first sample, too. ``options`` are as in
    ``render_frames``. Raises NgptError as ``render_frames`` does, and for files that exist unless ``overwrite`` or
    ``skip_existing`` says what to do with them.
    """
    number, parts = shard
    # Each part is a run of consecutive frames, since a frame needs the scene of the previous one.
    part_of = {frame: i * parts // len(files) for i, frame in enumerate(files)}
    ours = [frame for frame in files if part_of[frame] == number]
    outputs = {frame: Output(files[frame], denoising) for frame in ours}
    for frame, output in outputs.items():
        output.check()
        if skip_existing:
            output.check_skipping()
        _check(files[frame], overwrite or skip_existing)
    written = Written()
    asked = {frame: asked_of(scene, frame, **options) for frame in ours}
    # Begun frames come first, grouped by what is left of them: the scene stays in memory.
    begun = _begun(asked, outputs) if skip_existing else {}
    gone_on = {frame for frames in begun.values() for frame in frames}

    def begins() -> None:
        for folder in dict.fromkeys(files[frame].parent for frame in ours):
            make_folder(folder)
        made(written, len(ours))

    def skip(frame: int) -> bool:
        # Only when its turn has come, for several machines may be at work on one shot.
        if part_of[frame] != number or frame in gone_on:
            return True
        there = skip_existing and finished(files[frame]) and asked[frame].left(files[frame]) is None
        there = there and outputs[frame].done(asked[frame])
        written.skipped += there
        return there

    def add(frame: int, stack: GradientStack) -> None:
        asked[frame].name(stack)
        cut = skip_existing and files[frame].exists() and not finished(files[frame])
        # Another machine may have been faster.
        by: dict[str, Any] = {}
        if not (skip_existing and outputs[frame].done(asked[frame])):
            before = begun_stack(files[frame]) if frame in gone_on else None
            stack, by = outputs[frame].write(stack, overwrite or cut, before)
        said = {"in place of": "a file that was not whole"} if cut else {}
        written.frames.append(report_of(stack, files[frame], by) | said)
        made(written, len(ours))

    progress = _once(begins)

    def write_all(skip: Callable[[int], bool], more: Mapping[str, Any]) -> None:
        how = {**options, **more, "skip": skip, "stop": stop, "progress": progress}
        try:
            for frame, stack in render_frames(scene, list(files), **how):
                add(frame, stack)
        except Unfinished as error:
            frame = error.stack.attributes["ngpt:frame"]
            if not options.get("dt"):
                add(frame, error.stack)
                raise NgptError(f"{error}; {files[frame]} has the samples done before") from error
            raise

    for rest, frames in begun.items():
        others = frozenset(files) - frozenset(frames)
        write_all(others.__contains__, rest.options(options.get("seed", 0)))
    write_all(skip, {})
    if stop():
        done = {report["frame"] for report in written.frames if "unfinished" not in report}
        left = (frame for frame in ours if frame not in done and not asked[frame].done(files[frame]))
        written.interrupted = next(left, None)
    return written


def asked_of(scene: str, frame: int, **arguments: Any) -> Asked:
    """What ``render_frames`` is asked for a frame by these ``arguments``; the defaults are in its signature."""
    bound = signature(render_frames).bind(scene, [frame], **arguments)
    bound.apply_defaults()
    its = SimpleNamespace(**bound.arguments)
    remembers, spp = FRAME_SAMPLERS.get(its.sampler), its.spp
    if spp is None and (its.seconds is None or remembers):
        spp = remembers.spp if remembers else DEFAULT_SPP
    given = {name: filled(text, frame) for name, text in (its.parameters or {}).items()}
    given |= {"--fps": str(its.fps), "--dt": str(its.dt)}
    given |= {} if its.sensor is None else {"--sensor": str(its.sensor)}
    name = scene_name(filled(scene, frame), given, None if its.camera is None else str(its.camera))
    same = ("seed", "sampler", "options", "size", "seconds", "unbiased", "diagnostics", "subpixels")
    known = {field: getattr(its, field) for field in same}
    return Asked(name, spp=spp, frame=frame, variant=its.variant or DEFAULT_VARIANT, **known)


def report_of(stack: GradientStack, file: Path, made: Mapping[str, Any]) -> dict[str, Any]:
    """What ``ngpt render --json`` says of a stack: its file, its size, and the attributes of ours, by short names.

    ``made`` are the attributes of its image, if any.
    """
    attributes = {**stack.attributes, **made}
    ours = {name.removeprefix("ngpt:"): value for name, value in attributes.items() if "ngpt:" in name}
    return {"output": str(file), "width": stack.width, "height": stack.height} | ours


def write_frames_on_cluster(
    address: str,
    scene: str,
    files: Mapping[int, Path],
    *,
    overwrite: bool = False,
    skip_existing: bool = False,
    made: Callable[[Written, int], None] = lambda written, total: None,
    **options: Any,
) -> Written:
    """``write_frames`` in parts, each on a worker of the Dask cluster whose scheduler is at ``address``."""
    if options.pop("shard", None):
        raise WrongUse("--cluster distributes the frames itself; leave --shard out")
    for file in files.values():
        _check(file, overwrite or skip_existing)
    parts = -(-len(files) // FRAMES_OF_A_PART)
    # A part that is tried again, since its worker died, goes on.
    options |= {"overwrite": overwrite, "skip_existing": skip_existing or not overwrite}
    order = list(files)
    whole = Written()
    with cluster(address) as workers:
        made(whole, len(files))
        futures = [workers.submit(write_frames, scene, dict(files), shard=(i, parts), **options) for i in range(parts)]
        for future in as_completed(futures):
            part = future.result()
            whole.frames += part.frames
            whole.skipped += part.skipped
            made(whole, len(files))
    whole.frames.sort(key=lambda report: order.index(report["frame"]))
    return whole


def _begun(asked: Mapping[int, Asked], outputs: Mapping[int, Output]) -> dict[Rest, list[int]]:
    """The frames that were begun, by what is left of them."""
    begun: dict[Rest, list[int]] = {}
    for frame, output in outputs.items():
        if finished(output.file) and (rest := asked[frame].left(output.file)):
            output.check_begun(rest.sampler)
            begun.setdefault(rest, []).append(frame)
    return begun


def _check(file: Path, overwrite: bool) -> None:
    """``check_output``, for a file whose folder need not be there."""
    if file.parent.exists():
        check_output(file, overwrite, may_skip=True)


def _once(begins: Callable[[], None]) -> Callable[[int], Callable[[int, int], None]]:
    """The ``progress`` of frames that calls ``begins`` when the first of them begins."""
    waiting = [begins]

    def progress(done: int, total: int) -> None:
        while waiting:
            waiting.pop()()

    return lambda frame: progress
