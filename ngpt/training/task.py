"""What a run trains; the trainer (``ngpt.training.trainer``) does the rest: steps, logs, checkpoints, stops, pages."""

from abc import ABC, abstractmethod
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from ngpt.errors import NgptError
from ngpt.training.distributed import Processes


class Task(ABC):
    """A network, its examples, its loss, and how good it is on what was set aside."""

    @abstractmethod
    def network(self) -> nn.Module:
        """A new network, of random weights."""

    @abstractmethod
    def batches(self, model: nn.Module, step: int, processes: Processes) -> Iterator[dict[str, Tensor]]:
        """The batches of this process from ``step`` on, without end; ``model`` is the network that is trained by them.

        A batch is a function of the settings, the number of its step, and the ``state``.
        """

    @abstractmethod
    def loss(
        self, model: nn.Module, batch: dict[str, Tensor], generator: torch.Generator
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss of a batch, and its parts by name. Everything random in it is drawn from ``generator``."""

    @abstractmethod
    def validate(self, model: nn.Module, picture: Path) -> dict[str, float]:
        """Scores on what was set aside: "relMSE" (the least is the best), of what goes in ("relMSE primal"), ...

        Some results are drawn into the file ``picture``. {} where nothing was set aside.
        """

    @abstractmethod
    def save(self, path: Path, model: nn.Module, provenance: dict[str, Any]) -> None:
        """Writes weights for inference, in place of a file that is there."""

    @abstractmethod
    def load(self, path: str) -> nn.Module:
        """The network of such a file, or of one that comes with ngpt by its name; raises NgptError for another one."""

    def state(self) -> dict[str, Tensor]:
        """What the next batches depend on beside the settings and the step: it goes into the checkpoint."""
        return {}

    def restore(self, state: dict[str, Tensor], path: str) -> None:
        """Takes the ``state`` of the checkpoint ``path``; raises NgptError where it does not fit."""
        if state:
            raise NgptError(f"{path}: is of a run of another kind; give the run another folder")
