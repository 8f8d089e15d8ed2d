"""The data for training: crops of training sets, folders of stacks with references, and mixtures of both."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from ngpt.denoisers import caustic
from ngpt.errors import NgptError
from ngpt.io.frames import natural
from ngpt.repair import repair
from ngpt.stack import GradientStack


class Crop(Protocol):
    """A view with several inputs and a reference, from ``ngpt.training.dataset`` or ``stack_folder``.

    A ``paired`` crop has no reference; each of its two inputs is the target of the other.
    """

    scene: str
    inputs: int
    spp: tuple[int, ...]
    paired: bool

    def stack(self, k: int) -> GradientStack: ...

    @property
    def reference(self) -> np.ndarray: ...

    @property
    def reference_direct(self) -> np.ndarray: ...

    @property
    def reference_caustic(self) -> np.ndarray: ...

    @property
    def reference_halves(self) -> tuple[np.ndarray, ...]: ...


class JoinedCrops(Sequence[Any]):
    """Several sequences of crops as one sequence. They may grow while they are read, as streams do."""

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


def read(path: str) -> GradientStack:
    """The stack in a file. The reader of OpenEXR is imported only here, because training sets do not need it."""
    from ngpt.io import exr

    return exr.read(path)


class StackCrop:
    """The stacks in a folder, and their common reference. Raises NgptError if their windows differ."""

    reference_halves = ()
    paired = False

    def __init__(self, folder: Path, stacks: list[Path], reference: Path):
        self.scene, self.inputs = folder.name, len(stacks)
        self._stacks, self._reference = stacks, reference
        held = [read(str(path)) for path in stacks]
        converged = read(str(reference))
        for stack in held:
            if stack.place.seen_from(converged.place) != converged.place.data:
                raise NgptError(
                    f"{stack.path} is {stack.place} but {reference} is {converged.place}; render them with one data "
                    "window"
                )
        self.spp = tuple(int(stack.number("ngpt:spp") or 0) for stack in held)
        self._caustic = ["caustic" in stack for stack in held]
        self._lit = any("caustic" in stack and bool(stack["caustic"].any()) for stack in held)

    def stack(self, k: int) -> GradientStack:
        stack = read(str(self._stacks[k]))
        # No network reads the layer ``shared``, so augmentation does not transform this layer. Shards leave it out,
        # too.
        stack.layers.pop("shared", None)
        return stack

    @property
    def reference(self) -> np.ndarray:
        return read(str(self._reference))["primal"]

    @property
    def reference_direct(self) -> np.ndarray:
        # References from a path tracer lack the layer ``direct``. It is then taken from the stack with the most
        # samples, because it has little noise in any stack.
        most = self._stacks[int(np.argmax(self.spp))]
        for path in (self._reference, most):
            stack = read(str(path))
            if "direct" in stack:
                return stack["direct"]
        return np.zeros_like(stack["primal"])

    @property
    def reference_caustic(self) -> np.ndarray:
        """The light in the reference that the layer ``caustic`` of the stacks estimates.

        If the reference lacks this layer, the result is its mean over all stacks, denoised; or zeros, if it is empty in
        all stacks. Raises NgptError if only some of the stacks have the layer, with light in it.
        """
        reference = read(str(self._reference))
        if all(self._caustic) and "caustic" in reference:
            return reference["caustic"]
        if not self._lit:
            return np.zeros_like(reference["primal"])
        if not all(self._caustic):
            raise NgptError(
                f"{self._stacks[self._caustic.index(False)]}: has no layer 'caustic', but other stacks of {self.scene} "
                "have one, so their gradients belong to different images; render all of them alike"
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


def stack_folder(folder: Path) -> list[StackCrop]:
    """The views in a folder. Each is a folder with ``reference.exr`` and any number of stacks.

    Raises NgptError for stacks without a reference, for different sizes, and if there is no view.
    """
    crops = []
    views = [path for path in folder.iterdir() if path.is_dir() and not path.name.startswith(".")]
    for view in sorted(views, key=natural):
        stacks = sorted((path for path in view.glob("[!.]*.exr") if path.name != "reference.exr"), key=natural)
        reference = view / "reference.exr"
        if stacks and not reference.is_file():
            raise NgptError(f"{view}: has {len(stacks)} stacks but no reference.exr; render one with many samples")
        if stacks:
            crops.append(StackCrop(view, stacks, reference))
    if not crops:
        raise NgptError(f"{folder}: no folder in it holds a reference.exr and stacks (*.exr)")
    return crops


def open_crops(folder: str | Path) -> Iterable[Any]:
    """The crops of a data set (a folder with a manifest) or of a folder of stacks."""
    path = Path(folder)
    if not path.is_dir():
        raise NgptError(f"{folder}: no such folder; make a training set: ngpt dataset --config ... --out {folder}")
    if (path / "manifest.json").is_file():
        from ngpt.training.dataset import Dataset

        return Dataset(path)
    return stack_folder(path)
