"""Layers as raw files, which programs in any language can read, for hosts of networks and their tests.

A folder holds NAME.f32 for each layer: float32, little-endian, (1, C, H, W) in C order. ``layers.json`` lists their
shapes and SHA-256 sums.
"""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ngpt.errors import NgptError
from ngpt.stack import GradientStack
from ngpt.system.files import check_output, make_folder
from ngpt.system.writing import write_bytes, write_text

LISTING = "layers.json"


def write_layers(folder: Path, layers: Mapping[str, np.ndarray], overwrite: bool = False) -> None:
    """Writes layers (1, C, H, W) into a folder, which is made if it does not exist. The listing is written last.

    Raises NgptError if the folder cannot be made, or if a file exists and ``overwrite`` is False.
    """
    if folder.exists() and not folder.is_dir():
        raise NgptError(f"{folder}: is a file; give a folder for the layers")
    make_folder(folder)
    for name in (*(f"{layer}.f32" for layer in layers), LISTING):
        check_output(folder / name, overwrite)
    listing = {}
    for name, layer in layers.items():
        data = np.ascontiguousarray(layer, "<f4").tobytes()
        write_bytes(folder / f"{name}.f32", data, overwrite)
        listing[name] = {"shape": list(layer.shape), "sha256": hashlib.sha256(data).hexdigest()}
    write_text(folder / LISTING, json.dumps(listing, indent=1) + "\n", overwrite)


def planes(stack: GradientStack) -> dict[str, np.ndarray]:
    """The layers of a stack, (1, C, H, W), by their names in the contract."""
    return {name: np.moveaxis(stack[name], -1, 0)[None] for name in stack.names}
