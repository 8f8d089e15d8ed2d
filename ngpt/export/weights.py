"""Weights in 16 bits: as the repository keeps them, with the curve of their training, and as OIDN reads them."""

from pathlib import Path
from typing import Any

import numpy as np

from ngpt.errors import NgptError
from ngpt.network import tza
from ngpt.network.safetensors import in_halves, load_weights, read_tensors, write_tensors
from ngpt.training.run_summary import LOG, entries_of

POINTS = 100


def write_halves(weights: str | Path, path: str | Path, overwrite: bool = False) -> None:
    """Writes weights to ``path`` in 16 bits.

    Raises NgptError for files that hold no weights, and for numbers that 16 bits cannot hold.
    """
    tensors, header = read_tensors(weights)
    kind = header.get("kind")
    if kind not in ("weights", "temporal"):
        raise NgptError(f"{weights}: holds a {kind or 'something'}, not weights; pass weights.safetensors")
    log, training = Path(weights).with_name(LOG), header.get("training")
    if log.is_file() and isinstance(training, dict) and "step" in training:
        header["curve"] = curve(entries_of(log), training["step"])
    write_tensors(path, in_halves(tensors, str(weights)), header, overwrite)


def curve(entries: list[dict[str, float]], last: int) -> dict[str, list[Any]]:
    """Losses until step ``last``, each the mean of those since the one before."""
    logged = [(entry["step"], entry["loss"]) for entry in entries if "loss" in entry and entry["step"] <= last]
    parts = [part for part in np.array_split(np.array(logged).reshape(-1, 2), POINTS) if len(part)]
    return {
        "steps": [int(part[-1, 0]) for part in parts],
        "losses": [float(f"{part[:, 1].mean():.4g}") for part in parts],
    }


def oidn_weights(weights: str | Path) -> bytes:
    """The .tza file of weights as `ngpt train` writes them.

    Raises NgptError for networks of another shape, and for numbers that the 16 bits of OIDN cannot hold.
    """
    model, _ = load_weights(weights)
    if model.config.network != "oidn":
        raise NgptError(f"{weights}: network '{model.config.network}' has not OIDN's shape; export it to an .onnx file")
    halves = in_halves(model.network.state_dict(), str(weights))
    return tza.packed({name: tensor.numpy() for name, tensor in halves.items()}, model.config.base or "primal")
