"""The interface of a task, for the trainer (``ngpt.training.trainer``), which makes steps, logs, checkpoints and
pages."""

from abc import ABC, abstractmethod
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from ngpt.errors import NgptError
from ngpt.training.distributed import Processes


class Task(ABC):
    """A network, its examples, its loss, and its validation."""

    @abstractmethod
    def network(self) -> nn.Module:
        """A new network, of random weights."""

    @abstractmethod
    def batches(self, model: nn.Module, step: int, processes: Processes) -> Iterator[dict[str, Tensor]]:
        """The endless batches of this process from ``step`` on; ``model`` is the network in training.

        A batch is a function of the settings, the number of its step, and the ``state``.
        """

    @abstractmethod
    def loss(
        self, model: nn.Module, batch: dict[str, Tensor], generator: torch.Generator
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss of a batch, and its parts by name. Everything random in it is drawn from ``generator``."""

    @abstractmethod
    def validate(self, model: nn.Module, picture: Path) -> dict[str, float]:
        """Scores on the validation data: "relMSE" of the results (lower is better), "relMSE primal" of the inputs, ...

        Some results are drawn into the file ``picture``. {} if there are no validation data.
        """

    @abstractmethod
    def save(self, path: Path, model: nn.Module, provenance: dict[str, Any]) -> None:
        """Writes weights for inference; replaces an existing file."""

    @abstractmethod
    def load(self, path: str) -> nn.Module:
        """The network in a file written by ``save``, or the shipped network of that name. Raises NgptError for a
        network of another kind."""

    def state(self) -> dict[str, Tensor]:
        """The tensors for the checkpoint that the next batches depend on, in addition to the settings and the step."""
        return {}

    def restore(self, state: dict[str, Tensor], path: str) -> None:
        """Restores the ``state`` from the checkpoint ``path``; raises NgptError if it does not fit."""
        if state:
            raise NgptError(f"{path}: is of a run of another kind; give the run another folder")
