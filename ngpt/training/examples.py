"""Training examples from crops: datasets on disk, folders of stacks with references, or anything alike."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from torch.utils.data import Dataset as TorchDataset

from ngpt.denoisers import caustic
from ngpt.errors import NgptError
from ngpt.network import features, padding
from ngpt.network.model import ModelConfig
from ngpt.network.run_torch import layers_of
from ngpt.repair import repair
from ngpt.stack import GradientStack
from ngpt.training.augment import Augmentation, Layers, quieter, rarer

# Padding varies by up to this around ``padding.MARGIN``, so that networks do not learn where borders are.
JITTER = 7


def read(path: str) -> GradientStack:
    """The stack in a file. Training sets need no OpenEXR: it comes in with the first file that does."""
    from ngpt.io import exr

    return exr.read(path)


class Crop(Protocol):
    """One view with a reference and several inputs; what ``ngpt.training.dataset`` gives, and ``StackFolder``."""

    scene: str
    inputs: int
    spp: tuple[int, ...]

    def stack(self, k: int) -> GradientStack: ...

    @property
    def reference(self) -> np.ndarray: ...

    @property
    def reference_direct(self) -> np.ndarray: ...

    @property
    def reference_caustic(self) -> np.ndarray: ...

    @property
    def reference_halves(self) -> tuple[np.ndarray, ...]: ...


class StackCrop:
    """The stacks of one folder and the reference they share."""

    reference_halves = ()

    def __init__(self, folder: Path, stacks: list[Path], reference: Path):
        self.scene, self.inputs = folder.name, len(stacks)
        self._stacks, self._reference = stacks, reference
        held = [read(str(path)) for path in stacks]
        self.spp = tuple(int(stack.number("ngpt:spp") or 0) for stack in held)
        self._caustic = ["caustic" in stack for stack in held]
        self._lit = any("caustic" in stack and bool(stack["caustic"].any()) for stack in held)

    def stack(self, k: int) -> GradientStack:
        return read(str(self._stacks[k]))

    @property
    def reference(self) -> np.ndarray:
        return read(str(self._reference))["primal"]

    @property
    def reference_direct(self) -> np.ndarray:
        # A reference of the path tracer has no such layer; emission seen directly has next to no noise in any stack.
        most = self._stacks[int(np.argmax(self.spp))]
        for path in (self._reference, most):
            stack = read(str(path))
            if "direct" in stack:
                return stack["direct"]
        return np.zeros_like(stack["primal"])

    @property
    def reference_caustic(self) -> np.ndarray:
        """Of the reference, or that of all stacks together, spread; zeros if they have no such layer.

        Raises NgptError if only some of the stacks have it.
        """
        reference = read(str(self._reference))
        if all(self._caustic) and "caustic" in reference:
            return reference["caustic"]
        if not self._lit:
            return np.zeros_like(reference["primal"])
        if not all(self._caustic):
            raise NgptError(
                f"{self._stacks[self._caustic.index(False)]}: has no layer 'caustic', but other stacks of {self.scene} "
                "have: their gradients hold nothing of that light, so they have no target in common; render all alike"
            )
        stacks = [read(str(path)) for path in self._stacks]
        shares = np.divide(self.spp, sum(self.spp)) if all(self.spp) else np.full(len(stacks), 1 / len(stacks))
        light = sum(share * stack["caustic"] for share, stack in zip(shares, stacks, strict=True))
        layers = {"caustic": light, "primal": reference["primal"]}
        if all("caustic_var" in stack for stack in stacks):
            noise = [share**2 * stack["caustic_var"] for share, stack in zip(shares, stacks, strict=True)]
            layers["caustic_var"] = np.sum(noise, axis=0)
        features = {name: stacks[0][name] for name in ("albedo", "normal", "depth") if name in stacks[0]}
        return caustic.denoised(repair(GradientStack(layers | features)))


class StackFolder(Sequence[StackCrop]):
    """A folder with a folder for each view: its ``reference.exr``, and beside it any number of gradient stacks.

    Raises NgptError where a folder has stacks without a reference, or sizes differ.
    """

    def __init__(self, folder: str | Path):
        self._crops = []
        for view in sorted(path for path in Path(folder).iterdir() if path.is_dir()):
            stacks = sorted(path for path in view.glob("[!.]*.exr") if path.name != "reference.exr")
            reference = view / "reference.exr"
            if not stacks:
                continue
            if not reference.is_file():
                raise NgptError(f"{view}: has {len(stacks)} stacks but no reference.exr; render one with many samples")
            self._crops.append(StackCrop(view, stacks, reference))
        if not self._crops:
            raise NgptError(f"{folder}: no folder in it holds a reference.exr and stacks (*.exr)")

    def __len__(self) -> int:
        return len(self._crops)

    def __getitem__(self, index):  # type: ignore[no-untyped-def]
        return self._crops[index]

    @property
    def scenes(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(crop.scene for crop in self._crops))


def open_crops(folder: str | Path) -> Iterable[Any]:
    """The crops of a dataset (it has a manifest) or of a folder of stacks."""
    path = Path(folder)
    if not path.is_dir():
        raise NgptError(f"{folder}: no such folder; make a training set: ngpt dataset --config ... --out {folder}")
    if (path / "manifest.json").is_file():
        from ngpt.training.dataset import Dataset

        return Dataset(path)
    return StackFolder(path)


class Mixture(Sequence[Any]):
    """Several sequences of crops as one; they may grow while they are read, as streams do."""

    def __init__(self, *parts: Any):
        self.parts = parts

    def __len__(self) -> int:
        return sum(len(part) for part in self.parts)

    def __getitem__(self, index):  # type: ignore[no-untyped-def]
        for part in self.parts:
            if index < len(part):
                return part[index]
            index -= len(part)
        raise IndexError(index)


class Examples(TorchDataset):
    """Endless training examples, each a function of its index and the seed: whoever asks, and when.

    Example ``i`` is one crop with one of its inputs (or ``Augmentation.quieter``, ``rarer``), at random, normalised,
    augmented and padded: a dict of layers (C, size + 16, size + 16) and the "target" (3, size - 14, size - 14) for the
    middle of that, where no padding is whatever its jitter [NGPT's code]. Crops larger than ``size`` are cut at random.
    What was read and prepared once is kept in memory, up to ``cache`` bytes.
    """

    def __init__(
        self,
        crops: Sequence[Any],
        config: ModelConfig,
        augmentation: Augmentation,
        size: int,
        seed: int,
        cache: int = 0,
    ):
        self.crops, self.config, self.augmentation, self.size, self.seed = crops, config, augmentation, size, seed
        # What makes an input of a crop that was not rendered.
        made = {self._quieter: augmentation.quieter, self._rarer: augmentation.rarer}
        self._made = [make for make, asked in made.items() if asked]
        self._cache: dict[tuple[int, int], Layers] = {}
        self._free = cache

    def __len__(self) -> int:
        return 2**62

    def __getitem__(self, index: int) -> Layers:
        rng = np.random.default_rng((self.seed, index))
        # Uniform over crops, whatever the number of their inputs.
        which = int(rng.integers(len(self.crops)))
        crop = self.crops[which]
        k = int(rng.integers(crop.inputs + len(self._made)))
        layers = self.augmentation(_scaled(self._cut(self._layers(which, k), rng)), rng)
        layers = features.completed(layers, self.config.inputs)
        top, left = (padding.MARGIN + int(rng.integers(-JITTER, JITTER + 1)) for _ in range(2))
        padded = padding.pad(layers, (top, 2 * padding.MARGIN - top, left, 2 * padding.MARGIN - left))
        edge = padding.MARGIN + JITTER
        padded["target"] = padded["target"][..., edge:-edge, edge:-edge]
        return {name: layer.contiguous() for name, layer in padded.items()}

    def _layers(self, which: int, k: int) -> Layers:
        if (which, k) in self._cache:
            return self._cache[which, k]
        crop = self.crops[which]
        stack = crop.stack(k) if k < crop.inputs else self._made[k - crop.inputs](which)
        layers = layers_of(repair(stack, self.config.reads_gradients), self.config)
        target = target_of(crop, self.config).transpose(2, 0, 1)
        layers["target"] = torch.from_numpy(np.ascontiguousarray(target))
        size = sum(layer.numel() * layer.element_size() for layer in layers.values())
        if size <= self._free:
            self._cache[which, k], self._free = layers, self._free - size
        return layers

    def _quieter(self, which: int) -> GradientStack:
        """The input of that crop with most samples, as of many more."""
        crop = self.crops[which]
        low, high = np.log(self.augmentation.quieter)
        factor = float(np.exp(np.random.default_rng((self.seed, which)).uniform(low, high)))
        best = crop.stack(int(np.argmax(crop.spp)))
        return quieter(best, crop.reference, crop.reference_direct, crop.reference_caustic, factor)

    def _rarer(self, which: int) -> GradientStack:
        """The input of that crop with most samples, as of light that is harder to find."""
        crop, rng = self.crops[which], np.random.default_rng((self.seed, which, 1))
        k = float(np.exp(rng.uniform(*np.log(self.augmentation.rarer))))
        return rarer(crop.stack(int(np.argmax(crop.spp))), k, float(rng.uniform(0.5, 1)), rng)

    def _cut(self, layers: Layers, rng: np.random.Generator) -> Layers:
        height, width = layers["primal"].shape[-2:]
        if height < self.size or width < self.size:
            raise NgptError(
                f"a crop is {width}x{height}, smaller than the {self.size} pixels of an example; lower data.crop"
            )
        y, x = int(rng.integers(height - self.size + 1)), int(rng.integers(width - self.size + 1))
        return {name: layer[..., y : y + self.size, x : x + self.size] for name, layer in layers.items()}


def judges_of(crop: Crop, config: ModelConfig) -> tuple[np.ndarray, ...]:
    """What errors of such a network are measured by, (H, W, 3) each: two independent halves, or the one target.

    A product of the errors to two halves is free of their noise, see ``ngpt.measure.metrics``.
    """
    halves = crop.reference_halves
    if not halves:
        return (target_of(crop, config),)
    # Halves have no image of the layer of their own; for networks without gradients that of all samples counts.
    beside = np.zeros_like(halves[0]) if config.reads_gradients else crop.reference_caustic
    return tuple(half + beside for half in halves)


def target_of(crop: Crop, config: ModelConfig) -> np.ndarray:
    """What a network of that configuration is to make of a crop's stacks, (H, W, 3)."""
    target = crop.reference - crop.reference_direct
    return target - crop.reference_caustic if config.reads_gradients else target


def _scaled(layers: Layers) -> Layers:
    batch = {name: layer[None] for name, layer in layers.items()}
    target = batch.pop("target")
    scaled, exposure = features.normalised(batch)
    return {name: layer[0] for name, layer in (scaled | {"target": target / exposure}).items()}


def split(crops: Sequence[Any], validation: tuple[str, ...]) -> tuple[list[Any], list[Any]]:
    """Training and validation crops; whole scenes of which the name starts with one of ``validation`` are kept out.

    Raises NgptError for a name that no scene starts with: such a run would be judged by nothing, or by less than asked.
    """
    scenes = sorted({crop.scene for crop in crops})
    for name in validation if scenes else ():
        if not any(scene.startswith(name) for scene in scenes):
            some = ", ".join(scenes[:8]) + (", ..." if len(scenes) > 8 else "")
            raise NgptError(
                f"data.validation: no scene has a name that begins with '{name}'; there are {some}. "
                "--set data.validation='[]' trains without"
            )
    held = [crop.scene.startswith(tuple(validation)) if validation else False for crop in crops]
    return [c for c, out in zip(crops, held, strict=True) if not out], [
        c for c, out in zip(crops, held, strict=True) if out
    ]
