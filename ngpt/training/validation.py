"""Validates a network on views that it is not trained on, in numbers and pictures."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ngpt.image.display import auto_exposure, to_srgb8
from ngpt.image.png import encode_png
from ngpt.measure.averages import geometric_mean
from ngpt.measure.images import middle
from ngpt.measure.metrics import relmse_trimmed
from ngpt.network.device import body_precision
from ngpt.network.inputs import base_image
from ngpt.network.model import Reconstructor
from ngpt.network.run_torch import layers_of
from ngpt.repair import repair
from ngpt.system.writing import write_bytes, write_json
from ngpt.training.examples import judges_of

# The number of rows of the picture of a validation.
_PICTURES = 6


class Pictures:
    """One picture with rows of input, result and reference, for some of ``count`` results.

    ``shown`` holds the indices of the results that should be added.
    """

    def __init__(self, count: int):
        self.shown = {int(i * count / _PICTURES) for i in range(_PICTURES)} if count else set()
        self._rows: list[np.ndarray] = []
        self._captions: list[dict[str, Any]] = []

    def add(self, images: Sequence[np.ndarray], scene: str, spp: int, primal: float, network: float) -> None:
        """Adds a row of input, result and reference (H, W, 3), with the errors ``primal`` and ``network``."""
        stops = auto_exposure(images[-1])
        self._rows.append(np.hstack([to_srgb8(image, stops) for image in images]))
        errors = {"relMSE primal": float(primal), "relMSE": float(network)}
        finite = {name: error for name, error in errors.items() if math.isfinite(error)}
        self._captions.append({"scene": scene, "spp": spp, **finite})

    def write(self, picture: str | Path) -> None:
        """Writes a PNG, and a JSON file with the size of one picture and each row's scene, samples and errors."""
        if not self._rows:
            return
        # In folders of stacks, views may have different sizes. Rows that differ from the first one are left out.
        fit = [i for i, row in enumerate(self._rows) if row.shape == self._rows[0].shape]
        rows = [self._rows[i] for i in fit]
        write_bytes(picture, encode_png(np.ascontiguousarray(np.vstack(rows))))
        size = [rows[0].shape[1] // 3, rows[0].shape[0]]
        write_json(Path(picture).with_suffix(".json"), {"size": size, "views": [self._captions[i] for i in fit]})


def views(crops: Sequence[Any], count: int) -> list[tuple[Any, int]]:
    """At most ``count`` views, (crop, number of an input), evenly spread over all views."""
    return spread([(crop, k) for crop in crops for k in range(crop.inputs)], count)


def spread(every: Sequence[Any], count: int) -> list[Any]:
    """At most ``count`` of the items, evenly spread."""
    if len(every) <= count:
        return list(every)
    return [every[int(i * len(every) / count)] for i in range(count)]


@torch.no_grad()
def validate(
    model: Reconstructor, views: Sequence[tuple[Any, int]], picture: str | Path = "", precision: str = "float32"
) -> dict[str, float]:
    """Geometric means, over views (crop, input), of the trimmed relMSE without direct emission.

    If a reference has two halves, errors do not include the noise of the reference. "relMSE" is the error of the
    result, "relMSE primal" of the input, and "relMSE base" of the base (NaN without one). If ``picture`` is given, a
    picture of some views is written to that file (``Pictures``).
    """
    model.eval()
    device = next(model.parameters()).device
    primal, base, network, pictures = [], [], [], Pictures(len(views) if picture else 0)
    for index, (crop, k) in enumerate(views):
        data = repair(crop.stack(k), model.config.reads_gradients)
        halves = judges_of(crop, model.config)
        reference = middle(halves)
        layers = {name: layer[None].to(device) for name, layer in layers_of(data, model.config).items()}
        with body_precision(device.type, precision):
            image = model(layers)[0].permute(1, 2, 0).float().cpu().numpy()
        given = layers["primal"][0].permute(1, 2, 0).cpu().numpy()
        primal.append(relmse_trimmed(given, *halves))
        network.append(relmse_trimmed(image, *halves))
        if model.config.base:
            base.append(relmse_trimmed(base_image(data, model.config.base), *halves))
        if index in pictures.shown:
            pictures.add((given, image, reference), crop.scene, int(crop.spp[k]), primal[-1], network[-1])
    pictures.write(picture)
    return {"relMSE": _mean(network), "relMSE primal": _mean(primal), "relMSE base": _mean(base)}


def _mean(values: list[float]) -> float:
    """The geometric mean; NaN for an empty list."""
    return geometric_mean(values) if values else float("nan")
