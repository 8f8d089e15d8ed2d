"""The network that blends frames (``ngpt.sequence.network``) in PyTorch, and the file of its weights."""

from pathlib import Path
from typing import Any

from ngpt.errors import NgptError
from ngpt.network import safetensors
from ngpt.network.unet import PlainUNet
from ngpt.sequence.network import BANDS, INPUTS

# The value of "kind" in the header of such a file
KIND = "temporal"
WIDTHS = (16, 24, 32)


def load(path: str | Path) -> tuple[PlainUNet, dict[str, Any]]:
    """The network of a file that a training run wrote, and the file's header. Raises NgptError for other files."""
    tensors, header = safetensors.read_tensors(path)
    if header.get("kind") != KIND or header.get("inputs") != list(INPUTS) or header.get("widths") != list(WIDTHS):
        raise NgptError(f"{path}: holds no network that blends frames, or one of another version; train it anew")
    model = network()
    safetensors.fill(model, tensors, str(path))
    return model.eval(), header


def network() -> PlainUNet:
    """An untrained network, whose corrections are 0."""
    return PlainUNet(len(INPUTS), WIDTHS, BANDS, zero=True)
