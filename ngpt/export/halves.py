"""Weights as the repository keeps them: in 16 bits, with the curve of their training in the header."""

from pathlib import Path
from typing import Any

import numpy as np

from ngpt.errors import NgptError
from ngpt.network.safetensors import in_halves, read_tensors, write_tensors
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
