"""Reads and writes weights as safetensors files, with the configuration in the header. Nothing is ever unpickled."""

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from ngpt.errors import NgptError
from ngpt.network.config import ModelConfig
from ngpt.network.model import Reconstructor
from ngpt.system.records import parse_json
from ngpt.system.writing import write_bytes

# The folders of shipped weights for PyTorch: the first in an installed package, the second in the repository.
_PACKAGE = Path(__file__).parents[1]
FOLDERS = (_PACKAGE / "weights", _PACKAGE.parent / "export" / "weights")
FORMAT = 1
_TYPES = (torch.float16, torch.bfloat16, torch.float32, torch.float64)


def write_tensors(
    path: str | Path, tensors: dict[str, Tensor], header: dict[str, Any], overwrite: bool = False
) -> None:
    """Writes tensors and ``header`` (anything that JSON can hold) to one file, completely or not at all."""
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    # ``save_file`` would make a temporary file of its own, which a killed process would leave behind.
    write_bytes(path, save(tensors, metadata={"ngpt": json.dumps({"format": FORMAT} | header)}), overwrite)


def shipped() -> dict[str, Path]:
    """The files of the networks that come with ngpt, by name: "ngpt-fast", ..."""
    return {path.stem: path for folder in reversed(FOLDERS) for path in sorted(folder.glob("*.safetensors"))}


def read_tensors(path: str | Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """The tensors and the header of a file that ``write_tensors`` wrote; ``path`` may be a name of ``shipped``.

    Raises NgptError for other files.
    """
    if not os.path.isfile(path):
        names = shipped()
        if str(path) not in names:
            directory = "is a directory; name a file in it, or one of"
            lack = directory if os.path.isdir(path) else "no such file; networks that come with ngpt"
            raise NgptError(f"{path}: {lack}: {', '.join(names)}")
        path = names[str(path)]
    try:
        with safe_open(str(path), framework="pt") as file:
            header = parse_json((file.metadata() or {}).get("ngpt", "null"), f"{path}: its header")
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
    except (SafetensorError, OSError, ValueError, TypeError, KeyError) as error:
        raise (
            error if isinstance(error, NgptError) else NgptError(f"{path}: not a readable safetensors file: {error}")
        ) from error
    if not isinstance(header, dict) or "format" not in header:
        raise NgptError(f"{path}: holds no configuration of ngpt in its header; it was written by something else")
    if header["format"] != FORMAT:
        raise NgptError(f"{path}: is of format {header['format']}, this version reads {FORMAT}; update ngpt-recon")
    return tensors, header


def save_weights(path: str | Path, model: Reconstructor, provenance: dict[str, Any], overwrite: bool = False) -> None:
    """Writes a model, for ``load_weights``. ``provenance`` is the record of its training."""
    header = {"kind": "weights", "model": model.config.to_dict(), "training": provenance}
    write_tensors(path, model.state_dict(), header, overwrite)


def load_weights(path: str | Path) -> tuple[Reconstructor, dict[str, Any]]:
    """The model, ready for inference, and the header of its file; ``path`` may be a name of ``shipped``.

    Raises NgptError if the file holds no weights of ngpt, or if tensors are missing, superfluous, of another shape, or
    not finite.
    """
    tensors, header = read_tensors(path)
    if header.get("kind") != "weights":
        raise NgptError(f"{path}: holds a {header.get('kind', 'something')}, not weights; pass weights.safetensors")
    try:
        fields = dict(header["model"])
        # Earlier versions had two more fields, which shipped files still have, with empty values.
        fields = {name: value for name, value in fields.items() if value or name not in ("optional", "emission")}
        config = ModelConfig(**fields)
    except (TypeError, KeyError, ValueError) as error:
        raise NgptError(f"{path}: its configuration cannot be read: {error}") from error
    # A header may ask for huge tensors, so shapes are checked before memory is allocated.
    with torch.device("meta"):
        check_fit(Reconstructor(config).state_dict(), tensors, str(path))
    model = Reconstructor(config)
    fill(model, tensors, str(path))
    return model.eval(), header


def fill(module: torch.nn.Module, tensors: dict[str, Tensor], path: str) -> None:
    """Sets all parameters of a module; ``path`` is for messages. Raises NgptError as ``check_fit`` does."""
    check_fit(module.state_dict(), tensors, path)
    module.load_state_dict(tensors)


def check_fit(own: Mapping[str, Tensor], tensors: Mapping[str, Tensor], path: str) -> None:
    """Raises NgptError unless ``tensors`` have the names and shapes of ``own``, and are finite floats."""
    missing, extra = own.keys() - tensors.keys(), tensors.keys() - own.keys()
    if missing or extra:
        what = "lacks" if missing else "has an unexpected"
        name = sorted(missing or extra)[0]
        raise NgptError(f"{path}: {what} tensor '{name}' ({len(missing)} missing, {len(extra)} too many)")
    for name, tensor in tensors.items():
        if tensor.shape != own[name].shape:
            raise NgptError(f"{path}: tensor '{name}' is {list(tensor.shape)}, the model's is {list(own[name].shape)}")
        if tensor.dtype not in _TYPES:
            raise NgptError(
                f"{path}: tensor '{name}' is of type {tensor.dtype}; it must be of floats, of 16 to 64 bits"
            )
        if not torch.isfinite(tensor).all():
            raise NgptError(f"{path}: tensor '{name}' holds values that are not finite; the file is damaged")


def in_halves(tensors: Mapping[str, Tensor], path: str) -> dict[str, Tensor]:
    """The tensors in 16 bits; ``path`` is for messages.

    Raises NgptError for numbers beyond 65504. Also raises it if all weights of an output are so small that 16 bits
    change them by more than rounding: such weights may matter, because their scale may be a separate parameter. Small
    biases do not matter, and are accepted.
    """
    halves = {name: tensor.half() for name, tensor in tensors.items()}
    for name, tensor in tensors.items():
        if not torch.isfinite(halves[name]).all():
            raise NgptError(f"{path}: tensor '{name}' holds numbers beyond 65504, which 16 bits cannot")
        if tensor.ndim > 1:
            change = (halves[name].float() - tensor.float()).flatten(1).norm(dim=1)
            if (change > 2**-10 * tensor.float().flatten(1).norm(dim=1)).any():
                raise NgptError(f"{path}: tensor '{name}' holds weights too small for 16 bits")
    return halves
