"""Renders crops during training: a replay buffer that a training loop reads like a ``Dataset``, with no set on disk.

    with Stream(config, executor) as data:
        for step in ...:
            crop = data[rng.integers(len(data))]
After the scenes of the configuration follow more scenes of the same kind, and more views of scene files. With a folder
``kept``, references are made once, stored there in compressed form, and used repeatedly with new inputs.
"""

from __future__ import annotations

import tempfile
import threading
from collections import deque
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from contextlib import contextmanager
from itertools import count
from pathlib import Path

import numpy as np

from data_gen.dataset.config import DatasetConfig, Job, read_config
from data_gen.dataset.crops import make_shard
from data_gen.dataset.jobs import Pool
from data_gen.dataset.kept import Again, home, keep
from ngpt.errors import NgptError
from ngpt.training.dataset import ShardCrop
from ngpt.training.shards import Shard


class Stream:
    """The last ``capacity`` crops, at least one. New crops replace them as they finish.

    ``executor`` should have separate workers (processes, a cluster). ``ahead`` shards are rendered at a time. A crop
    stays readable after its shard has left the buffer. Entering the context waits for the first crops. An error in a
    worker is raised as NgptError on entering, and by every later access. ``kept`` is a folder for references. Raises
    NgptError for ``kept`` with shots or with pairs, whose references cannot be kept.
    """

    def __init__(
        self,
        config: DatasetConfig,
        executor: Executor,
        capacity: int = 1000,
        ahead: int = 2,
        variant: str = "llvm_ad_rgb",
        kept: str | Path = "",
    ):
        self.config, self.executor, self.capacity, self.ahead, self.variant = config, executor, capacity, ahead, variant
        if kept and config.frames > 1:
            raise NgptError("references of shots cannot be kept without their inputs; leave data.kept out")
        if kept and config.pairs:
            raise NgptError(
                "pairs (reference_spp = 0) have no references to keep; leave data.kept out, or make the pairs before "
                "the training: ngpt dataset"
            )
        self.kept = home(config, Path(kept)) if kept else None
        self._crops: deque[ShardCrop] = deque(maxlen=capacity)
        self._error: BaseException | None = None
        self._changed = threading.Condition()
        self._stop = threading.Event()

    def __enter__(self) -> Stream:
        self._temporary = tempfile.TemporaryDirectory(prefix="ngpt-stream-")
        (Path(self._temporary.name) / "shards").mkdir()
        self._thread = threading.Thread(target=self._feed, daemon=True)
        self._thread.start()
        with self._changed:
            self._changed.wait_for(lambda: self._crops or self._error)
        if self._error:
            self.__exit__()
            self._check()
        return self

    def __exit__(self, *_) -> None:
        self._stop.set()
        self._thread.join()
        self._temporary.cleanup()

    def __len__(self) -> int:
        return len(self._crops)

    def __getitem__(self, index: int) -> ShardCrop:
        self._check()
        with self._changed:
            return self._crops[index]

    def __iter__(self) -> Iterator[ShardCrop]:
        with self._changed:
            return iter(list(self._crops))

    @property
    def scenes(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(crop.scene for crop in self))

    def _check(self) -> None:
        if self._error:
            raise NgptError(f"the stream of crops has stopped: {self._error}") from self._error

    def _jobs(self) -> Iterator[tuple[Job, Again | None]]:
        """Yields jobs without end; each turn has all scenes. With kept references, the order differs in each run."""
        rng = np.random.default_rng()
        for turn in count():
            plan = self.config.plan(0 if self.kept else turn)
            for i in rng.permutation(len(plan)) if self.kept else range(len(plan)):
                path = self.kept / plan[i].file if self.kept else None
                there = path is not None and path.exists()
                yield plan[i], Again(str(path), int(rng.integers(2**62))) if there else None

    def _feed(self) -> None:
        jobs = self._jobs()
        running: dict[Future, str] = {}
        ahead = min(self.ahead, len(self.config.plan())) if self.kept else self.ahead
        try:
            while not self._stop.is_set():
                while len(running) < ahead:
                    job, again = next(jobs)
                    # Two running jobs with the same file name would write the same file, so the second is left out.
                    if job.file not in running.values():
                        given = (self.config, job, self._temporary.name, self.variant, again)
                        running[self.executor.submit(make_shard, *given)] = job.file
                for future in wait(running, timeout=0.5, return_when=FIRST_COMPLETED).done:
                    self._take(future)
                    del running[future]
        except BaseException as error:
            with self._changed:
                self._error = error
                self._changed.notify_all()
        finally:
            for future in running:
                future.cancel()
            wait(running)

    def _take(self, future: Future) -> None:
        path = Path(self._temporary.name) / future.result()
        shard = Shard(path, keep_open=True)
        if self.kept and shard.names and not (kept := self.kept / future.result()).exists():
            keep(shard, kept)
        facts, crops = shard.record, enumerate(shard.record["crops"])
        with self._changed:
            self._crops.extend(ShardCrop(shard, i, facts["scene"], tuple(c["spp"]), c.get("frame")) for i, c in crops)
            self._changed.notify_all()
        # The shard stays open, so its data can be read until its last crop is gone.
        path.unlink()


@contextmanager
def stream(config: Path, kept: str = "") -> Iterator[Stream]:
    """A context with crops of a configuration, rendered in another process during training: see
    ``ngpt.renderer.Crops``."""
    # Interrupted training finishes its step, and may still need crops.
    with Pool(1, interruptible=False) as worker, Stream(read_config(config), worker, kept=kept) as data:
        try:
            yield data
        finally:
            # The current job would take minutes, and its result is not needed.
            worker.end()
