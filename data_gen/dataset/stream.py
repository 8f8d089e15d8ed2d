"""Crops while they are rendered: a replay buffer that a training loop reads like a ``Dataset``, with no set on disk.

    with Stream(config, executor) as data:
        for step in ...:
            crop = data[rng.integers(len(data))]

Scenes never run out: scene number n of the stream is the procedural scene number n of the configuration.
"""

from __future__ import annotations

import tempfile
import threading
from collections import deque
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from pathlib import Path

from data_gen.dataset.config import Config, made_name
from data_gen.dataset.crops import make_shard
from ngpt.errors import NgptError
from ngpt.training.dataset import Crop
from ngpt.training.shards import Shard


class Stream:
    """The last ``capacity`` crops, at least one, replaced by new ones as they are finished.

    ``executor`` should have workers of its own (processes, a cluster); ``ahead`` shards are rendered at a time. A crop
    in hand stays readable after its shard has left the buffer. Entering waits for the first crops; what goes wrong in a
    worker is raised as NgptError there and by every later access.
    """

    def __init__(
        self, config: Config, executor: Executor, capacity: int = 1000, ahead: int = 2, variant: str = "llvm_ad_rgb"
    ):
        self.config, self.executor, self.capacity, self.ahead, self.variant = config, executor, capacity, ahead, variant
        self._crops: deque[Crop] = deque(maxlen=capacity)
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

    def __getitem__(self, index: int) -> Crop:
        self._check()
        with self._changed:
            return self._crops[index]

    def __iter__(self) -> Iterator[Crop]:
        with self._changed:
            return iter(list(self._crops))

    @property
    def scenes(self) -> tuple[str, ...]:
        """Names of the scenes that are in the buffer now."""
        return tuple(dict.fromkeys(crop.scene for crop in self))

    def _check(self) -> None:
        if self._error:
            raise NgptError(f"the stream of crops has stopped: {self._error}") from self._error

    def _feed(self) -> None:
        number, running = 0, set()
        try:
            while not self._stop.is_set():
                while len(running) < self.ahead:
                    for job in self.config.scene_jobs(made_name(number), self.config.crops):
                        running.add(
                            self.executor.submit(make_shard, self.config, job, self._temporary.name, self.variant)
                        )
                    number += 1
                done, running = wait(running, timeout=0.5, return_when=FIRST_COMPLETED)
                for future in done:
                    self._take(future)
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
        told = shard.record["crops"]
        with self._changed:
            self._crops.extend(
                Crop(shard, i, shard.record["scene"], tuple(crop["spp"]), crop.get("frame"))
                for i, crop in enumerate(told)
            )
            self._changed.notify_all()
        # Kept open, it lives on for as long as one of its crops does.
        path.unlink()
