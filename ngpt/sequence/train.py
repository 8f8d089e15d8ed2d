"""Training of the network that blends frames (``ngpt.sequence.network``), on shots of training sets.

    python -m ngpt.sequence.train DATA... --out temporal.safetensors

A frame's history is made by the network itself: in each round the current network plays the shots, and it learns from
the resulting histories until the next round [Ross et al. 2011, "A reduction of imitation learning and structured
prediction to no-regret online learning"]. Results frame by frame come from several methods, so it learns to work with
any. The loss of a frame is

    E |y - r|² / E_x + FLICKER E |(y - r) - W (y' - r')|² / F_x

relative to the reference r, where W looks up values along motion and ' marks the frame before. E_x and F_x are the same
errors of x, so all shots count alike. The noise of a reference is independent of y, and adds the same constant whatever
the network does. Added to the loss is the square of how much darker or brighter y is than x, in the mean of a batch:
otherwise the easiest way to remove specks would be to lose their light. The effect of y on later frames is left out:
among filters that know their own variance, the one with the least error now is also the best for later.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from safetensors.numpy import load_file, save_file
from torch import Tensor

from ngpt.errors import NgptError
from ngpt.methods import METHODS, reconstruct
from ngpt.network.unet import PlainUNet
from ngpt.network.weights import fill, read_tensors, write_tensors
from ngpt.sequence.history import Temporal
from ngpt.sequence.network import BANDS, INPUTS, LARGEST, MOST, Corrections
from ngpt.sequence.warp import warped
from ngpt.stack import GradientStack
from ngpt.training.dataset import Dataset
from ngpt.version import __version__

WIDTHS = (16, 24, 32)
FLICKER = 1.0
ENERGY = 300.0
# Squared relative errors beyond which more is not much worse: single pixels do not rule what is learnt.
OUTLIER = 1.0
# Share of the mean of squares that is added to a pixel's before errors are divided by it.
DARK = 0.02
LEAST = 3e-4
# Frames that may be behind the first of a shot, in training: shots are short, and histories are not.
LENGTHS = (1, 1, 4, 12)
# The share of clips whose light is made to change, more often and more than in the shots themselves.
RELIT = 0.4


@dataclass(frozen=True)
class Clip:
    """A shot by one method, with one of its inputs: stacks and the method's results, references (H, W, 3) each.

    References are without direct emission, and so are ``halves``: pairs of references of half the samples.
    """

    scene: str
    stacks: Sequence[GradientStack]
    results: Sequence[np.ndarray]
    references: Sequence[np.ndarray]
    halves: Sequence[tuple[np.ndarray, ...]]


def clips(folders: Sequence[str | Path], methods: Sequence[str], cache: Path | None = None) -> Iterator[Clip]:
    """All shots of training sets, with each input, by each method. ``cache`` is a folder to keep results in."""
    for folder in folders:
        data = Dataset(folder)
        for shot in data.shots:
            crops = [data[i] for i in shot]
            light = [crop.reference - crop.reference_direct for crop in crops]
            halves = [tuple(half + crop.reference_caustic for half in crop.reference_halves) for crop in crops]
            for k in range(crops[0].inputs):
                stacks = [crop.stack(k) for crop in crops]
                for method in methods:
                    # Not by its number in the set, which may have grown since.
                    name = f"{crops[0].shard.path.stem}-{crops[0].index}-{k}-{method}.safetensors"
                    kept = cache / name if cache else None
                    if kept is not None and kept.is_file():
                        results = load_file(kept)["results"]
                    else:
                        results = np.stack([reconstruct(stack, method).image for stack in stacks])
                        if kept is not None:
                            save_file({"results": results}, kept)
                    yield Clip(crops[0].scene, stacks, list(results), light, halves)


def errors(clip: Clip, images: Sequence[np.ndarray]) -> tuple[float, float]:
    """Mean error and flicker of images with direct emission, relative to the reference, free of its noise."""
    found, changes = [], []
    last = None
    for stack, image, pair, reference in zip(clip.stacks, images, clip.halves, clip.references, strict=True):
        light = image - stack["direct"]
        both = [light - half for half in pair]
        weight = _weight(reference)
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


def _weight(reference: np.ndarray) -> np.ndarray:
    """What squared errors (H, W, 3) are multiplied by, (H, W, 1)."""
    squares = np.square(reference).mean(axis=-1, keepdims=True)
    return 1 / (squares + DARK * squares.mean() + 1e-20)


def play(clip: Clip, corrections: Corrections, long: float = 1.0) -> Iterator[dict[str, np.ndarray]]:
    """What the network meets in a clip and may learn from, frame by frame: arrays (C, H, W).

    The first result is of ``long`` times its error: as if so long a history, of 1 / long² frames, were behind it.
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
            weight = _weight(reference)
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
                "errors": _robust(np.square(alone) * weight).mean(keepdims=True),
                "changes": (seen * _robust(np.square(alone - alone_before) * weight)).mean(keepdims=True),
            }
            yield {name: np.ascontiguousarray(np.moveaxis(a, -1, 0), np.float32) for name, a in arrays.items()}
        last = result - reference, alone


def relit(clip: Clip, rng: np.random.Generator) -> Clip:
    """The clip with light that changes, all of it or around a place: at one frame, or evenly over all of them."""
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


def _robust(squares):  # type: ignore[no-untyped-def]
    """Squares (arrays or tensors) limited to ``OUTLIER``; small ones stay nearly as they are."""
    return squares / (1 + squares / OUTLIER)


def network() -> PlainUNet:
    """It says nothing to begin with."""
    return PlainUNet(len(INPUTS), WIDTHS, BANDS, zero=True)


def loss(model: PlainUNet, batch: dict[str, Tensor]) -> Tensor:
    """The loss of frames (N, C, H, W) from ``play``: 1 + FLICKER if results are no better than frame by frame."""
    shares = MOST * torch.sigmoid(batch["prior"] + LARGEST * torch.tanh(model(batch["inputs"]) / LARGEST))
    shares = batch["trust"] * torch.minimum(shares, batch["first"])
    bands = batch["bands"].unflatten(1, (BANDS, 3))
    taken = (shares[:, :, None] * bands).sum(1)
    error = batch["alone"] + taken
    errors = _robust(error.square() * batch["weight"]).mean((1, 2, 3))
    changes = (batch["seen"] * _robust((error - batch["before"]).square() * batch["weight"])).mean((1, 2, 3))
    of_x, of_changes = batch["errors"].flatten(), batch["changes"].flatten()
    # Where light changes in earnest, or there is next to none, it is not the specks that count.
    darker = (taken.mean((1, 2, 3)) / (batch["level"].flatten() + 1e-20)).clamp(-0.05, 0.05).mean()
    # What is nearly free of noise is nothing to learn from.
    return (errors / (of_x + LEAST) + FLICKER * changes / (of_changes + LEAST)).mean() + ENERGY * darker.square()


def as_corrections(model: PlainUNet) -> Corrections:
    @torch.inference_mode()
    def corrections(inputs: np.ndarray) -> np.ndarray:
        height, width = inputs.shape[:2]
        a = model.alignment
        padded = np.pad(inputs, [(0, -height % a), (0, -width % a), (0, 0)], mode="edge")
        made = model(torch.from_numpy(np.moveaxis(padded, -1, 0)[None].copy()))[0]
        return np.moveaxis(made.numpy(), 0, -1)[:height, :width]

    return corrections


def train(
    training: Sequence[Clip],
    rounds: int,
    steps: int,
    *,
    batch: int = 8,
    learning_rate: float = 2e-3,
    seed: int = 0,
    part: int = 120,
    model: PlainUNet | None = None,
    say: Callable[[str], None] = print,
) -> PlainUNet:
    """A network, ``model`` or a new one, after ``rounds`` of ``steps`` each; ``part`` clips are played in a round."""
    torch.manual_seed(seed)
    rng = np.random.default_rng(seed)
    model = model or network()
    optimizer = torch.optim.Adam(model.parameters(), learning_rate, betas=(0.9, 0.99))
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, rounds * steps, learning_rate / 50)
    for number in range(rounds):
        begun = time.perf_counter()
        chosen = rng.choice(len(training), min(part, len(training)), replace=False)
        corrections = as_corrections(model.eval())
        longs = 1 / np.sqrt(rng.choice(LENGTHS, len(chosen)))
        played_clips = [relit(training[i], rng) if rng.random() < RELIT else training[i] for i in chosen]
        frames = [f for c, long in zip(played_clips, longs, strict=True) for f in play(c, corrections, float(long))]
        played = time.perf_counter() - begun
        model.train()
        losses = []
        for _ in range(steps):
            picked = [frames[i] for i in rng.integers(len(frames), size=batch)]
            # Motion is in the arrays no more: they may be turned as they are.
            turns = [(bool(rng.integers(2)), bool(rng.integers(2)), bool(rng.integers(2))) for _ in picked]
            inputs = {
                name: torch.from_numpy(
                    np.stack([_turned(frame[name], *turn) for frame, turn in zip(picked, turns, strict=True)])
                )
                for name in picked[0]
            }
            optimizer.zero_grad()
            value = loss(model, inputs)
            value.backward()
            torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
            optimizer.step()
            schedule.step()
            losses.append(value.item())
        say(
            f"round {number + 1} of {rounds}: {len(frames)} frames in {played:.0f} s, loss {np.mean(losses[:50]):.4f} "
            f"to {np.mean(losses[-50:]):.4f}, {time.perf_counter() - begun:.0f} s"
        )
    return model.eval()


def _turned(layer: np.ndarray, across: bool, down: bool, transposed: bool) -> np.ndarray:
    layer = layer[:, ::-1] if down else layer
    layer = layer[..., ::-1] if across else layer
    return np.ascontiguousarray(layer.transpose(0, 2, 1) if transposed else layer)


def scores(held_out: Sequence[Clip], corrections: Corrections | None) -> np.ndarray:
    """(clips, 2): error and flicker over those frame by frame."""
    found = []
    for clip in held_out:
        temporal = Temporal(corrections)
        images = [temporal.next(*pair) for pair in zip(clip.stacks, clip.results, strict=True)]
        found.append(np.divide(errors(clip, images), errors(clip, clip.results)))
    return np.array(found)


def summary(ratios: np.ndarray) -> str:
    good = ratios[np.isfinite(ratios).all(axis=1) & (ratios > 0).all(axis=1)]
    return ", ".join(f"{np.exp(np.log(good[:, i]).mean()):.3f}" for i in range(2))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", nargs="+", help="training sets of shots")
    parser.add_argument("--out", type=Path, required=True, help="file of weights, .safetensors")
    parser.add_argument("--methods", nargs="*", default=["ngpt-fast", "ngpt-combine", "oidn", "wcv"], choices=METHODS)
    parser.add_argument("--validation", nargs="*", default=["made-00000", "bathroom"], help="beginnings of scenes")
    parser.add_argument("--rounds", type=int, default=6)
    parser.add_argument("--steps", type=int, default=400, help="of a round")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--initial", type=Path, help="weights to go on from")
    parser.add_argument("--cache", type=Path, help="folder for results frame by frame")
    args = parser.parse_args()
    if args.cache:
        args.cache.mkdir(parents=True, exist_ok=True)
    begun = time.perf_counter()
    every = list(clips(args.data, args.methods, args.cache))
    held_out = [clip for clip in every if clip.scene.startswith(tuple(args.validation))]
    training = [clip for clip in every if not clip.scene.startswith(tuple(args.validation))]
    if not training:
        raise NgptError(
            f"{', '.join(args.data)}: no shots to learn from; make them with: ngpt dataset --config data-shots"
        )
    print(f"{len(training)} clips to learn from, {len(held_out)} to judge by, {time.perf_counter() - begun:.0f} s")
    print("rules: error and flicker over those frame by frame", summary(scores(held_out, None)), flush=True)
    model = network()
    if args.initial:
        fill(model, read_tensors(args.initial)[0], str(args.initial))
    model = train(training, args.rounds, args.steps, seed=args.seed, model=model)
    ratios = scores(held_out, as_corrections(model))
    print("network:", summary(ratios))
    told = {"version": __version__, "torch": torch.__version__, "hours": (time.perf_counter() - begun) / 3600}
    told |= {"shots": len(training), "methods": args.methods, "rounds": args.rounds, "steps": args.steps}
    header = {"kind": "temporal", "inputs": list(INPUTS), "widths": list(WIDTHS), "training": told}
    write_tensors(args.out, model.state_dict(), header, overwrite=True)


if __name__ == "__main__":
    main()
