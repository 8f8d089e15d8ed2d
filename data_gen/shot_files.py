"""Writes the frames of a shot to files: all frames, missing frames, one machine's part, or all on a Dask cluster."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import as_completed
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from data_gen.begun import Unfinished, begun_stack
from data_gen.cluster import cluster
from data_gen.outputs import Denoising, Output
from data_gen.request import RenderRequest, asked
from data_gen.session import render_frames
from ngpt.errors import NgptError
from ngpt.io.whole import finished
from ngpt.stack import GradientStack
from ngpt.system.files import check_output, make_folder

# On a cluster: the frames that a worker renders with one scene in memory, and with kernels compiled once
FRAMES_OF_A_PART = 8


@dataclass
class Written:
    """The frames of a shot that are done.

    ``frames``       a report for each frame that was written, see ``report_of``
    ``skipped``      the number of frames whose files already existed
    ``interrupted``  the first frame that lacks samples because the render was interrupted, if there is one
    """

    frames: list[dict[str, Any]] = field(default_factory=list)
    skipped: int = 0
    interrupted: int | None = None

    @property
    def done(self) -> int:
        return len(self.frames) + self.skipped


def write_frames(
    scene: str | RenderRequest,
    files: Mapping[int, Path],
    *,
    shard: tuple[int, int] = (0, 1),
    overwrite: bool = False,
    skip_existing: bool = False,
    denoising: Denoising | None = None,
    made: Callable[[Written, int], None] = lambda written, total: None,
    stop: Callable[[], bool] = lambda: False,
    **given: Any,
) -> Written:
    """Writes the stack of each frame to its file; ``files`` maps all frames of the shot, in order, to their files.

    With ``denoising`` it writes images instead of stacks, see ``data_gen.outputs``. With ``shard`` (i, n) it writes
    only part i of n. ``made`` is called with what is written so far and the number of frames, before the first sample
    and after each frame. Missing folders are made before the first sample, too. All else is as in ``render_frames``.
    Raises NgptError as ``render_frames`` does, and for files that exist unless ``overwrite`` or ``skip_existing`` says
    what to do with them.
    """
    request, _ = asked(scene, given, files)
    number, parts = shard
    # Each part is a run of consecutive frames, since a frame needs the scene of the previous one.
    part_of = {frame: i * parts // len(files) for i, frame in enumerate(files)}
    ours = [frame for frame in files if part_of[frame] == number]
    outputs = {frame: Output(request, files[frame], denoising, frame=frame) for frame in ours}
    for frame, output in outputs.items():
        output.check(skip_existing)
        _check(files[frame], overwrite or skip_existing)
    written = Written()
    # Unfinished frames come first, grouped by the request that finishes them, so that the scene stays in memory.
    begun = _begun(outputs) if skip_existing else []
    gone_on = {frame for _, frames in begun for frame in frames}

    @cache
    def begins() -> None:
        for folder in {files[frame].parent for frame in ours}:
            make_folder(folder)
        made(written, len(ours))

    def skip(frame: int) -> bool:
        # The file is checked only when the frame's turn has come, since another machine may have written it by then.
        if part_of[frame] != number or frame in gone_on:
            return True
        there = skip_existing and outputs[frame].left() is None and outputs[frame].done()
        written.skipped += there
        return there

    def add(frame: int, stack: GradientStack) -> None:
        cut = skip_existing and files[frame].exists() and not finished(files[frame])
        # Another machine may have finished the frame in the meantime.
        by: dict[str, Any] = {}
        if not (skip_existing and outputs[frame].done()):
            before = begun_stack(files[frame]) if frame in gone_on else None
            stack, by = outputs[frame].write(stack, overwrite or cut, before)
        said = {"in place of": "a file that was not whole"} if cut else {}
        written.frames.append(report_of(stack, files[frame], by) | said)
        made(written, len(ours))

    def progress(frame: int) -> Callable[[int, int], None]:
        return lambda done, total: begins()

    def write_all(part: RenderRequest, skip: Callable[[int], bool]) -> None:
        try:
            for frame, stack in render_frames(part, skip=skip, stop=stop, progress=progress):
                add(frame, stack)
        except Unfinished as error:
            frame = error.stack.attributes["ngpt:frame"]
            if not request.dt:
                add(frame, error.stack)
                raise NgptError(f"{error}; {files[frame]} has the samples done before") from error
            raise

    for rest, frames in begun:
        others = frozenset(files) - frozenset(frames)
        write_all(rest, others.__contains__)
    write_all(request, skip)
    if stop():
        done = {report["frame"] for report in written.frames if "unfinished" not in report}
        left = (frame for frame in ours if frame not in done and not outputs[frame].done())
        written.interrupted = next(left, None)
    return written


def report_of(stack: GradientStack, file: Path, made: Mapping[str, Any]) -> dict[str, Any]:
    """The report of ``ngpt render --json`` on a stack: its file, its size, and its attributes "ngpt:NAME" as NAME.

    ``made`` are the attributes of its image, if there is one.
    """
    attributes = {**stack.attributes, **made}
    ours = {name.removeprefix("ngpt:"): value for name, value in attributes.items() if "ngpt:" in name}
    return {"output": str(file), "width": stack.width, "height": stack.height} | ours


def write_frames_on_cluster(
    address: str,
    scene: str | RenderRequest,
    files: Mapping[int, Path],
    *,
    overwrite: bool = False,
    skip_existing: bool = False,
    denoising: Denoising | None = None,
    made: Callable[[Written, int], None] = lambda written, total: None,
    **given: Any,
) -> Written:
    """``write_frames`` in parts, each on a worker of the Dask cluster whose scheduler is at ``address``."""
    request, _ = asked(scene, given, files)
    for file in files.values():
        _check(file, overwrite or skip_existing)
    parts = -(-len(files) // FRAMES_OF_A_PART)
    # A part whose worker died is tried again, and continues from the files that exist.
    how: Any = {"overwrite": overwrite, "skip_existing": skip_existing or not overwrite, "denoising": denoising}
    order = list(files)
    whole = Written()
    with cluster(address) as workers:
        made(whole, len(files))
        futures = [workers.submit(write_frames, request, dict(files), shard=(i, parts), **how) for i in range(parts)]
        for future in as_completed(futures):
            part = future.result()
            whole.frames += part.frames
            whole.skipped += part.skipped
            made(whole, len(files))
    whole.frames.sort(key=lambda report: order.index(report["frame"]))
    return whole


def _begun(outputs: Mapping[int, Output]) -> list[tuple[RenderRequest, list[int]]]:
    """The requests that finish the unfinished frames, each with the numbers of its frames."""
    begun: list[tuple[RenderRequest, list[int]]] = []
    for frame, output in outputs.items():
        if (rest := output.left()) is not None and rest is not output.request:
            frames = next((frames for other, frames in begun if other == rest), None)
            if frames is None:
                begun.append((rest, frames := []))
            frames.append(frame)
    return begun


def _check(file: Path, overwrite: bool) -> None:
    """Calls ``check_output`` if the folder of the file exists."""
    if file.parent.exists():
        check_output(file, overwrite, may_skip=True)
