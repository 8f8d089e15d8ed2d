"""Writes weights in 16 bits: files for the repository, with the curve of the training, and files for OIDN."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ngpt.errors import NgptError
from ngpt.network import tza
from ngpt.network.safetensors import in_halves, load_weights, read_tensors, write_tensors
from ngpt.network.training_log import LOG, entries_of

POINTS = 100


def write_halves(files: Sequence[str | Path], path: str | Path, overwrite: bool = False) -> None:
    """Writes weights, or the ``mean`` of several files, to ``path`` in 16 bits.

    Raises NgptError for files that hold no weights, and for numbers that 16 bits cannot hold.
    """
    if len(files) > 1:
        tensors, header = mean(files)
    else:
        tensors, header = read_tensors(files[0])
        kind = header.get("kind")
        if kind not in ("weights", "temporal"):
            raise NgptError(f"{files[0]}: holds a {kind or 'something'}, not weights; pass weights.safetensors")
        log, training = Path(files[0]).with_name(LOG), header.get("training")
        if log.is_file() and isinstance(training, dict) and "step" in training:
            header["curve"] = curve(entries_of(log), training["step"])
    write_tensors(path, in_halves(tensors, ", ".join(map(str, files))), header, overwrite)


def mean(files: Sequence[str | Path]) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """The mean of the weights in several files, and a header; a file that is named twice counts twice.

    The mean of a network before and after tuning forgets less than the tuned network [Wortsman et al. 2022, "Robust
    fine-tuning of zero-shot models"]. The header is that of the first file, with the records of all trainings. Raises
    NgptError if a file holds no network for single images, or another network than the first file.
    """
    models, headers = zip(*map(load_weights, files), strict=True)
    for file, model in zip(files, models, strict=True):
        if model.config != models[0].config:
            raise NgptError(
                f"{file}: its network differs from the one in {files[0]}; give weights with the same [model]"
            )
    states = [model.state_dict() for model in models]
    tensors = {name: torch.stack([state[name].double() for state in states]).mean(0).float() for name in states[0]}
    trainings = [header.get("training") for header in headers]
    own = trainings[0] if isinstance(trainings[0], dict) else {}
    header = {name: value for name, value in headers[0].items() if name != "curve"}
    return tensors, header | {"training": own | {"mean of": trainings}}


def curve(entries: list[dict[str, float]], last: int) -> dict[str, list[Any]]:
    """At most ``POINTS`` losses until step ``last``, each the mean over the steps since the previous one."""
    logged = [(entry["step"], entry["loss"]) for entry in entries if "loss" in entry and entry["step"] <= last]
    parts = [part for part in np.array_split(np.array(logged).reshape(-1, 2), POINTS) if len(part)]
    return {
        "steps": [int(part[-1, 0]) for part in parts],
        "losses": [float(f"{part[:, 1].mean():.4g}") for part in parts],
    }


def oidn_weights(weights: str | Path) -> bytes:
    """The contents of a .tza file with the weights of a file of `ngpt train`.

    Raises NgptError for networks that do not have OIDN's shape, and for numbers that 16 bits cannot hold.
    """
    model, _ = load_weights(weights)
    if model.config.network != "oidn":
        raise NgptError(f"{weights}: network '{model.config.network}' has not OIDN's shape; export it to an .onnx file")
    halves = in_halves(model.network.state_dict(), str(weights))
    return tza.packed({name: tensor.numpy() for name, tensor in halves.items()}, model.config.base or "primal")
