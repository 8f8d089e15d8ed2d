"""The task that trains the network that blends frames (``ngpt.sequence.network``), on shots (frame sequences).

The history of a frame is the blend of the frames before it. The network makes these histories itself. A round is a
number of training steps. At its beginning, the current network blends the shots. Until its end, the network learns from
the resulting histories [Ross et al. 2011, "A reduction of imitation learning and structured prediction to no-regret
online learning"]. The results to blend come from several reconstruction methods, so that the network works with any
method. The loss of a frame is

    E |y - r|² / E_x + FLICKER E |(y - r) - W (y' - r')|² / F_x

where x is the frame before blending, y the blended frame and r the reference. W looks up values along the motion, and a
prime marks the previous frame. E is a mean of errors relative to r. E_x and F_x are the same two means with x in place
of y; dividing by them gives all frames similar weight. A further term is the squared mean, over a batch, of the
relative difference in brightness between y and x. Without this term, the easiest way to remove specks would be to
remove their light. The effect of y on later frames is neglected: among filters that know their own variance, the one
with the least error now is also the best for later frames.
"""

import copy
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from ngpt.errors import NgptError
from ngpt.measure.images import middle
from ngpt.network import safetensors
from ngpt.network.device import body_precision
from ngpt.sequence.network import BANDS, INPUTS, LARGEST, MOST, Corrections
from ngpt.sequence.weights import KIND, WIDTHS, load, network
from ngpt.training.clips import Clip, blended, errors, play, relit, robust
from ngpt.training.distributed import Processes
from ngpt.training.settings import Settings
from ngpt.training.task import Task
from ngpt.training.validation import Pictures, spread

FLICKER = 1.0
ENERGY = 300.0
LEAST = 3e-4
# The simulated number of frames that were blended before the first frame of a shot; one of these is drawn for each
# clip. Without simulated histories, histories would be short, because shots for training are short.
LENGTHS = (1, 1, 4, 12)
# The share of clips to which a change of light is added, because light changes little in the shots.
RELIT = 0.4


class Blending(Task):
    """Trains on the frames of ``clips``, and validates on ``held_out``.

    All random numbers depend only on the seed and the number of the round or step. A batch also depends on the weights
    that made the histories of its round. These weights are the ``state`` of the task.
    """

    def __init__(self, settings: Settings, clips: Sequence[Clip], held_out: Sequence[Clip]):
        if settings.temporal is None:
            raise NgptError("a network that blends frames needs the table [temporal]")
        if not clips:
            raise NgptError("no shots to train on: data.folders is empty, or data.validation holds out every scene")
        sizes = sorted({reference.shape[:2] for clip in clips for reference in clip.references})
        alignment = network().alignment
        if len(sizes) > 1 or sizes[0][0] != sizes[0][1] or sizes[0][0] % alignment:
            found = ", ".join(f"{width}x{height}" for height, width in sizes)
            raise NgptError(
                f"data.folders: the shots have {found} pixels; a batch needs squares of one size, a multiple of "
                f"{alignment}: make sets with the same `size`"
            )
        self.settings, self.clips, self.table = settings, clips, settings.temporal
        self.held_out = spread(held_out, settings.run.views)
        self._player: dict[str, Tensor] = {}
        # Scores of ``held_out``, (2, clips, 2): without blending, and blended by rules without a network. They never
        # change.
        self._fixed: np.ndarray | None = None

    def network(self) -> nn.Module:
        return network()

    def state(self) -> dict[str, Tensor]:
        return self._player

    def restore(self, state: dict[str, Tensor], path: str) -> None:
        safetensors.check_fit(network().state_dict(), state, path)
        self._player = state

    def batches(self, model: nn.Module, step: int, processes: Processes) -> Iterator[dict[str, Tensor]]:
        size = self.settings.run.batch // processes.count
        mine = slice(processes.rank * size, (processes.rank + 1) * size)
        frames: list[dict[str, np.ndarray]] = []
        while True:
            number, place = divmod(step, self.table.round)
            if place == 0:
                self._player = copy.deepcopy(model.state_dict())
            if place == 0 or not frames:
                frames = self._played(model, number)
            rng = np.random.default_rng((self.settings.run.seed, 1, step))
            picked = rng.integers(len(frames), size=self.settings.run.batch)[mine]
            # The arrays contain no motion vectors, so they may be mirrored as they are.
            turns = rng.integers(2, size=(self.settings.run.batch, 3)).astype(bool)[mine]
            chosen = [(frames[i], turn) for i, turn in zip(picked, turns, strict=True)]
            batch = {name: [turned(frame[name], *turn) for frame, turn in chosen] for name in frames[0]}
            yield {name: torch.from_numpy(np.stack(layers)) for name, layers in batch.items()}
            step += 1

    def _played(self, model: nn.Module, number: int) -> list[dict[str, np.ndarray]]:
        """The frames of a round, with histories made by the network at its beginning."""
        rng = np.random.default_rng((self.settings.run.seed, 0, number))
        player = copy.deepcopy(model)
        player.load_state_dict(self._player)
        corrections = as_corrections(player.eval())
        chosen = rng.choice(len(self.clips), min(self.table.clips, len(self.clips)), replace=False)
        longs = 1 / np.sqrt(rng.choice(LENGTHS, len(chosen)))
        played = [relit(self.clips[i], rng) if rng.random() < RELIT else self.clips[i] for i in chosen]
        frames = [f for c, long in zip(played, longs, strict=True) for f in play(c, corrections, float(long))]
        if not frames:
            raise NgptError("no frame of these shots has a history to blend: they lack the layer 'motion'")
        return frames

    def loss(
        self, model: nn.Module, batch: dict[str, Tensor], generator: torch.Generator
    ) -> tuple[Tensor, dict[str, Tensor]]:
        device = batch["inputs"].device.type
        with body_precision(device, self.settings.run.precision):
            corrections = model(batch["inputs"])
        return loss(corrections.float(), batch)

    def validate(self, model: nn.Module, picture: Path) -> dict[str, float]:
        """Errors and flicker relative to the reference, without its noise: geometric means over the clips.

        "primal" stands for results without blending, and "base" for results that are blended by rules without a
        network.
        """
        if not self.held_out:
            return {}
        if self._fixed is None:
            alone = [errors(clip, clip.results) for clip in self.held_out]
            rules = [errors(clip, blended(clip, None)) for clip in self.held_out]
            self._fixed = np.array([alone, rules])
        corrections, pictures, found = as_corrections(model.eval()), Pictures(len(self.held_out)), []
        for index, clip in enumerate(self.held_out):
            results, last = blended(clip, corrections), clip.stacks[-1]
            found.append(errors(clip, results))
            if index in pictures.shown:
                images = [image - last["direct"] for image in (clip.results[-1], results[-1])]
                relative = self._fixed[0, index, 0], found[-1][0]
                images.append(middle(clip.halves[-1]))
                pictures.add(images, clip.scene, int(last.number("ngpt:spp") or 0), *relative)
        pictures.write(picture)
        every = np.stack([found, *self._fixed])
        # Estimates of very small errors may be below 0, because the noise of the reference is subtracted.
        good = (np.isfinite(every) & (every > 0)).all(axis=(0, 2))
        if not good.any():
            return {}
        means = np.exp(np.log(every[:, good]).mean(axis=1))
        return {
            f"{name}{of}": float(means[i, j])
            for i, of in enumerate(("", " primal", " base"))
            for j, name in enumerate(("relMSE", "flicker"))
        }

    def save(self, path: Path, model: nn.Module, provenance: dict[str, Any]) -> None:
        header = {"kind": KIND, "inputs": list(INPUTS), "widths": list(WIDTHS), "training": provenance}
        safetensors.write_tensors(path, model.state_dict(), header, overwrite=True)

    def load(self, path: str) -> nn.Module:
        return load(path)[0]


def loss(corrections: Tensor, batch: Mapping[str, Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
    """The loss of frames (N, C, H, W) from ``play``, and its parts; about 1 + FLICKER if blending improves nothing."""
    shares = MOST * torch.sigmoid(batch["prior"] + LARGEST * torch.tanh(corrections / LARGEST))
    shares = batch["trust"] * torch.minimum(shares, batch["first"])
    bands = batch["bands"].unflatten(1, (BANDS, 3))
    taken = (shares[:, :, None] * bands).sum(1)
    error = batch["alone"] + taken
    errors = robust(error.square() * batch["weight"]).mean((1, 2, 3))
    changes = (batch["seen"] * robust((error - batch["before"]).square() * batch["weight"])).mean((1, 2, 3))
    of_x, of_changes = batch["errors"].flatten(), batch["changes"].flatten()
    # Clamped, so that neither real changes of light nor dark frames dominate.
    darker = (taken.mean((1, 2, 3)) / (batch["level"].flatten() + 1e-20)).clamp(-0.05, 0.05).mean()
    # LEAST keeps frames without noise, from which nothing can be learnt, from dominating.
    parts = {"error": (errors / (of_x + LEAST)).mean(), "flicker": (changes / (of_changes + LEAST)).mean()}
    parts["light"] = darker.square()
    return parts["error"] + FLICKER * parts["flicker"] + ENERGY * parts["light"], parts


def as_corrections(model: Any) -> Corrections:
    """A network in PyTorch as ``Corrections`` for ``ngpt.sequence.history.Temporal``."""

    @torch.inference_mode()
    def corrections(inputs: np.ndarray) -> np.ndarray:
        height, width = inputs.shape[:2]
        a, device = model.alignment, next(model.parameters()).device
        padded = np.pad(inputs, [(0, -height % a), (0, -width % a), (0, 0)], mode="edge")
        made = model(torch.from_numpy(np.moveaxis(padded, -1, 0)[None].copy()).to(device))[0]
        return np.moveaxis(made.cpu().numpy(), 0, -1)[:height, :width]

    return corrections


def turned(layer: np.ndarray, across: bool, down: bool, transposed: bool) -> np.ndarray:
    """A layer (C, H, W), mirrored left to right, top to bottom and at the diagonal, as asked."""
    layer = layer[:, ::-1] if down else layer
    layer = layer[..., ::-1] if across else layer
    return np.ascontiguousarray(layer.transpose(0, 2, 1) if transposed else layer)
