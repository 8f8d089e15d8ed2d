"""Makes training examples from shots (frame sequences), for the network that blends frames (``ngpt.sequence.network``).

The loss is in ``ngpt.training.temporal``.
"""

import hashlib
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load_file, save

from ngpt.errors import NgptError
from ngpt.methods import reconstruct
from ngpt.sequence.history import Temporal
from ngpt.sequence.network import Corrections
from ngpt.sequence.warp import warped
from ngpt.stack import GradientStack
from ngpt.system.files import make_folder
from ngpt.system.writing import write_bytes
from ngpt.training.dataset import Dataset

# Squared relative errors are limited to this value, so that single pixels do not dominate the training.
OUTLIER = 1.0
# Squared errors are divided by the squared reference of the pixel, plus this share of the mean squared reference.
DARK = 0.02


@dataclass(frozen=True, eq=False)
class Clip:
    """A shot with one of its inputs, reconstructed by one method: a stack, a result and a reference for each frame.

    Images are (H, W, 3). ``halves`` has two references for each frame, each from half of the samples. References and
    halves exclude direct emission.
    """

    paired: ClassVar[bool] = False

    scene: str
    stacks: Sequence[GradientStack]
    results: Sequence[np.ndarray]
    references: Sequence[np.ndarray]
    halves: Sequence[tuple[np.ndarray, ...]]


def clips(folders: Sequence[str | Path], methods: Sequence[str], kept: Path) -> Iterator[Clip]:
    """Yields a clip for each combination of a shot of the training sets, one of its inputs, and a method.

    Results are cached in the folder ``kept``. Raises NgptError if a folder is no training set, or has no shots.
    """
    for folder in folders:
        data = Dataset(folder)
        shots = [shot for shot in data.shots if len(shot) > 1]
        if not shots:
            raise NgptError(f"{folder}: no shots to learn from; make them with: ngpt dataset --config data-shots")
        for shot in shots:
            crops = [data[i] for i in shot]
            light = [crop.reference - crop.reference_direct for crop in crops]
            # Without halves, the reference takes the place of both, and its noise counts as an error.
            halves = [
                tuple(half + crop.reference_caustic for half in crop.reference_halves) or (whole, whole)
                for crop, whole in zip(crops, light, strict=True)
            ]
            for k in range(crops[0].inputs):
                stacks = [crop.stack(k) for crop in crops]
                for method in methods:
                    yield Clip(crops[0].scene, stacks, list(_results(stacks, method, kept)), light, halves)


def _results(stacks: Sequence[GradientStack], method: str, folder: Path) -> np.ndarray:
    """The results of a method frame by frame, from the cache in ``folder``; computed and stored if missing."""
    # The file is named by a digest of the stacks, because shots are renumbered as a set grows, and several sets may
    # share names.
    digest = hashlib.sha256(b"".join(stack["primal"].tobytes() for stack in stacks)).hexdigest()
    kept = make_folder(folder) / f"{digest[:24]}-{method}.safetensors"
    with suppress(OSError, SafetensorError, KeyError):
        return load_file(kept)["results"]
    results = np.stack([reconstruct(stack, method).image for stack in stacks])
    write_bytes(kept, save({"results": results}))
    return results


def errors(clip: Clip, images: Sequence[np.ndarray]) -> tuple[float, float]:
    """(error, flicker) of a clip, relative to the reference and without the noise of the reference.

    Both are means over pixels and frames. ``images`` include direct emission.
    """
    found, changes = [], []
    last = None
    for stack, image, pair, reference in zip(clip.stacks, images, clip.halves, clip.references, strict=True):
        light = image - stack["direct"]
        both = [light - half for half in pair]
        weight = weight_of(reference)
        found.append(_product(both[0] * both[1] * weight))
        if last is not None:
            seen = [warped(error, stack["motion"]) for error in last]
            if seen[0][1].any():
                one, other = (error - before for error, (before, _) in zip(both, seen, strict=True))
                changes.append(_product((one * other * weight)[seen[0][1]]))
        last = both
    return float(np.mean(found[1:])), float(np.mean(changes)) if changes else float("nan")


def _product(values: np.ndarray) -> float:
    return float(np.mean(np.clip(values, -4, 4)))


def weight_of(reference: np.ndarray) -> np.ndarray:
    """The weights (H, W, 1) of squared errors (H, W, 3)."""
    squares = np.square(reference).mean(axis=-1, keepdims=True)
    return 1 / (squares + DARK * squares.mean() + 1e-20)


def play(clip: Clip, corrections: Corrections, long: float = 1.0) -> Iterator[dict[str, np.ndarray]]:
    """Yields the training examples of a clip: arrays (C, H, W) by name.

    There is one example for each frame that has a history (earlier frames to blend with).

    The error of the first result is multiplied by ``long``, as if it were already a blend of 1 / long² frames.
    """
    temporal = Temporal(corrections)
    last = None
    for stack, image, reference in zip(clip.stacks, clip.results, clip.references, strict=True):
        given = (
            image if last is not None else stack["direct"] + reference + long * (image - stack["direct"] - reference)
        )
        result = temporal.next(stack, given) - stack["direct"]
        if last is None:
            temporal.assume(long**2)
        blend, alone = temporal.blend, image - stack["direct"] - reference
        if last is not None and blend is not None:
            weight = weight_of(reference)
            (before, found), (alone_before, _) = (warped(error, stack["motion"]) for error in last)
            seen = found[..., None].astype(np.float32)
            arrays = {
                "inputs": blend.inputs(),
                "prior": blend.prior[..., None],
                "trust": blend.trust[..., None],
                "first": blend.first[..., None],
                "bands": np.concatenate(list(blend.bands), axis=-1),
                "alone": alone,
                "before": before,
                "weight": weight,
                "seen": seen,
                "level": reference.mean(keepdims=True),
                "errors": robust(np.square(alone) * weight).mean(keepdims=True),
                "changes": (seen * robust(np.square(alone - alone_before) * weight)).mean(keepdims=True),
            }
            yield {name: np.ascontiguousarray(np.moveaxis(a, -1, 0), np.float32) for name, a in arrays.items()}
        last = result - reference, alone


def relit(clip: Clip, rng: np.random.Generator) -> Clip:
    """The clip with a change of light: in the whole image or around a random place, suddenly or evenly over time."""
    y, x = np.mgrid[: clip.references[0].shape[0], : clip.references[0].shape[1]] / len(clip.references[0])
    place, width = rng.random(2), rng.choice([0.2, 0.5, 1e3])
    field = np.exp(-((x - place[0]) ** 2 + (y - place[1]) ** 2) / (2 * width**2))[..., None]
    count = len(clip.stacks)
    step = (np.arange(count) >= rng.integers(1, count)).astype(float)
    by = step * rng.normal(0, 0.7) if rng.integers(2) else np.arange(count) * rng.normal(0, 0.08)
    gains = [np.exp(gain * field).astype(np.float32) for gain in by]
    stacks, results = [], []
    for stack, image, gain in zip(clip.stacks, clip.results, gains, strict=True):
        primal, result = (stack["direct"] + gain * (light - stack["direct"]) for light in (stack["primal"], image))
        stacks.append(stack.replace(primal=primal, primal_var=gain**2 * stack["primal_var"]))
        results.append(result)
    halves = [tuple(gain * half for half in pair) for pair, gain in zip(clip.halves, gains, strict=True)]
    references = [gain * reference for reference, gain in zip(clip.references, gains, strict=True)]
    return Clip(clip.scene, stacks, results, references, halves)


def robust(squares):  # type: ignore[no-untyped-def]
    """Squares (arrays or tensors), smoothly limited to ``OUTLIER``; small ones hardly change."""
    return squares / (1 + squares / OUTLIER)


def blended(clip: Clip, corrections: Corrections | None) -> list[np.ndarray]:
    """The blended frames of a clip, with the corrections of a network, or without a network (None)."""
    temporal = Temporal(corrections)
    return [temporal.next(*pair) for pair in zip(clip.stacks, clip.results, strict=True)]
