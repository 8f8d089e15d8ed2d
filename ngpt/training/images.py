"""The task that trains networks which reconstruct images (``ngpt.network``), on single crops."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader

from ngpt.errors import NgptError
from ngpt.network import padding, safetensors
from ngpt.network.device import body_precision
from ngpt.network.model import Reconstructor
from ngpt.network.transfer import signed_exp
from ngpt.system import limits
from ngpt.training.distributed import Processes
from ngpt.training.examples import JITTER, OTHER, Examples, collated
from ngpt.training.settings import Settings
from ngpt.training.task import Task
from ngpt.training.validation import validate, views

Loss = Callable[..., tuple[Tensor, dict[str, Tensor]]]

# The largest logarithm that is passed to exp. Its radiance, 4.9e8, is far above useful targets.
LIMIT = 20.0


class Images(Task):
    """Trains on ``crops``, and validates on ``held_out``.

    ``loss`` takes scene-linear prediction and target (N, 3, H, W), and a generator of the step's random numbers. If a
    batch has pairs (examples without a reference), ``loss`` also takes the layers of their other halves. The target
    then covers only the examples with a reference, and is None if there are none. If crops are rendered during
    training, as in a stream, runs cannot be repeated exactly.
    """

    def __init__(self, settings: Settings, crops: Sequence[Any], held_out: Sequence[Any], loss: Loss):
        if settings.model is None:
            raise NgptError("a network that makes images needs the table [model]")
        if not len(crops):
            raise NgptError("no crops to train on: data.folders is empty, or data.validation holds out every scene")
        self.settings, self.config, self._loss = settings, settings.model, loss
        self.held_out = views(held_out, settings.run.views)
        data = settings.data
        self.examples = Examples(
            crops, self.config, settings.augmentation, data.crop, settings.run.seed, data.cache << 20, data.pairs
        )

    def network(self) -> nn.Module:
        made, crop = Reconstructor(self.config), self.settings.data.crop
        if (crop + 2 * padding.MARGIN) % made.alignment:
            raise NgptError(
                f"data.crop = {crop}: crop + {2 * padding.MARGIN} must be divisible by {made.alignment}, the network's "
                "coarsest pixel"
            )
        return made

    def batches(self, model: nn.Module, step: int, processes: Processes) -> Iterator[dict[str, Tensor]]:
        run = self.settings.run
        size, first = run.batch // processes.count, step * run.batch
        indices = (
            [first + i * run.batch + processes.rank * size + j for j in range(size)] for i in range(run.steps - step)
        )
        workers = min(self.settings.data.workers, limits.processors())
        try:
            yield from DataLoader(
                self.examples,
                batch_sampler=indices,  # type: ignore[arg-type]
                collate_fn=collated,
                num_workers=workers,
                persistent_workers=bool(workers),
                pin_memory=processes.device.type == "cuda",
            )
        except NgptError as error:
            # The message of an error in a worker begins with the traceback of the worker.
            raise NgptError(str(error).rpartition("NgptError: ")[2]) from None

    def loss(
        self, model: nn.Module, batch: dict[str, Tensor], generator: torch.Generator
    ) -> tuple[Tensor, dict[str, Tensor]]:
        layers = dict(batch)
        target = layers.pop("target", None)
        other = {name.removeprefix(OTHER): layers.pop(name) for name in batch if name.startswith(OTHER)}
        with body_precision(generator.device.type, self.settings.run.precision):
            logarithm = model.predict(layers)  # type: ignore[operator]
        edge = padding.MARGIN + JITTER
        prediction = signed_exp(logarithm[..., edge:-edge, edge:-edge].clamp(-LIMIT, LIMIT))
        return self._loss(prediction, target, generator, *([other] if other else []))

    def validate(self, model: nn.Module, picture: Path) -> dict[str, float]:
        if not self.held_out:
            return {}
        return validate(model, self.held_out, picture, self.settings.run.precision)  # type: ignore[arg-type]

    def save(self, path: Path, model: nn.Module, provenance: dict[str, Any]) -> None:
        safetensors.save_weights(path, model, provenance, overwrite=True)  # type: ignore[arg-type]

    def load(self, path: str) -> nn.Module:
        model, _ = safetensors.load_weights(path)
        if model.config != self.config:
            raise NgptError(f"{path}: its network differs from [model] of the run: {model.config}")
        return model
