"""Merging of independent stacks of one scene: more samples, without rendering them together.

With n_i samples per pixel, means m_i and variances of the mean v_i, the stack of all N = Σ n_i samples has

    mean       m = Σ n_i m_i / N
    variance   Σ [n_i (n_i - 1) v_i + n_i (m_i - m)²] / (N (N - 1))

[Chan, Golub, LeVeque 1983, "Algorithms for computing the sample variance", eq. 2.1]

Its expectation is the variance of m for any weights n_i that no sample has a say in, whatever the v_i: so it holds for
differences too, whose two directions may have samples in different numbers.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ngpt.errors import NgptError
from ngpt.io.exr import pass_through, with_channels
from ngpt.layers import DIFFERENCES
from ngpt.stack import GradientStack

# Layers with a variance, and the layers that hold it.
VARIANCES = {name: f"{name}_var" for name in ("primal", "dx", "dy", "caustic", "diffuse", "specular", "dt")}
# Channels beside the layers that are means over samples too.
DIAGNOSTICS = "diagnostics."
# Attribute: what broke a render off before all that was asked for was done, "interrupted" or "failed"
UNFINISHED = "ngpt:unfinished"
# Samples of a pixel, of which headers count as many in 32 bits
_MOST = 2.0**31


def merge(stacks: Sequence[GradientStack]) -> GradientStack:
    """The stack of all samples of ``stacks``: same scene, camera and sampler, different seeds.

    Means are weighted by ``ngpt:spp``, or by the layer ``samples`` where a stack has it: one of differences by the
    harmonic mean of the samples of both its pixels, as their variances would be. The merged ``samples`` are sums, and
    are left out where all pixels have the same number. Variances of the mean come from the pooled sums, so merged
    stacks of n1 and n2 samples equal the stack of n1 + n2 up to the rounding of float32. There are two exceptions.
    Variances of dx and dy are those of two independent directions, which a stack no longer tells apart: their merged
    value has the same expectation, and differs by about 1 / N of itself. And samples that were not finite are missing
    in their pixel alone, which then counts with the full weight of its stack; a pixel that lost all of them is NaN and
    counts nothing.

    A stack with one sample per pixel has no variances and needs none, since its sum of squared deviations is zero: two
    of them merged have variances. ``diagnostics.*`` channels are averaged as layers are.

    The result's ``ngpt:seed`` lists all seeds, ``ngpt:spp``, ``ngpt:seconds`` and ``ngpt:discarded`` are sums,
    ``ngpt:unfinished`` is left out, and all other attributes are those of the first stack. Raises NgptError for fewer
    than two stacks, stacks that differ in size, layers or sampler, a seed that occurs twice, missing ``ngpt:spp`` or
    ``ngpt:seed``, ``samples`` that are negative or not finite, ``ngpt:seconds`` or ``ngpt:discarded`` that are no
    numbers, results of a reconstruction, and channels of unknown meaning.
    """
    if len(stacks) < 2:
        raise NgptError(f"merging needs at least two stacks, and got {len(stacks)}")
    spp = [_samples(stack) for stack in stacks]
    _check(stacks, spp)
    counts = [_counts(stack, n) for stack, n in zip(stacks, spp, strict=True)]
    total = np.sum(counts, axis=0)
    layers = {}
    for name in stacks[0].names:
        if name not in (*VARIANCES.values(), "samples"):
            layers[name] = _mean([stack[name] for stack in stacks], _of_layer(counts, name))
    for name, variance in VARIANCES.items():
        known = all(variance in stack or n == 1 for stack, n in zip(stacks, spp, strict=True))
        if name in layers and known:
            means = [_varies(stack, name) for stack in stacks]
            layers[variance] = _variance(means, stacks, _of_layer(counts, name), variance)
    if np.ptp(total):
        layers["samples"] = total
    attributes = dict(stacks[0].attributes) | {
        "ngpt:spp": max(1, round(float(total.mean()))),
        "ngpt:seed": " ".join(seed for stack in stacks for seed in _seeds(stack)),
    }
    attributes.pop(UNFINISHED, None)
    for name in ("ngpt:seconds", "ngpt:discarded"):
        if all(name in stack.attributes for stack in stacks):
            attributes[name] = sum(_number(stack, name) for stack in stacks)
    merged = GradientStack({name: layer.astype(np.float32) for name, layer in layers.items()}, attributes)
    further = [pass_through(stack) for stack in stacks]
    if not further[0]:
        return merged
    return with_channels(merged, {name: _mean([channels[name] for channels in further], counts) for name in further[0]})


def _counts(stack: GradientStack, spp: int) -> np.ndarray:
    """Samples of each pixel, (H, W, 1) double precision."""
    if "samples" in stack:
        counts = stack["samples"].astype(np.float64)
        wrong = ~((counts >= 0) & (counts < _MOST))
        if wrong.any():
            y, x, _ = np.argwhere(wrong)[0]
            raise NgptError(
                f"{stack.path}: layer 'samples' has {counts[y, x, 0]:g} at pixel ({x}, {y}), and {int(wrong.sum())} of "
                f"{wrong.size} pixels are no number of samples; render it again"
            )
        if not counts.any():
            raise NgptError(f"{stack.path}: layer 'samples' is 0 in all pixels; there is nothing to merge")
        return counts
    return np.full((stack.height, stack.width, 1), float(spp))


def _of_layer(counts: Sequence[np.ndarray], name: str) -> Sequence[np.ndarray]:
    """What the mean of a layer is weighted by: of a difference the harmonic mean of both its pixels' counts."""
    if name not in DIFFERENCES:
        return counts
    x, y, _ = DIFFERENCES[name]
    weights = [n.copy() for n in counts]
    for weight, n in zip(weights, counts, strict=True):
        here, there = n[: n.shape[0] - y, : n.shape[1] - x], n[y:, x:]
        weight[: n.shape[0] - y, : n.shape[1] - x] = 2 * here * there / np.maximum(here + there, 1)
    return weights


def _like(counts: np.ndarray, layer: np.ndarray) -> np.ndarray:
    """Counts (H, W, 1) for a layer (H, W, C), or a channel (H, W)."""
    return counts if layer.ndim == 3 else counts[..., 0]


def _mean(layers: Sequence[np.ndarray], counts: Sequence[np.ndarray]) -> np.ndarray:
    """Mean weighted by ``counts``, over the values that are not NaN; in double precision."""
    weights = [_like(n, layer) * ~np.isnan(layer) for layer, n in zip(layers, counts, strict=True)]
    # Products of infinite values and zero weights are left out, not added.
    total = sum(np.where(w > 0, w * layer.astype(np.float64), 0) for w, layer in zip(weights, layers, strict=True))
    with np.errstate(invalid="ignore", divide="ignore"):
        return total / sum(weights)


def _varies(stack: GradientStack, name: str) -> np.ndarray:
    """What the variance of a layer is of: of the primal what is not in ``caustic``; in double precision."""
    values = stack[name].astype(np.float64)
    if name == "primal" and "caustic" in stack:
        with np.errstate(invalid="ignore"):
            values -= stack["caustic"]
    return values


def _variance(
    means: Sequence[np.ndarray], stacks: Sequence[GradientStack], counts: Sequence[np.ndarray], variance: str
) -> np.ndarray:
    mean = _mean(means, counts)
    squares, total = np.zeros(mean.shape), np.zeros(mean.shape)
    with np.errstate(invalid="ignore", divide="ignore"):
        for values, stack, n in zip(means, stacks, counts, strict=True):
            there = ~np.isnan(values)
            within = np.where(n > 1, n * (n - 1) * stack[variance], 0) if variance in stack else 0.0
            squares += np.where(there, within + n * (values - mean) ** 2, 0)
            total += n * there
        return np.where(total > 1, squares / (total * (total - 1)), np.nan)


def _check(stacks: Sequence[GradientStack], counts: Sequence[int]) -> None:
    first = stacks[0]
    seen: dict[str, str] = {}
    for stack, n in zip(stacks, counts, strict=True):
        if (stack.width, stack.height) != (first.width, first.height):
            raise NgptError(
                f"{stack.path} is {stack.width}x{stack.height} but {first.path} is {first.width}x{first.height}; only "
                "stacks of one size can be merged"
            )
        for name in _means(stack) ^ _means(first):
            has, lacks = (stack, first) if name in _means(stack) else (first, stack)
            raise NgptError(f"{has.path} has '{name}' and {lacks.path} has not; merge stacks with the same layers")
        # As texts, for files of elsewhere may hold anything under our names.
        ours, theirs = (str(s.attributes.get("ngpt:sampler")) for s in (stack, first))
        if ours != theirs:
            raise NgptError(
                f"{stack.path} was made by sampler '{ours}' and {first.path} by '{theirs}'; their variances cannot be "
                "merged"
            )
        ours, theirs = (str(s.attributes.get("ngpt:frame")) for s in (stack, first))
        if ours != theirs:
            raise NgptError(
                f"{stack.path} is frame {ours} and {first.path} is frame {theirs}; only stacks of one frame can be "
                "merged"
            )
        for name in VARIANCES.values():
            if n > 1 and name not in stack and any(name in other for other in stacks):
                raise NgptError(f"{stack.path} has no '{name}' though it has {n} samples per pixel; render it again")
        for seed in _seeds(stack):
            if seed in seen:
                raise NgptError(
                    f"{stack.path} and {seen[seed]} were both rendered with seed {seed}: the same samples twice are no "
                    "more than once; render one of them with another --seed"
                )
            seen[seed] = stack.path
    for stack in stacks:
        strange = next((name for name in pass_through(stack) if not name.startswith(DIAGNOSTICS)), None)
        if strange is not None:
            raise NgptError(
                f"{stack.path}: channel '{strange}' is no layer that could be averaged; merge stacks as `ngpt render` "
                "writes them, before they are reconstructed"
            )


def _means(stack: GradientStack) -> set[str]:
    """What is averaged over samples: layers and diagnostics."""
    return {*stack.names, *pass_through(stack)} - {*VARIANCES.values(), "samples"}


def _samples(stack: GradientStack) -> int:
    spp = stack.attributes.get("ngpt:spp")
    if not isinstance(spp, int | np.integer) or spp < 1:
        what = "has no attribute 'ngpt:spp'" if spp is None else f"attribute 'ngpt:spp' is {spp!r}"
        raise NgptError(f"{stack.path}: {what}, so its weight is not known; render it with ngpt")
    return int(spp)


def _number(stack: GradientStack, name: str) -> Any:
    """The attribute, whole where it is a whole number."""
    given, value = stack.attributes[name], stack.number(name)
    if value is None or value < 0:
        raise NgptError(f"{stack.path}: attribute '{name}' is {given!r}, and no number that could be summed; remove it")
    return given


def _seeds(stack: GradientStack) -> list[str]:
    seed = str(stack.attributes.get("ngpt:seed", "")).split()
    if not seed:
        raise NgptError(
            f"{stack.path}: has no attribute 'ngpt:seed', so its samples might be those of another; render it with ngpt"
        )
    return seed
