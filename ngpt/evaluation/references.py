"""The reference of a scene: two independent halves, or one image from elsewhere.

With two halves, squared metrics do not include the noise of the reference (``ngpt.measure.metrics``).
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from ngpt.errors import NgptError
from ngpt.io.exr import read
from ngpt.io.frames import natural
from ngpt.measure.images import check_size, middle
from ngpt.measure.metrics import EPSILON, exposure_mismatch
from ngpt.repair import variance_of_primal
from ngpt.stack import GradientStack

# The ends of the names of two halves, before ".exr".
HALVES = ("-a", "-b")
# The largest difference in exposure that is allowed between a reference and a render. Reconstructions differ less than
# this from a reference, but renders with few samples, or with fireflies, may differ more than reconstructions.
MOST_STOPS = 1.0


@dataclass(frozen=True)
class Reference:
    """A reference, with the files that it was read from."""

    stacks: tuple[GradientStack, ...]
    files: tuple[str, ...]

    @cached_property
    def images(self) -> tuple[np.ndarray, ...]:
        """One image or two halves, (H, W, 3) each."""
        return tuple(stack["primal"] for stack in self.stacks)

    @cached_property
    def mean(self) -> np.ndarray:
        """The reference as one image (H, W, 3): the image itself, or the mean (a + b) / 2 of the halves a and b."""
        return middle(self.images)

    @property
    def key(self) -> list:
        """The key of the reference in the cache of cells."""
        status = [os.stat(file) for file in self.files]
        return [[Path(f).name, s.st_size, s.st_mtime_ns] for f, s in zip(self.files, status, strict=True)]

    def total(self, attribute: str) -> float | None:
        """The sum of a number in the headers of the files, such as the samples; None if a file lacks it."""
        values = [stack.number(attribute) for stack in self.stacks]
        return None if None in values else sum(value for value in values if value is not None)

    @property
    def noise(self) -> float | None:
        """The relMSE that the noise of the mean image causes; None if the files hold no variances."""
        if not all("primal_var" in stack for stack in self.stacks):
            return None
        if len(self.stacks) == 1:
            return reference_noise(self.stacks[0])
        a, b = (variance_of_primal(stack) for stack in self.stacks)
        return _number(np.mean((a + b) / 4 / (self.mean**2 + EPSILON)))

    @property
    def doubt(self) -> float | None:
        """The relMSE below which the order of methods is not reliable; None if the files hold no variances.

        With one image, it is three times the noise of the image, which is part of every error. With two halves, it is
        three standard errors of the mean of (a - t)(b - t) / (m² + 1e-3), with a and b the halves, m their mean and t
        the truth: in each pixel the product has the expectation 0, and its variance is the product of the variances of
        a and b. The noise of the three channels of a pixel is taken to be fully correlated.
        """
        noise = self.noise
        if noise is None or len(self.stacks) == 1:
            return None if noise is None else 3 * noise
        a, b = (variance_of_primal(stack).astype(np.float64) for stack in self.stacks)
        deviation = (np.sqrt(a * b) / (self.mean.astype(np.float64) ** 2 + EPSILON)).mean(axis=-1)
        return _number(3 * np.sqrt(np.sum(deviation**2)) / deviation.size)

    def check(self, stack: GradientStack) -> None:
        """Raises NgptError if the reference does not show the same image as ``stack``."""
        names = " and ".join(self.files)
        try:
            check_size(stack["primal"], self.mean)
        except NgptError as error:
            raise NgptError(f"reference {names}: {error}") from error
        stops = exposure_mismatch(self.mean, stack["primal"])
        if abs(stops) > MOST_STOPS:
            raise NgptError(
                f"reference {names}: {abs(stops):.1f} stops {'brighter' if stops > 0 else 'darker'} than the renders; "
                "use one of the same scene and exposure"
            )


def reference_noise(reference: GradientStack) -> float:
    """The part of every relMSE that is due to the reference's noise: the mean of its variance / (r² + epsilon)."""
    return float(np.mean(variance_of_primal(reference) / (reference["primal"] ** 2 + EPSILON)))


def read_reference(files: Sequence[str | Path]) -> Reference:
    """The reference in one file or two.

    Raises NgptError for files that cannot be read, and for halves that differ in size or are the same render.
    """
    stacks = tuple(read(file) for file in files)
    names = tuple(map(str, files))
    if len(stacks) == 2:
        check_size(stacks[0]["primal"], stacks[1]["primal"])
        if np.array_equal(stacks[0]["primal"], stacks[1]["primal"]):
            raise NgptError(f"{names[0]} and {names[1]}: are the same image; render the halves with different seeds")
    return Reference(stacks, names)


def find_reference(folder: Path) -> Reference:
    """The reference of a folder of stacks: two halves, reference*-a.exr and -b.exr, else reference*.exr.

    Raises NgptError where there is none.
    """
    found = sorted(folder.glob("reference*.exr"), key=natural)
    for path in found:
        other = path.with_name(f"{path.stem.removesuffix(HALVES[0])}{HALVES[1]}.exr")
        if path.stem.endswith(HALVES[0]) and other in found:
            return read_reference((path, other))
    if not found:
        raise NgptError(f"{folder}: no reference: name one reference.exr, or set references.{folder.name}")
    return read_reference(found[:1])


def _number(value: np.floating | float) -> float | None:
    """None for values that JSON does not have."""
    return float(value) if np.isfinite(value) else None
