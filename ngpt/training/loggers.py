"""Where the numbers of a run go beside ``log.jsonl``, and how fast and with how much memory it runs.

A logger has ``log(step, values)``. TensorBoard is used if it is installed, Weights & Biases if it is asked for. Only
Weights & Biases sends data to anyone.
"""

import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Protocol

import torch

from ngpt.errors import NgptError
from ngpt.system.install import package_command
from ngpt.system.records import read_json
from ngpt.training.run_page import RECORD
from ngpt.training.settings import Settings, published


class Logger(Protocol):
    def log(self, step: int, values: dict[str, float]) -> None: ...


class TensorBoard:
    """Files in the folder ``tensorboard`` of the run; what was written for ``step`` and later is dropped."""

    def __init__(self, out: Path, step: int):
        from torch.utils.tensorboard import SummaryWriter

        self._writer = SummaryWriter(str(out / "tensorboard"), purge_step=step)

    def log(self, step: int, values: dict[str, float]) -> None:
        for name, value in values.items():
            self._writer.add_scalar(name, value, step)


class WeightsAndBiases:
    """A run of the project ``settings.run.wandb``: numbers and settings, no code, no pictures, no weights.

    A run that goes on keeps its id. Its steps are a number among the others, for W&B drops what comes with an earlier
    step of its own than the last: all that follows a kill. Raises NgptError where wandb is not installed or cannot
    begin, for want of a key or a network.
    """

    def __init__(self, out: Path, settings: Settings):
        try:
            import wandb
        except ModuleNotFoundError as error:
            raise NgptError(
                f"run.wandb = '{settings.run.wandb}': wandb is not installed; leave it out, or "
                f"`{package_command('wandb')}`"
            ) from error
        record = read_json(out / RECORD) if (out / RECORD).is_file() else {}
        try:
            self._run = wandb.init(
                project=settings.run.wandb,
                name=out.absolute().name,
                id=record.get("id"),
                resume="allow",
                dir=str(out),
                config=published(settings),
                settings=wandb.Settings(disable_git=True, disable_code=True, console="off"),
            )
        except Exception as error:  # its own, and whatever its network raises
            raise NgptError(
                f"run.wandb = '{settings.run.wandb}': {' '.join(str(error).split())[:200]}; `wandb login`, set "
                "WANDB_MODE=offline, or leave it out"
            ) from error
        self._run.define_metric("*", step_metric="step")

    def log(self, step: int, values: dict[str, float]) -> None:
        self._run.log({"step": step, **values})


def loggers(out: Path, step: int, settings: Settings) -> list[Logger]:
    """The loggers of a run in the folder ``out`` that begins with ``step``."""
    found: list[Logger] = []
    with suppress(ImportError):  # not installed
        found.append(TensorBoard(out, step))
    return [*found, WeightsAndBiases(out, settings)] if settings.run.wandb else found


class Meter:
    """Steps a second since it was read last, and the most memory so far in MiB: the GPU's where there is one."""

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
