"""The training loop, which can be stopped at any moment and resumed bit for bit.

A step depends only on the settings, the seed, its number, and the state in the checkpoint: weights, their average,
Adam's moments, and the state of the task. So a run that was killed and resumed ends with the same weights as an
uninterrupted run, on the same device with the same number of threads and processes.
"""

import copy
import json
import math
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ngpt.errors import NgptError
from ngpt.network import safetensors
from ngpt.network.device import in_bfloat16
from ngpt.network.model import parameters
from ngpt.network.training_log import LOG
from ngpt.system import files
from ngpt.system.console import print_line
from ngpt.system.records import check
from ngpt.system.writing import write_text
from ngpt.training.distributed import Processes
from ngpt.training.loggers import Meter, tensorboard
from ngpt.training.run_page import write_run
from ngpt.training.run_summary import CHECKPOINT, WEIGHTS
from ngpt.training.schedule import learning_rate, update_average, warmup_of
from ngpt.training.settings import Settings, changed, from_dict, published
from ngpt.training.task import Task
from ngpt.version import __version__


def show(text: str) -> None:
    """Prints a line at once, so that a log can be followed."""
    print_line(text, sys.stdout)


class Trainer:
    """One run in the folder ``out``, new or continued.

    ``task`` has the network, examples and loss. Files in ``out``: ``checkpoint.safetensors``, ``weights.safetensors``
    (for inference), ``best.safetensors`` (the weights with the least validation error), ``log.jsonl``, ``run.html``,
    ``tensorboard/``, ``validation-STEP.png``.
    """

    def __init__(
        self,
        settings: Settings,
        task: Task,
        out: str | Path,
        processes: Processes | None = None,
        say: Callable[[str], None] = show,
    ):
        self.settings, self.task, self.out, self.say = settings, task, Path(out), say
        self.processes = processes or Processes()
        self.device = self.processes.device
        torch.manual_seed(settings.run.seed)
        self.model = task.network().to(self.device)
        if settings.initial:
            self.model.load_state_dict(task.load(settings.initial).state_dict())
        self.average = copy.deepcopy(self.model) if settings.optimizer.ema else self.model
        self.optimizer = torch.optim.Adam(self.model.parameters(), betas=settings.optimizer.betas, eps=1e-8)
        self.step, self.seconds = 0, 0.0
        if settings.run.batch % self.processes.count:
            raise NgptError(
                f"run.batch = {settings.run.batch}: must be a multiple of the {self.processes.count} processes"
            )
        steps, warmup = settings.run.steps, warmup_of(settings.optimizer, settings.run.steps)
        if warmup < settings.optimizer.warmup:
            say(f"the run's {steps} steps would end within its warm-up of {settings.optimizer.warmup}: taking {warmup}")
        if settings.run.precision == "bfloat16" and not in_bfloat16(self.device.type, settings.run.precision):
            say("run.precision: this processor has no instructions for bfloat16: computing in float32, which is faster")
        self._stop = False
        # The least validation error so far.
        self.best = math.inf
        self._tensorboard: Any = None
        # The number of the signal that has stopped the run, if any.
        self.signal: int | None = None

    @property
    def checkpoint(self) -> Path:
        return self.out / CHECKPOINT

    def resume(self) -> None:
        """Continues from the checkpoint in ``out``, and says which settings have changed.

        Raises NgptError if the checkpoint is of another model.
        """
        tensors, header = safetensors.read_tensors(self.checkpoint)
        if header.get("kind") != "checkpoint":
            raise NgptError(f"{self.checkpoint}: holds {header.get('kind')}, not a checkpoint")
        check(header, {"settings": dict, "step": int, "seconds": (int, float)}, f"{self.checkpoint}: its header")
        # Settings of earlier versions
        header["settings"].get("run", {}).pop("wandb", None)
        header["settings"].get("augmentation", {}).pop("rarer", None)
        before = from_dict(header["settings"], str(self.checkpoint))
        if before.model != self.settings.model:
            raise NgptError(f"{self.checkpoint}: was trained with another [model]; give the run another folder")
        parts: dict[str, dict[str, Tensor]] = {"model": {}, "adam1": {}, "adam2": {}}
        for name, tensor in tensors.items():
            part, _, rest = name.partition("/")
            parts.setdefault(part, {})[rest] = tensor
        safetensors.fill(self.model, parts["model"], str(self.checkpoint))
        if self.average is not self.model:
            safetensors.fill(self.average, parts.get("average", parts["model"]), str(self.checkpoint))
        for moment in ("adam1", "adam2"):
            safetensors.check_fit(dict(self.model.named_parameters()), parts[moment], str(self.checkpoint))
        self.step, self.seconds = header["step"], header["seconds"]
        for name, p in self.model.named_parameters():
            first, second = (parts[moment][name].to(self.device) for moment in ("adam1", "adam2"))
            step = torch.tensor(float(self.step))
            self.optimizer.state[p] = {"step": step, "exp_avg": first, "exp_avg_sq": second}
        if "task" in parts:
            self.task.restore(parts["task"], str(self.checkpoint))
        for change in changed(before, self.settings):
            self.say(f"changed since the checkpoint: {change}")
        # Entries after the checkpoint are dropped, because they will be logged again.
        log = _keep_lines(self.out / LOG, self.step)
        self.best = min((entry["relMSE"] for entry in log if "relMSE" in entry), default=math.inf)

    def run(self, progress: Callable[[int, int], None] = lambda done, total: None) -> bool:
        """Trains until the last step, the end of the time budget, or a signal; True if the last step was reached.

        ``progress`` is called with (steps done, all steps) before the first step and after each. If the loss or its
        gradient is not finite, the batch is saved and NgptError is raised.
        """
        run, start, before = self.settings.run, time.monotonic(), self.seconds
        batches = self.task.batches(self.model, self.step, self.processes)
        meter = Meter(self.step, self.device)
        if self.processes.rank == 0:
            self._tensorboard = tensorboard(self.out, self.step + 1)
        previous = {s: signal.signal(s, self._interrupt) for s in (signal.SIGINT, signal.SIGTERM)}
        progress(self.step, run.steps)
        try:
            while self.step < run.steps and not self._stop:
                entry = self._train(next(batches))
                self.step += 1
                self.seconds = before + time.monotonic() - start
                progress(self.step, run.steps)
                last = self.step == run.steps
                if self.step % run.log == 0 or last:
                    with self._saved():
                        self._log(entry | {"seconds": round(self.seconds, 1)} | meter.read(self.step))
                if self.step % run.validate == 0 or last:
                    with self._saved():
                        self.validate()
                if self.step % run.save == 0 and not last:
                    self.save()
                out_of_time = run.minutes and time.monotonic() - start > 60 * run.minutes
                self._stop = self.processes.any(self._stop or bool(out_of_time))
        finally:
            for s, handler in previous.items():
                signal.signal(s, handler)
        self.save()
        return self.step >= run.steps

    @contextmanager
    def _saved(self) -> Iterator[None]:
        """Saves a checkpoint if the block fails (as on a full disk), so that no steps are lost."""
        try:
            yield
        except (NgptError, OSError):
            self.save()
            raise

    def save(self) -> None:
        """Writes checkpoint and weights. If this is interrupted, the previous files remain complete.

        If the checkpoint cannot be written to its place, it is written elsewhere, and NgptError says where.
        """
        if self.processes.rank:
            return
        tensors = {f"model/{name}": t for name, t in self.model.state_dict().items()}
        if self.average is not self.model:
            tensors |= {f"average/{name}": t for name, t in self.average.state_dict().items()}
        tensors |= {f"task/{name}": t for name, t in self.task.state().items()}
        for name, p in self.model.named_parameters():
            state = self.optimizer.state.get(p) or {"exp_avg": torch.zeros_like(p), "exp_avg_sq": torch.zeros_like(p)}
            tensors |= {f"adam1/{name}": state["exp_avg"], f"adam2/{name}": state["exp_avg_sq"]}
        header = {"kind": "checkpoint", "step": self.step, "seconds": self.seconds, "version": __version__}
        header["settings"] = self.settings.to_dict()
        files.save(
            self.checkpoint, lambda path, over: safetensors.write_tensors(path, tensors, header, over), overwrite=True
        )
        self._save_weights(WEIGHTS)
        write_run(self.out)

    def _save_weights(self, name: str) -> None:
        """Writes the averaged weights for inference, with the facts of their training."""
        provenance = {
            "step": self.step,
            "hours": round(self.seconds / 3600, 3),
            "device": str(self.device),
            "parameters": parameters(self.model),
            "version": __version__,
            "torch": torch.__version__,
            "settings": published(self.settings),
        }
        self.task.save(self.out / name, self.average, provenance)

    def validate(self) -> None:
        """Logs validation scores of the averaged weights, writes a picture, and keeps the best weights."""
        if self.processes.rank == 0:
            scores = self.task.validate(self.average, self.out / f"validation-{self.step:07d}.png")
            if scores:
                self._log(scores)
                if scores["relMSE"] < self.best:
                    self.best = scores["relMSE"]
                    self._save_weights("best.safetensors")
                write_run(self.out)
        self.model.train()

    def _train(self, batch: dict[str, Tensor]) -> dict[str, float]:
        self.model.train()
        run, settings = self.settings.run, self.settings.optimizer
        batch = {name: layer.to(self.device, non_blocking=True) for name, layer in batch.items()}
        generator = torch.Generator(self.device)
        generator.manual_seed(_seed(run.seed, self.step * self.processes.count + self.processes.rank))
        total, parts = self.task.loss(self.model, batch, generator)
        self.optimizer.zero_grad(set_to_none=True)
        total.backward()
        self.processes.average_gradients(self.model)
        norm = torch.nn.utils.clip_grad_norm_(self.model.parameters(), settings.clip or math.inf)
        if not torch.isfinite(total) or not torch.isfinite(norm):
            self._give_up(batch, float(total.detach()), float(norm))
        rate = learning_rate(settings, self.step, run.steps)
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        self.optimizer.step()
        if self.average is not self.model:
            update_average(self.average, self.model, settings.ema, self.step)
        values = {"loss": float(total.detach()), "gradient norm": float(norm), "learning rate": rate}
        return values | {f"loss {name}": float(part.detach()) for name, part in parts.items()}

    def _give_up(self, batch: dict[str, Tensor], total: float, norm: float) -> None:
        path = self.out / f"bad-batch-{self.step:07d}.safetensors"
        safetensors.write_tensors(path, batch, {"kind": "batch", "step": self.step}, overwrite=True)
        raise NgptError(
            f"step {self.step}: the loss is {total:.3g} and its gradient's norm {norm:.3g}; the batch is in {path}, "
            f"the weights before it in {self.checkpoint}; lower the learning rate, set optimizer.clip, or use float32"
        )

    def _interrupt(self, number: int = signal.SIGINT, *_: Any) -> None:
        self.say("stopping after this step; run the same command again to continue")
        self._stop, self.signal = True, int(number)

    def _log(self, values: dict[str, float]) -> None:
        if self.processes.rank:
            return
        # NaN is not JSON; missing values are left out.
        values = {"step": self.step} | {k: v for k, v in values.items() if not math.isnan(v)}
        path = self.out / LOG
        try:
            with open(path, "a", encoding="utf-8") as file:
                file.write(json.dumps(values) + "\n")
        except OSError as error:
            raise NgptError(
                f"{path}: cannot be written: {error.strerror}; the same command continues from here"
            ) from error
        self.say("  ".join(f"{k} {v:.4g}" if isinstance(v, float) else f"{k} {v}" for k, v in values.items()))
        for name, value in values.items() if self._tensorboard else ():
            if name != "step":
                self._tensorboard.add_scalar(name, value, self.step)


def _seed(seed: int, step: int) -> int:
    return int(np.random.SeedSequence((seed, step)).generate_state(1, np.uint64)[0] >> 1)


def _keep_lines(path: Path, step: int) -> list[dict[str, float]]:
    """Removes the entries after ``step``, and an incomplete last line, from a log; returns the other entries."""
    if not path.is_file():
        return []
    entries = []
    for line in path.read_text(encoding="utf-8").splitlines():
        try:
            if (entry := json.loads(line))["step"] <= step:
                entries.append(entry)
        except ValueError:
            continue
    write_text(path, "".join(f"{json.dumps(entry)}\n" for entry in entries))
    return entries
