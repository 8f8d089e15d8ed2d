"""Training examples from crops (``ngpt.training.crops``)."""

import copy
from collections import OrderedDict
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch.utils.data import Dataset as TorchDataset

from ngpt.classical.gradients import forward_differences
from ngpt.errors import NgptError
from ngpt.network import features, padding
from ngpt.network.config import ModelConfig
from ngpt.network.run_torch import layers_of
from ngpt.repair import Repaired, repair
from ngpt.stack import GradientStack
from ngpt.training.augment import Augmentation, Layers, quieter
from ngpt.training.crops import Crop

# The names of layers from the other half of a pair begin with this.
OTHER = "other/"
# Padding varies around ``padding.MARGIN`` by up to this number of pixels, so that networks do not learn its width.
JITTER = 7


class Examples(TorchDataset):
    """Endless training examples. An example depends only on its index and the seed, not on process and order.

    An example is a random crop with one of its inputs (or the input that ``Augmentation.quieter`` adds), normalised,
    augmented and padded: a dict of layers (C, size + 16, size + 16) and the "target" (3, size - 14, size - 14). The
    target covers the middle, which the varying padding never reaches [NGPT's code]. Crops larger than ``size`` are cut
    at random. Prepared layers are cached in memory, up to ``cache`` bytes.

    A crop may be a pair: two halves of the samples, and no reference (``ngpt.training.halves``). The input is then one
    half, and the target is the other half, in layers whose names begin with "other/". If there are both pairs and crops
    with references, ``pairs`` is the share of the examples that are pairs.
    """

    def __init__(
        self,
        crops: Sequence[Any],
        config: ModelConfig,
        augmentation: Augmentation,
        size: int,
        seed: int,
        cache: int = 0,
        pairs: float = 0.5,
    ):
        kinds = {crop.paired for crop in crops}
        self.pairs = pairs if len(kinds) > 1 else None
        self.crops, self.config, self.augmentation, self.size, self.seed = crops, config, augmentation, size, seed
        self._cache: OrderedDict[tuple[Crop, int], tuple[Layers, Layers]] = OrderedDict()
        self._free = cache

    def __len__(self) -> int:
        return 2**62

    def __getitem__(self, index: int) -> Layers:
        rng = np.random.default_rng((self.seed, index))
        which, crop = self._drawn(rng)
        k = int(rng.integers(crop.inputs + (bool(self.augmentation.quieter) and not crop.paired)))
        parts = _scaled(*self._cut(*self._layers(which, crop, k), rng))
        # The target gets the same augmentation as the input.
        same = copy.deepcopy(rng)
        layers, judge = self.augmentation(parts[0], rng), self.augmentation(parts[1], same)
        layers = features.completed(layers, self.config.inputs)
        top, left = (padding.MARGIN + int(rng.integers(-JITTER, JITTER + 1)) for _ in range(2))
        pads = (top, 2 * padding.MARGIN - top, left, 2 * padding.MARGIN - left)
        edge = padding.MARGIN + JITTER
        inside = {name: layer[..., edge:-edge, edge:-edge] for name, layer in padding.pad(judge, pads).items()}
        if crop.paired:
            inside = {f"{OTHER}{name}": layer for name, layer in inside.items()}
        return {name: layer.contiguous() for name, layer in (padding.pad(layers, pads) | inside).items()}

    def _drawn(self, rng: np.random.Generator) -> tuple[int, Crop]:
        """A random crop with its index. All crops of a kind are equally likely, whatever the number of their inputs."""
        paired = None if self.pairs is None else bool(rng.random() < self.pairs)
        while True:
            which = int(rng.integers(len(self.crops)))
            crop = self.crops[which]
            if paired in (None, crop.paired):
                return which, crop

    def _layers(self, which: int, crop: Crop, k: int) -> tuple[Layers, Layers]:
        """The layers of input ``k`` of a crop, and those of its target: only "target", or layers of the other half."""
        if (crop, k) in self._cache:
            self._cache.move_to_end((crop, k))
            return self._cache[crop, k]
        stack = crop.stack(k) if k < crop.inputs else self._quieter(which, crop)
        data = repair(stack, self.config.reads_gradients)
        layers = layers_of(data, self.config)
        if crop.paired:
            half = data if self.config.reads_gradients else repair(stack)
            judge = _tensors(other_half(half, crop.stack(1 - k), not self.config.reads_gradients))
        else:
            judge = _tensors({"target": target_of(crop, self.config)})
        self._cache[crop, k] = layers, judge
        self._free -= _bytes(layers, judge)
        while self._free < 0:
            # Drops the least recently used entry. In a stream, its crop may no longer exist.
            self._free += _bytes(*self._cache.popitem(last=False)[1])
        return layers, judge

    def _quieter(self, which: int, crop: Crop) -> GradientStack:
        """The input of the crop with the most samples, as if it had even more (``augment.quieter``)."""
        low, high = np.log(self.augmentation.quieter)
        factor = float(np.exp(np.random.default_rng((self.seed, which)).uniform(low, high)))
        best = crop.stack(int(np.argmax(crop.spp)))
        return quieter(best, crop.reference, crop.reference_direct, crop.reference_caustic, factor)

    def _cut(self, layers: Layers, judge: Layers, rng: np.random.Generator) -> tuple[Layers, ...]:
        height, width = layers["primal"].shape[-2:]
        if height < self.size or width < self.size:
            raise NgptError(
                f"a crop is {width}x{height}, smaller than the {self.size} pixels of an example; "
                f"--set data.crop={min(height, width)}"
            )
        y, x = int(rng.integers(height - self.size + 1)), int(rng.integers(width - self.size + 1))
        window = np.s_[..., y : y + self.size, x : x + self.size]
        return tuple({name: layer[window] for name, layer in part.items()} for part in (layers, judge))


def collated(examples: Sequence[Layers]) -> Layers:
    """A batch of examples. Examples with a "target" come first, so that inputs and targets have the same order."""
    ordered = sorted(examples, key=lambda example: "target" not in example)
    names = dict.fromkeys(name for example in ordered for name in example)
    return {name: torch.stack([example[name] for example in ordered if name in example]) for name in names}


def other_half(ours: Repaired, other: GradientStack, whole: bool) -> dict[str, np.ndarray]:
    """The target for one half of a pair (``ngpt.training.halves``): arrays (H, W, C).

    They are layers of the half ``other``, and standard errors of the half ``ours``, which is the input.

    ``ours``   is repaired for a method that reads gradients
    ``whole``  whether the target includes the light of the layer ``caustic``. Gradients exclude this light, so its
               pixel differences, which have more noise, are added to them

    Raises NgptError if both halves are the same, or if one lacks gradients or their variances.
    """
    theirs = repair(other)
    if ours.variances is None or theirs.dx is None:
        raise NgptError(f"{other.path}: one half lacks gradients or their variances, without which pairs teach nothing")
    if np.array_equal(ours.image, theirs.image):
        raise NgptError(
            f"{other.path}: both halves are the same, so noise would be learnt; render them with different seeds"
        )
    layers = {"primal": theirs.image, "dx": theirs.dx, "dy": theirs.dy}
    known = [np.isfinite(variance).all(axis=-1) for variance in ours.variances]
    variances = [np.where(k[..., None], v, 0) for k, v in zip(known, ours.variances, strict=True)]
    if whole and theirs.caustic is not None:
        light = (theirs.caustic, *forward_differences(theirs.caustic))
        layers = {name: layer + further for (name, layer), further in zip(layers.items(), light, strict=True)}
    if whole and ours.caustic_var is not None:
        variance = np.nan_to_num(ours.caustic_var)
        after = [np.concatenate([np.delete(variance, 0, axis), np.take(variance, [-1], axis)], axis) for axis in (1, 0)]
        variances = [variances[0] + variance, *(v + variance + a for v, a in zip(variances[1:], after, strict=True))]
    layers |= dict(zip(("primal_se", "dx_se", "dy_se"), (np.sqrt(v) for v in variances), strict=True))
    # In pixels that show lamps, the variance of all other light is unknown.
    counts = known[0] & ~theirs.direct.any(axis=-1)
    return layers | {"counts": counts[..., None].astype(np.float32)}


def _bytes(*parts: Layers) -> int:
    return sum(layer.numel() * layer.element_size() for part in parts for layer in part.values())


def _tensors(arrays: dict[str, np.ndarray]) -> Layers:
    return {name: torch.from_numpy(np.ascontiguousarray(array.transpose(2, 0, 1))) for name, array in arrays.items()}


def judges_of(crop: Crop, config: ModelConfig) -> tuple[np.ndarray, ...]:
    """The images (H, W, 3) for measuring the errors of a network: two independent halves of a reference, or one target.

    The noise of two halves cancels in the product of both errors (``ngpt.measure.metrics``).
    """
    halves = crop.reference_halves
    if not halves:
        return (target_of(crop, config),)
    # Results of networks without gradients include the light of ``caustic``. Halves have no such layer of their own, so
    # they get the one of the whole reference.
    beside = np.zeros_like(halves[0]) if config.reads_gradients else crop.reference_caustic
    return tuple(half + beside for half in halves)


def target_of(crop: Crop, config: ModelConfig) -> np.ndarray:
    """The target (H, W, 3) of a crop, for a network of that configuration."""
    target = crop.reference - crop.reference_direct
    return target - crop.reference_caustic if config.reads_gradients else target


def _scaled(layers: Layers, judge: Layers) -> tuple[Layers, Layers]:
    """The normalised ``layers``, and ``judge`` with its light divided by the exposure of ``layers``."""
    scaled, exposure = features.normalised({name: layer[None] for name, layer in layers.items()})
    light = features.RADIANCE | {"target"}
    return {name: layer[0] for name, layer in scaled.items()}, {
        name: layer / exposure[0] if name in light else layer for name, layer in judge.items()
    }
