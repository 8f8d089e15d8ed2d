"""Loggers for the numbers of a run, in addition to ``log.jsonl``; and a meter of its speed and memory.

A logger has ``log(step, values)``. TensorBoard is used if it is installed.
"""

import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Protocol

import torch


class Logger(Protocol):
    def log(self, step: int, values: dict[str, float]) -> None: ...


class TensorBoard:
    """Writes to the folder ``tensorboard`` of the run. Earlier entries for ``step`` and later are dropped."""

    def __init__(self, out: Path, step: int):
        from torch.utils.tensorboard import SummaryWriter

        self._writer = SummaryWriter(str(out / "tensorboard"), purge_step=step)

    def log(self, step: int, values: dict[str, float]) -> None:
        for name, value in values.items():
            self._writer.add_scalar(name, value, step)


def loggers(out: Path, step: int) -> list[Logger]:
    """The loggers of a run in the folder ``out`` that begins with ``step``."""
    with suppress(ImportError):  # not installed
        return [TensorBoard(out, step)]
    return []


class Meter:
    """Steps per second since the last reading, and the largest memory so far in MiB: the GPU's if there is one."""

    def __init__(self, step: int, device: torch.device):
        self._step, self._time, self._device = step, time.monotonic(), device

    def read(self, step: int) -> dict[str, float]:
        now = time.monotonic()
        rate = (step - self._step) / max(now - self._time, 1e-9)
        self._step, self._time = step, now
        return {"steps/s": round(rate, 4), "memory MiB": float(_memory(self._device) >> 20)}


def _memory(device: torch.device) -> int:
    if device.type == "cuda":
        return int(torch.cuda.max_memory_allocated(device))
    try:
        import resource
    except ImportError:  # Windows
        return 0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
