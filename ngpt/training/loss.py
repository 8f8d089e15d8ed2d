"""What training minimises: a perceptual distance over random transforms, and pixelwise terms beside it."""

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ngpt.errors import NgptError
from ngpt.measure.distances import perceptual
from ngpt.measure.distances.perceptual import PerceptualDistance
from ngpt.system.records import from_table
from ngpt.training import pixelwise
from ngpt.training.halves import halves

KINDS = (*perceptual.KINDS, "pu", "l1")


@dataclass(frozen=True)
class LossSettings:
    """The table [loss] of a configuration.

    ``kind``         the perceptual part: "structural" (no weights needed), "elpips-squeeze" (NGPT's), "elpips-vgg",
                     "pu" (OIDN's), or "l1" for none
    ``evaluations``  draws of the random transforms that are averaged in each step
    ``scales``       largest downscaling among the transforms; NGPT trains with 2
    ``l1``, ``gradient``, ``relative``, ``logarithmic``, ``huber``, ``pyramid``, ``flip``
                     weights of the pixelwise parts; NGPT has 0.01, 0.01, 0, 0, 0, 0, 0
    ``halves``       weight of the loss of pairs, ``ngpt.training.halves``; 0.25 pulls like those of combine.toml
    ``backbone``, ``weights``  files of E-LPIPS (docs/train/losses.md); "" looks for the backbone in PyTorch's cache
    """

    kind: str = "structural"
    evaluations: int = 3
    scales: int = 2
    l1: float = 0.01
    gradient: float = 0.01
    relative: float = 0.0
    logarithmic: float = 0.0
    huber: float = 0.0
    pyramid: float = 0.0
    flip: float = 0.0
    halves: float = 0.25
    backbone: str = ""
    weights: str = ""


class Loss:
    """Call it with prediction and target, scene-linear (N, 3, H, W) float32, and a generator on their device.

    ``other``  of the last predictions, which have no target: what judges them, see ``ngpt.training.halves``

    Returns the weighted sum, a mean over the predictions, and its parts, by name, before weighting.
    """

    def __init__(self, settings: LossSettings):
        self.settings = settings
        self._distance: PerceptualDistance | None = None
        if settings.kind in perceptual.KINDS:
            self._distance = PerceptualDistance(
                settings.kind, settings.evaluations, settings.scales, settings.backbone, settings.weights
            )

    def __call__(
        self,
        prediction: Tensor,
        target: Tensor | None,
        generator: torch.Generator,
        other: dict[str, Tensor] | None = None,
    ) -> tuple[Tensor, dict[str, Tensor]]:
        count = 0 if target is None else len(target)
        parts: dict[str, Tensor] = {}
        total = prediction.new_zeros(())
        if target is not None:
            total, parts = self._by_reference(prediction[:count], target, generator)
        if other:
            parts["halves"] = halves(prediction[count:], other)
            share = count / len(prediction)
            total = share * total + (1 - share) * self.settings.halves * parts["halves"]
        return total, parts

    def _by_reference(
        self, prediction: Tensor, target: Tensor, generator: torch.Generator
    ) -> tuple[Tensor, dict[str, Tensor]]:
        s, parts = self.settings, {}
        total = prediction.new_zeros(())
        if self._distance is not None:
            parts["perceptual"] = self._distance(prediction, target, generator)
            total = total + parts["perceptual"]
        if s.kind == "pu":
            parts["pu"] = pixelwise.pu(prediction, target)
            total = total + parts["pu"]
        for name, weight, function in (
            # Alone, L1 is the loss, and its weight would only scale the learning rate.
            ("l1", s.l1 if s.kind != "l1" else 1.0, pixelwise.l1),
            ("gradient", s.gradient, pixelwise.gradient_l1),
            ("relative", s.relative, pixelwise.relative),
            ("logarithmic", s.logarithmic, pixelwise.logarithmic),
            ("huber", s.huber, pixelwise.huber),
            ("pyramid", s.pyramid, pixelwise.pyramid),
            ("flip", s.flip, pixelwise.flip),
        ):
            if weight:
                parts[name] = function(prediction, target)
                total = total + weight * parts[name]
        return total, parts


def make_loss(settings: dict[str, Any]) -> Loss:
    """The loss of a table [loss]. Raises NgptError for unknown keys and kinds, negative weights, and missing files."""
    result = from_table(LossSettings, settings, "[loss]")
    for name, value in settings.items():
        if isinstance(value, int | float) and not 0 <= value < math.inf:
            raise NgptError(f"[loss]: {name} = {value!r}: must be finite and not negative")
    if result.kind not in KINDS:
        raise NgptError(f"[loss]: kind = '{result.kind}': choose one of: {', '.join(KINDS)}")
    if result.evaluations < 1 or result.scales < 1:
        raise NgptError("[loss]: evaluations and scales must be at least 1")
    return Loss(result)
