"""The interface between a task and the trainer (``ngpt.training.trainer``)."""

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
        """A new network with random weights."""

    @abstractmethod
    def batches(self, model: nn.Module, step: int, processes: Processes) -> Iterator[dict[str, Tensor]]:
        """Yields the endless batches of this process, from ``step`` on. ``model`` is the network in training.

        A batch depends only on the settings, the number of its step, and the ``state``.
        """

    @abstractmethod
    def loss(
        self, model: nn.Module, batch: dict[str, Tensor], generator: torch.Generator
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss of a batch, and its parts by name. All random numbers are from ``generator``."""

    @abstractmethod
    def validate(self, model: nn.Module, picture: Path) -> dict[str, float]:
        """Scores on the validation data: "relMSE" of the results (lower is better), "relMSE primal" of the inputs, ...

        Writes a picture of some results to the file ``picture``. Returns {} without validation data.
        """

    @abstractmethod
    def save(self, path: Path, model: nn.Module, provenance: dict[str, Any]) -> None:
        """Writes weights for inference, over an existing file."""

    @abstractmethod
    def load(self, path: str) -> nn.Module:
        """The network in a file that ``save`` wrote, or the shipped network of that name.

        Raises NgptError for a network of another kind.
        """

    def state(self) -> dict[str, Tensor]:
        """The tensors, for the checkpoint, on which the next batches depend in addition to settings and step."""
        return {}

    def restore(self, state: dict[str, Tensor], path: str) -> None:
        """Restores the ``state`` in the checkpoint ``path``. Raises NgptError if it does not fit."""
        if state:
            raise NgptError(f"{path}: is of a run of another kind; give the run another folder")
