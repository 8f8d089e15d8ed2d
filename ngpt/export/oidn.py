"""A network of OIDN's shape as a file that OIDN's runtime reads."""

from pathlib import Path

import torch

from ngpt.errors import NgptError
from ngpt.network import tza
from ngpt.network.weights import load_weights


def oidn_weights(weights: str | Path) -> bytes:
    """The .tza file of weights as `ngpt train` writes them.

    Raises NgptError for networks of another shape, and for numbers beyond the 16 bits that OIDN takes.
    """
    model, _ = load_weights(weights)
    if model.config.network != "oidn":
        raise NgptError(f"{weights}: network '{model.config.network}' has not OIDN's shape; export it to an .onnx file")
    halves = {name: tensor.half() for name, tensor in model.network.state_dict().items()}
    if lost := [name for name, tensor in halves.items() if not torch.isfinite(tensor).all()]:
        raise NgptError(f"{weights}: tensor '{lost[0]}' holds numbers beyond 65504, which OIDN's 16 bits cannot")
    return tza.packed({name: tensor.numpy() for name, tensor in halves.items()}, model.config.base or "primal")
