"""Writes the numbers of a run to TensorBoard, in addition to ``log.jsonl``; and measures its speed and memory."""

import sys
import time
from pathlib import Path
from typing import Any

import torch


def tensorboard(out: Path, step: int) -> Any:
    """The writer of the folder ``tensorboard`` in ``out``; earlier entries from ``step`` on are dropped.

    None if TensorBoard is not installed.
    """
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        return None
    return SummaryWriter(str(out / "tensorboard"), purge_step=step)


class Meter:
    """Measures steps per second since the last reading, and the largest memory so far in MiB, of the GPU if used."""

    def __init__(self, step: int, device: torch.device):
        self._step, self._time, self._device = step, time.monotonic(), device

    def read(self, step: int) -> dict[str, float]:
        now = time.monotonic()
        rate = (step - self._step) / max(now - self._time, 1e-9)
        self._step, self._time = step, now
        return {"steps/s": round(rate, 4), "memory MiB": float(_memory(self._device) >> 20)}


def _memory(device: torch.device) -> int:
    """The largest memory so far in bytes; 0 on Windows, which does not tell it."""
    if device.type == "cuda":
        return int(torch.cuda.max_memory_allocated(device))
    try:
        import resource
    except ImportError:
        return 0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
