"""The loss of training: a perceptual distance, averaged over random transforms, and pixelwise terms.

Other packages add terms by entry points of the group "ngpt.losses", see docs/train/add-a-loss.md.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor

from ngpt.errors import NgptError
from ngpt.measure.distances import perceptual
from ngpt.measure.distances.perceptual import PerceptualDistance
from ngpt.system.parts import Registry
from ngpt.system.records import from_table
from ngpt.training import pixelwise
from ngpt.training.halves import halves

# A term maps (prediction, target), scene-linear (N, 3, H, W) float32 divided by the exposure, to a mean, a scalar.
Term = Callable[[Tensor, Tensor], Tensor]
_OURS: dict[str, Term] = {
    "l1": pixelwise.l1,
    "gradient": pixelwise.gradient_l1,
    "relative": pixelwise.relative,
    "huber": pixelwise.huber,
    "pyramid": pixelwise.pyramid,
}


@dataclass(frozen=True)
class LossSettings:
    """The table [loss] of a configuration.

    ``kind``         the perceptual part: "structural" (no weights needed), "elpips-squeeze" (NGPT's) or "elpips-vgg";
                     or, without a perceptual part, the name of a term such as "l1", which then has the weight 1
    ``evaluations``  draws of the random transforms that are averaged in each step
    ``scales``       largest downscaling among the transforms; NGPT trains with 2
    ``l1``, ``gradient``, ``relative``, ``huber``, ``pyramid``
                     weights of the pixelwise terms; NGPT has 0.01, 0.01, 0, 0, 0
    ``halves``       weight of the loss of pairs (``ngpt.training.halves``); 0.25 has about the effect of the other
                     weights in combine.toml
    ``backbone``, ``weights``  files of E-LPIPS (docs/train/losses.md); "" looks for the backbone in PyTorch's cache
    """

    kind: str = "structural"
    evaluations: int = 3
    scales: int = 2
    l1: float = 0.01
    gradient: float = 0.01
    relative: float = 0.0
    huber: float = 0.0
    pyramid: float = 0.0
    halves: float = 0.25
    backbone: str = ""
    weights: str = ""


# The table [loss] also has weights for terms of other packages, by the names of the terms.
_TAKEN = (*perceptual.KINDS, *(field.name for field in fields(LossSettings)))
TERMS: Registry[Term] = Registry("ngpt.losses", "loss", Callable, _OURS, _TAKEN)


class Loss:
    """A function of prediction and target, scene-linear (N, 3, H, W) float32, and a generator on their device.

    It returns the loss, which is a mean over the predictions, and its parts, by name, before weighting. The last
    predictions may be of pairs, which have no target: ``other`` holds the layers of their other halves
    (``ngpt.training.halves``).
    """

    def __init__(self, settings: LossSettings, others: dict[str, float] | None = None):
        """``others`` holds weights for terms of other packages, by name."""
        self.settings = settings
        weights = {name: getattr(settings, name) for name in _OURS} | (others or {})
        if settings.kind in TERMS:
            # Without a perceptual part, another weight would only scale the learning rate.
            weights[settings.kind] = 1.0
        self._terms = [(name, weight, TERMS[name]) for name, weight in weights.items() if weight]
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
        parts: dict[str, Tensor] = {}
        total = prediction.new_zeros(())
        if self._distance is not None:
            parts["perceptual"] = self._distance(prediction, target, generator)
            total = total + parts["perceptual"]
        for name, weight, term in self._terms:
            parts[name] = term(prediction, target)
            if parts[name].shape != ():
                shape = tuple(parts[name].shape)
                raise NgptError(f"[loss]: {name}: returned a tensor of shape {shape}; return its mean, a scalar")
            total = total + weight * parts[name]
        return total, parts


def make_loss(settings: dict[str, Any]) -> Loss:
    """The loss of a table [loss]. Raises NgptError for unknown keys and kinds, negative weights, and missing files."""
    known = {field.name for field in fields(LossSettings)}
    others = {name: value for name, value in settings.items() if name not in known and name in TERMS}
    result = from_table(LossSettings, {n: v for n, v in settings.items() if n not in others}, "[loss]")
    for name, value in settings.items():
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if name in others and not number:
            raise NgptError(f"[loss]: {name} = {value!r}: must be a number, the weight of that term")
        if number and not 0 <= value < math.inf:
            raise NgptError(f"[loss]: {name} = {value!r}: must be finite and not negative")
    if result.kind not in perceptual.KINDS and result.kind not in TERMS:
        raise NgptError(f"[loss]: kind = '{result.kind}': choose one of: {', '.join((*perceptual.KINDS, *TERMS))}")
    if result.evaluations < 1 or result.scales < 1:
        raise NgptError("[loss]: evaluations and scales must be at least 1")
    return Loss(result, others)
