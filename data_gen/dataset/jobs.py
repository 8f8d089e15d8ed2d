"""Makes a training set with any executor. Each job writes one shard, so a killed worker loses at most one."""

from __future__ import annotations

import json
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Self

from data_gen.dataset.config import DatasetConfig, Job, as_json
from data_gen.dataset.crops import make_shard
from ngpt.errors import NgptError
from ngpt.system.files import exclusive
from ngpt.system.interrupts import Interrupt, noted
from ngpt.system.workers import end_with_parent
from ngpt.system.writing import write_json
from ngpt.training.dataset import FORMAT, MANIFEST, VERSION, checksum, read_manifest
from ngpt.training.shards import Shard


class Serial(Executor):
    """Runs each call at once, in this process."""

    def submit(self, fn, /, *args, **kwargs) -> Future:
        future: Future = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


class Pool(ProcessPoolExecutor):
    """``count`` worker processes that end with this process, however it ends.

    ``interruptible``: in a ``with`` block, Ctrl-C and SIGTERM end the workers at once: waiting for their current crops
    would take minutes, and these crops are made again later. Otherwise the caller decides when to ``end`` them.
    """

    def __init__(self, count: int, interruptible: bool = True):
        # Spawned, since LLVM does not survive a fork.
        super().__init__(count, mp_context=get_context("spawn"), initializer=end_with_parent, initargs=(interruptible,))
        # If a signal handler raised an exception, it could leave a lock of the executor held, and the executor's thread
        # would wait for it for ever. So the handler only ends the workers. The signal is raised again at the end of the
        # block.
        self._signals, self._interrupt = ExitStack(), Interrupt()
        self._interruptible = interruptible

    def __enter__(self) -> Self:
        if self._interruptible:
            self._interrupt = self._signals.enter_context(noted(self.end))
        return super().__enter__()

    def submit(self, fn, /, *args, **kwargs) -> Future:
        future = super().submit(fn, *args, **kwargs)
        if self._interrupt():
            self.end()  # the signal may have come before the workers were started
        return future

    def end(self) -> None:
        for process in tuple((self._processes or {}).values()):
            process.terminate()

    def __exit__(self, *error) -> None:
        with self._signals:
            super().__exit__(*error)
        if self._interrupt():
            signal.raise_signal(self._interrupt.signal)


def processes(count: int) -> Executor:
    return Serial() if count == 1 else Pool(count)


def generate(
    config: DatasetConfig,
    folder: Path,
    executor: Executor,
    *,
    shard: tuple[int, int] = (0, 1),
    variant: str = "llvm_ad_rgb",
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> None:
    """Makes the missing shards in ``folder``, for jobs i, i + n, i + 2n, ... where ``shard`` is (i, n).

    ``executor`` is any executor of concurrent.futures. The same configuration gives the same bits with each of them, in
    any order of jobs. ``progress`` gets the number of crops done and of all crops of this part. Raises NgptError if a
    file cannot be written or a worker dies. Finished shards are kept, and the same call continues from there.
    """
    plan = config.plan()
    start(config, folder, config.frames * sum(len(job.crops) for job in plan))
    part = plan[shard[0] :: shard[1]]
    todo = [job for job in part if not (folder / job.file).exists()]
    total = sum(len(job.crops) for job in part)
    done = total - sum(len(job.crops) for job in todo)
    progress(done, total)
    try:
        for job in finished(executor, partial(make_shard, config, folder=str(folder.resolve()), variant=variant), todo):
            update_manifest(folder)
            done += len(job.crops)
            progress(done, total)
    except BrokenProcessPool as error:
        why = "a worker process died (out of memory?); run the same command to continue"
        raise NgptError(f"{folder}: {why}") from error
    finally:
        update_manifest(folder)


def finished(executor: Executor, make: Callable[[Job], str], jobs: list[Job], ahead: int = 64) -> Iterator[Job]:
    """Yields jobs as they finish. At most ``ahead`` are submitted at a time. An error cancels the others."""
    waiting = iter(jobs)
    running: dict[Any, Job] = {}
    try:
        while True:
            limit = 1 if isinstance(executor, Serial) else ahead
            while len(running) < limit and (job := next(waiting, None)) is not None:
                running[executor.submit(make, job)] = job
            if not running:
                return
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                future.result()
                yield running.pop(future)
    finally:
        for future in running:
            future.cancel()


def start(config: DatasetConfig, folder: Path, planned: int) -> None:
    """Prepares ``folder`` for the training set of this configuration. Raises NgptError if it belongs to another one."""
    (folder / "shards").mkdir(parents=True, exist_ok=True)
    with exclusive(folder, wait=True):
        if not (folder / MANIFEST).exists():
            empty = {"format": FORMAT, "version": VERSION, "config": as_json(config), "planned": planned, "shards": []}
            write_json(folder / MANIFEST, empty)
        # An entry that did not exist when the set was begun has its default.
        theirs = as_json(DatasetConfig(scenes=1)) | read_manifest(folder)["config"]
    ours = json.loads(json.dumps(as_json(config)))
    different = [key for key in ours if theirs.get(key) != ours[key]]
    if different:
        raise NgptError(
            f"{folder}: holds a training set of another configuration ({', '.join(different)} differ); use a new one"
        )


def update_manifest(folder: Path) -> None:
    """Lists the shards on disk in the manifest. The folder is locked, since other machines may do the same."""
    with exclusive(folder, wait=True):
        manifest = read_manifest(folder)
        known = {entry["file"]: entry for entry in manifest["shards"]}
        entries = []
        for path in sorted((folder / "shards").glob("[!.]*.safetensors")):
            name = path.relative_to(folder).as_posix()
            if name not in known:
                entry = {"file": name, "sha256": checksum(path), "bytes": path.stat().st_size}
                known[name] = entry | Shard(path).record
            entries.append(known[name])
        if entries != manifest["shards"]:
            write_json(folder / MANIFEST, manifest | {"shards": entries})
