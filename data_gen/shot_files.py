"""The frames of a shot as files: all, those that are missing, the part of one machine, or by all of a Dask cluster."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import as_completed
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from data_gen.session import render_frames
from ngpt.errors import WrongUse
from ngpt.io.exr import write
from ngpt.io.whole import finished
from ngpt.stack import GradientStack
from ngpt.system.files import check_output

# Of a cluster: frames that a worker renders with one scene in memory, and kernels compiled once.
FRAMES_OF_A_PART = 8


@dataclass
class Written:
    """``frames``: of each that was written its ``output``, size and attributes; how many were ``skipped`` since their
    files are there; and the one that was ``interrupted``, if any."""

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
    made: Callable[[Written, int], None] = lambda written, total: None,
    stop: Callable[[], bool] = lambda: False,
    **options: Any,
) -> Written:
    """Writes the stack of each frame to its file, ``files``: frame -> file, all of the shot in order.

    Only those of the part i of n where ``shard`` is (i, n). ``made`` is called with what is written so far and the
    number of frames, at first and after each. ``options`` are those of ``render_frames``. Raises NgptError as that
    does, and for files that exist unless one of ``overwrite`` and ``skip_existing`` says what to do with them.
    """
    number, parts = shard
    # Of frames side by side, each needs the scene of the one before.
    part_of = {frame: i * parts // len(files) for i, frame in enumerate(files)}
    ours = [frame for frame in files if part_of[frame] == number]
    for frame in ours:
        check_output(files[frame], overwrite or skip_existing, may_skip=True)
    written = Written()

    def skip(frame: int) -> bool:
        # Only when its turn has come, for several machines may be at work on one shot.
        if part_of[frame] != number:
            return True
        there = skip_existing and finished(files[frame])
        written.skipped += there
        return there

    stacks = render_frames(scene, list(files), skip=skip, stop=stop, **options)
    made(written, len(ours))
    for frame, stack in stacks:
        # Another machine may have been faster.
        there = skip_existing and finished(files[frame])
        cut = skip_existing and not there and files[frame].exists()
        if not there:
            write(files[frame], stack, overwrite=overwrite or cut)
        more = {"in place of": "a file that was not whole"} if cut else {}
        written.frames.append(report_of(stack, files[frame]) | more)
        made(written, len(ours))
    if stop() and written.done < len(ours):
        written.interrupted = ours[written.done]
    return written


def report_of(stack: GradientStack, file: Path) -> dict[str, Any]:
    """What ``ngpt render --json`` says of a stack: its file, its size, and the attributes of ours, by short names."""
    ours = {name.removeprefix("ngpt:"): value for name, value in stack.attributes.items() if "ngpt:" in name}
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
        raise WrongUse("--cluster shares the frames out by itself; leave --shard out")
    for file in files.values():
        check_output(file, overwrite or skip_existing, may_skip=True)
    from data_gen.dataset.jobs import cluster

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
