"""Runs networks of .safetensors files in PyTorch, in tiles."""

import os
from functools import lru_cache
from itertools import product
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ngpt.errors import NgptError
from ngpt.network import features, inputs, padding, tiles
from ngpt.network.config import ModelConfig
from ngpt.network.device import default_device
from ngpt.network.model import Reconstructor
from ngpt.network.safetensors import load_weights
from ngpt.network.transfer import signed_exp
from ngpt.repair import Repaired
from ngpt.system.forks import in_children

# The side of a tile in padded pixels. Larger images are cut into tiles, so that memory does not grow with the image.
TILE = 640


def config_of(path: str | Path, device: str = "auto") -> ModelConfig:
    """The configuration in a file of weights. The loaded model is cached for ``run``."""
    return _loaded(path, device).config


def run(data: Repaired, path: str | Path, device: str = "auto", tile: int = TILE) -> np.ndarray:
    """Reconstructs the data's ``image`` with the weights in a file: (H, W, 3) float32, scene-linear.

    ``device`` is one of PyTorch's, or "auto": a GPU if there is one. Tiles overlap by the network's receptive field, so
    their size does not change the result. Raises NgptError for unreadable weights, and for missing layers.
    """
    model = _loaded(path, device)
    read = layers_of(data, model.config, f"weights {path}", estimate=True)
    layers = {name: layer[None] for name, layer in read.items()}
    return reconstruct(model, layers, tile)[0].permute(1, 2, 0).cpu().numpy()


def layers_of(
    data: Repaired, config: ModelConfig, reader: str = "the network's settings", estimate: bool = False
) -> dict[str, Tensor]:
    """The inputs of a network from a repaired stack, as tensors (C, H, W); see ``inputs.gather``."""
    arrays = inputs.gather(data, config.layers, config.base, reader, estimate)
    return {name: torch.from_numpy(np.array(array.transpose(2, 0, 1), order="C")) for name, array in arrays.items()}


@torch.inference_mode()
def reconstruct(model: Reconstructor, layers: dict[str, Tensor], tile: int = TILE) -> Tensor:
    """The result of ``model(layers)``, computed in tiles whose padded side is at most ``tile`` pixels.

    Exposure and bounds are those of the whole image. Layers may be on another device than the model. A network of
    OIDN's shape is computed in one piece, because in use OIDN cuts its own tiles.
    """
    device = next(model.parameters()).device
    if model.config.network == "oidn":
        return model({name: layers[name].to(device) for name in model.config.layers})
    height, width = layers["primal"].shape[-2:]
    scaled, exposure = features.normalised({name: layers[name] for name in model.config.layers})
    low, high = model.bounds(scaled["primal"])
    pads = padding.pads(height, width, model.alignment)
    padded = padding.pad(features.completed(scaled, model.config.inputs), pads)
    rows, columns = padded["primal"].shape[-2:]
    logarithm = padded["primal"].new_empty(len(padded["primal"]), 3, rows, columns)
    spans = (_spans(length, tile, model.alignment, model.radius) for length in (rows, columns))
    for (y, y_around), (x, x_around) in product(*spans):
        part = {name: layer[..., y_around, x_around].to(device) for name, layer in padded.items()}
        inner = np.s_[..., tiles.within(y, y_around), tiles.within(x, x_around)]
        logarithm[..., y, x] = model.predict(part)[inner].to(logarithm.device)
    image = padding.crop(logarithm, pads)
    return signed_exp(torch.minimum(torch.maximum(image, low), high)) * exposure


def _spans(length: int, tile: int, alignment: int, radius: int) -> list[tuple[slice, slice]]:
    """For each tile: the pixels whose result it gives, and the pixels that it reads. ``alignment`` divides all ends."""
    margin = -(-radius // alignment) * alignment
    step = max(tile - 2 * margin, alignment) // alignment * alignment if length > tile else length
    return tiles.spans(length, step, margin)


def _loaded(path: str | Path, device: str) -> Reconstructor:
    return _model(str(path), os.stat(path).st_mtime_ns if Path(path).is_file() else 0, device)


@lru_cache(maxsize=4)
def _model(path: str, _modified: int, device: str) -> Reconstructor:
    """The model in a file; read again after the file has changed."""
    model, _ = load_weights(path)
    in_children(one_thread)
    if device == "auto":
        device = str(default_device())
    try:
        return model.to(device)
    except (RuntimeError, AssertionError) as error:
        raise NgptError(f"device '{device}': cannot be used: {' '.join(str(error).split())[:200]}") from error


def one_thread() -> None:
    """Sets PyTorch to one thread, for forked children, which would wait forever for the threads of their parent."""
    torch.set_num_threads(1)
