"""A network of OIDN's shape as a file that OIDN's runtime reads."""

from pathlib import Path

from ngpt.errors import NgptError
from ngpt.network import tza
from ngpt.network.safetensors import in_halves, load_weights


def oidn_weights(weights: str | Path) -> bytes:
    """The .tza file of weights as `ngpt train` writes them.

    Raises NgptError for networks of another shape, and for numbers that the 16 bits of OIDN cannot hold.
    """
    model, _ = load_weights(weights)
    if model.config.network != "oidn":
        raise NgptError(f"{weights}: network '{model.config.network}' has not OIDN's shape; export it to an .onnx file")
    halves = in_halves(model.network.state_dict(), str(weights))
    return tza.packed({name: tensor.numpy() for name, tensor in halves.items()}, model.config.base or "primal")
