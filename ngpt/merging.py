"""Merges independent stacks of one image into a stack that has the samples and the pixels of all of them.

With n_i samples per pixel, means m_i and variances of the mean v_i, the stack of all N = Σ n_i samples has

    mean       m = Σ n_i m_i / N
    variance   Σ [n_i (n_i - 1) v_i + n_i (m_i - m)²] / (N (N - 1))

[Chan, Golub, LeVeque 1983, "Algorithms for computing the sample variance", eq. 2.1]

The expectation of this variance is the variance of m for any weights n_i that do not depend on the samples. So the
formula also holds for differences. Their two pixels may have different numbers of samples, and n_i is the harmonic mean
of these numbers.

Stacks in different places of one picture are tiles. A tile counts only in its own pixels.
"""

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, reduce
from typing import Any

import numpy as np

from ngpt.errors import NgptError
from ngpt.io.exr import pass_through, with_channels
from ngpt.layers import DIFFERENCES, FEATURE_NOISE, GATHERED
from ngpt.shared import CUT, TAILS, shared_variance
from ngpt.stack import GradientStack
from ngpt.subpixels import SUBPIXELS, means, spread, stored, subpixels, within
from ngpt.windows import Place, Window

_LOG = logging.getLogger(__name__)

# Layers -> the layers that hold their variances
VARIANCES = {name: f"{name}_var" for name in ("primal", "dx", "dy", "caustic", "diffuse", "specular", "dt")}
# The prefix of further channels that are means over samples
DIAGNOSTICS = "diagnostics."
# Attribute: why a render ended before its request was complete, "interrupted" or "failed"
UNFINISHED = "ngpt:unfinished"
# Attribute: the request of the render as JSON (``data_gen.request``); merged stacks have none
REQUEST = "ngpt:request"
# Attribute: the sampler's options that are not defaults, separated by commas
OPTIONS = "ngpt:samplerOptions"
# Values of the sampler's option ``tails``. Shared: after its first steps, a path takes light from a cache that all
# paths share. Paths, the default: each path finds all of its light itself.
SHARED_TAILS, WHOLE_PATHS = "tails=shared", "tails=paths"
# The limit for samples of a pixel: headers count them in 32 bits.
_MOST = 2.0**31


def merge(stacks: Sequence[GradientStack]) -> GradientStack:
    """Merges stacks of the same scene, camera and sampler, with different seeds or in different places.

    Means are weighted by ``ngpt:spp``, or by the layer ``samples`` if a stack has it. Means of differences are weighted
    by the harmonic mean of both pixels' numbers of samples. The merged ``samples`` are sums, and are left out if all
    pixels have the same number. ``diagnostics.*`` channels are averaged like layers. Subpixels (K x K for each pixel)
    are averaged too if all stacks have the same K; otherwise they are left out with a warning. A pixel without any
    finite sample is NaN. A stack with one sample per pixel needs no variances.

    The result of stacks with n1 and n2 samples equals a stack of n1 + n2 samples up to rounding, with two exceptions.
    First, variances of dx and dy combine two independent directions, which a stack no longer separates. So a merged
    variance has the same expectation, but differs by about 1 / N of its value. Second, the layer ``shared`` is a sample
    of the noise that pixels share. It is averaged like the primal, because samples of independent noise add like the
    noise itself; for a stack without this layer, it counts as zero. ``primal_var`` includes the variance that is
    estimated from the merged ``shared``. This variance has the same expectation as the one that follows from the parts.

    Tiles (``GradientStack.place``) must fill the smallest rectangle that holds them all. Tiles that overlap must have
    different seeds. The difference between a tile's last column or row and the pixel beyond was not sampled. If no
    other tile has that difference, it is NaN, and a reconstruction leaves it out.

    The result's ``ngpt:seed`` lists all seeds. ``ngpt:spp`` and ``ngpt:tailsCut`` are means; ``ngpt:seconds`` and
    ``ngpt:discarded`` are sums. ``ngpt:samplerOptions`` and ``ngpt:tails`` have the entries of all stacks;
    ``tails=paths`` is added if only some stacks have ``tails=shared``. ``ngpt:gathered`` is 1 if any stack has it.
    ``ngpt:featureNoise`` is the noise of the merged features if all stacks have it. ``ngpt:unfinished`` and
    ``ngpt:request`` are left out. All other attributes come from the first stack.

    Raises NgptError for fewer than two stacks, stacks that differ in layers, sampler or size of the picture, tiles that
    leave pixels out, a seed that occurs twice in one place, missing ``ngpt:spp`` or ``ngpt:seed``, ``samples`` that are
    negative or not finite, ``ngpt:seconds``, ``ngpt:discarded``, ``ngpt:featureNoise`` or ``ngpt:tailsCut`` that are no
    numbers, results of a reconstruction, and channels of unknown meaning.
    """
    if len(stacks) < 2:
        raise NgptError(f"merging needs at least two stacks, and got {len(stacks)}")
    spp = [_samples(stack) for stack in stacks]
    _check(stacks, spp)
    canvas = reduce(Window.around, (stack.place.data for stack in stacks))
    tiles = [_Tile(stack, n, canvas) for stack, n in zip(stacks, spp, strict=True)]
    if hole := _hole(tiles, canvas):
        have = ", ".join(f"{tile.stack.path} {tile.stack.place.data}" for tile in tiles)
        raise NgptError(f"no stack has all pixels of {hole}: {have}; render those too")
    total = _summed(tiles, lambda tile: tile.counts)
    layers = {}
    for name in stacks[0].names:
        if name not in (*VARIANCES.values(), "samples", "shared"):
            layers[name] = _mean(tiles, {tile: tile.stack[name] for tile in tiles}, name)
    fine = _subpixels(tiles)
    k = subpixels(fine, canvas.width)
    layers |= {name: means(layer, k) for name, layer in fine.items()}
    if any("shared" in stack for stack in stacks):
        layers["shared"] = _mean(tiles, {tile: _shared(tile.stack) for tile in tiles})
    for name, variance in VARIANCES.items():
        if name in layers and all(variance in tile.stack or tile.spp == 1 for tile in tiles):
            layers[variance] = _variance(tiles, name, variance)
    if "shared" in layers and "primal_var" in layers:
        # The part of the variance that comes from noise which the pixels of a tile share
        of_shared = _summed(tiles, lambda tile: np.square(tile.counts) * shared_variance(_shared(tile.stack)))
        own = np.maximum(layers["primal_var"] - of_shared / np.square(np.maximum(total, 1)), 0)
        layers["primal_var"] = own + shared_variance(layers["shared"])
    if np.ptp(total):
        layers["samples"] = total
    seeds = dict.fromkeys(seed for stack in stacks for seed in _seeds(stack))
    of_parts = (UNFINISHED, REQUEST, SUBPIXELS)
    attributes = {name: value for name, value in stacks[0].attributes.items() if name not in of_parts} | {
        "ngpt:spp": max(1, round(float(total.mean()))),
        "ngpt:seed": " ".join(seeds),
    }
    attributes |= {SUBPIXELS: k} if fine else {}
    attributes |= _options(stacks) | _tails(stacks, spp)
    for name in ("ngpt:seconds", "ngpt:discarded"):
        if all(name in stack.attributes for stack in stacks):
            attributes[name] = sum(_number(stack, name) for stack in stacks)
    if any(stack.number(GATHERED) for stack in stacks):
        attributes[GATHERED] = 1  # the light of photons is in the mean, whichever stack it comes from
    attributes.pop(FEATURE_NOISE, None)
    if all(FEATURE_NOISE in stack.attributes for stack in stacks):
        noise = _summed(tiles, lambda tile: np.square(tile.counts) * float(_number(tile.stack, FEATURE_NOISE)))
        attributes[FEATURE_NOISE] = float((noise / np.square(np.maximum(total, 1))).mean())
    place = Place(canvas, stacks[0].place.display)
    layers = {name: layer.astype(np.float32) for name, layer in layers.items()}
    merged = GradientStack(layers, attributes, place=place, fine=fine)
    further = {tile: pass_through(tile.stack) for tile in tiles}
    names = further[tiles[0]]
    if not names:
        return merged
    return with_channels(merged, {name: _mean(tiles, {tile: further[tile][name] for tile in tiles}) for name in names})


@dataclass(frozen=True, eq=False)
class _Tile:
    """A stack of ``spp`` samples per pixel. The ``canvas`` is the rectangle around all stacks."""

    stack: GradientStack
    spp: int
    canvas: Window

    @property
    def part(self) -> tuple[slice, slice]:
        """The tile's rows and columns in the canvas."""
        return self.stack.place.data.within(self.canvas)

    @cached_property
    def counts(self) -> np.ndarray:
        """Samples of each pixel, (H, W, 1) double precision."""
        return _counts(self.stack, self.spp)

    def weights(self, name: str) -> np.ndarray:
        """The weights (H, W, 1) of a layer in means: the counts of samples. For differences, they are the harmonic mean
        of the counts of both pixels, or 0 if the second pixel is outside the tile but inside the canvas."""
        if name not in DIFFERENCES:
            return self.counts
        x, y, _ = DIFFERENCES[name]
        n, weight = self.counts, self.counts.copy()
        height, width = n.shape[0] - y, n.shape[1] - x
        here, there = n[:height, :width], n[y:, x:]
        weight[:height, :width] = 2 * here * there / np.maximum(here + there, 1)
        rows, columns = self.part
        if rows.stop < self.canvas.height:
            weight[height:] = 0
        if columns.stop < self.canvas.width:
            weight[:, width:] = 0
        return weight


def _counts(stack: GradientStack, spp: int) -> np.ndarray:
    """Samples of each pixel, (H, W, 1) double precision. Raises NgptError if the layer ``samples`` makes no sense."""
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


def _summed(tiles: Sequence[_Tile], values: Callable[[_Tile], np.ndarray]) -> np.ndarray:
    """Adds up the ``values`` (h, w, C) of all tiles in each pixel of the canvas, and returns the sums (H, W, C)."""
    parts = [values(tile) for tile in tiles]
    total = np.zeros((tiles[0].canvas.height, tiles[0].canvas.width, parts[0].shape[2]))
    for tile, part in zip(tiles, parts, strict=True):
        total[tile.part] += part
    return total


def _mean(tiles: Sequence[_Tile], values: Mapping[_Tile, np.ndarray], name: str = "", k: int = 1) -> np.ndarray:
    """Returns the mean of the tiles' ``values`` on the whole canvas, in double precision.

    The values are layers (h, w, C) or channels (h, w), which have K x K values for each pixel. NaNs do not count. The
    weights are those of the layer ``name``.
    """
    canvas = tiles[0].canvas
    total = np.zeros((k * canvas.height, k * canvas.width, *values[tiles[0]].shape[2:]))
    weight = np.zeros(total.shape)
    for tile in tiles:
        layer, n, part = values[tile], spread(tile.weights(name), k), within(tile.part, k)
        w = (n if layer.ndim == 3 else n[..., 0]) * ~np.isnan(layer)
        # Infinite values with weight 0 are left out, because their products are NaN.
        total[part] += np.where(w > 0, w * layer.astype(np.float64), 0)
        weight[part] += w
    with np.errstate(invalid="ignore", divide="ignore"):
        return total / weight


def _subpixels(tiles: Sequence[_Tile]) -> dict[str, np.ndarray]:
    """The subpixels on the whole canvas; none, with a warning, if the stacks have different numbers of them."""
    each = {tile.stack.path: subpixels(tile.stack.fine, tile.stack.width) for tile in tiles}
    ks = {*each.values()}
    if ks == {1}:
        return {}
    names = [name for name in tiles[0].stack.fine if all(name in tile.stack.fine for tile in tiles)]
    if len(ks) > 1 or "primal" not in names:
        numbers = ", ".join(f"{path} has {f'{k}x{k}' if k > 1 else 'none'}" for path, k in each.items())
        _LOG.warning("the subpixels are left out, since not all stacks have the same: %s", numbers)
        return {}
    k = ks.pop()
    return {name: stored(name, _mean(tiles, {tile: tile.stack.fine[name] for tile in tiles}, k=k)) for name in names}


def _shared(stack: GradientStack) -> np.ndarray:
    """The layer ``shared``, (h, w, 3); zeros if the stack has none."""
    return stack["shared"] if "shared" in stack else np.zeros((stack.height, stack.width, 3))


def _options(stacks: Sequence[GradientStack]) -> dict[str, str]:
    """The attribute with the options of all stacks; none if all options are defaults."""
    # An option of one stack counts for the merged stack too: shared tails, for example, bias it.
    each = [[option for option in str(stack.attributes.get(OPTIONS, "")).split(", ") if option] for stack in stacks]
    options = dict.fromkeys(option for part in each for option in part)
    if SHARED_TAILS in options and not all(SHARED_TAILS in part for part in each):
        options[WHOLE_PATHS] = None
    return {OPTIONS: ", ".join(options)} if options else {}


def _tails(stacks: Sequence[GradientStack], spp: Sequence[int]) -> dict[str, Any]:
    """The attributes about the cache of shared tails, if any stack has them."""
    found: dict[str, Any] = {}
    # The text of a merged stack may hold several sentences. Each sentence is kept once.
    each = (str(stack.attributes.get(TAILS, "")).split("; ") for stack in stacks)
    if sentences := dict.fromkeys(sentence for part in each for sentence in part if sentence):
        found[TAILS] = "; ".join(sentences)
    if any(CUT in stack.attributes for stack in stacks):
        cut = [_number(stack, CUT) if CUT in stack.attributes else 0.0 for stack in stacks]
        found[CUT] = float(np.average(cut, weights=spp))
    return found


def _varies(stack: GradientStack, name: str) -> np.ndarray:
    """The values whose variance the stack holds, in double precision: for the primal, its light outside ``caustic``."""
    values = stack[name].astype(np.float64)
    if name == "primal" and "caustic" in stack:
        with np.errstate(invalid="ignore"):
            values -= stack["caustic"]
    return values


def _variance(tiles: Sequence[_Tile], name: str, variance: str) -> np.ndarray:
    """The variance of the merged mean of a layer, on the whole canvas."""
    means = {tile: _varies(tile.stack, name) for tile in tiles}
    mean = _mean(tiles, means, name)
    squares, total = np.zeros(mean.shape), np.zeros(mean.shape)
    with np.errstate(invalid="ignore", divide="ignore"):
        for tile in tiles:
            values, n, stack = means[tile], tile.weights(name), tile.stack
            there = ~np.isnan(values) & (n > 0)
            within = np.where(n > 1, n * (n - 1) * stack[variance], 0) if variance in stack else 0.0
            squares[tile.part] += np.where(there, within + n * (values - mean[tile.part]) ** 2, 0)
            total[tile.part] += n * there
        return np.where(total > 1, squares / (total * (total - 1)), np.nan)


def _hole(tiles: Sequence[_Tile], canvas: Window) -> Window | None:
    """The rectangle around the pixels that no tile has; None if the tiles fill the canvas."""
    # Tiles may be so far apart that the space between them does not fit into memory.
    if canvas.width * canvas.height > 4 * sum(tile.stack.width * tile.stack.height for tile in tiles):
        return canvas
    empty = np.ones((canvas.height, canvas.width), bool)
    for tile in tiles:
        empty[tile.part] = False
    if not empty.any():
        return None
    rows, columns = (np.flatnonzero(empty.any(axis=axis)) for axis in (1, 0))
    left, top = canvas.left + int(columns[0]), canvas.top + int(rows[0])
    return Window(left, top, int(np.ptp(columns)) + 1, int(np.ptp(rows)) + 1)


def _check(stacks: Sequence[GradientStack], counts: Sequence[int]) -> None:
    """Raises NgptError for stacks that cannot be merged; ``counts`` are their samples per pixel."""
    first = stacks[0]
    seen: dict[str, list[GradientStack]] = {}
    for stack, n in zip(stacks, counts, strict=True):
        if stack.place.display != first.place.display:
            places = f"{stack.path} is {stack.place} but {first.path} is {first.place}"
            raise NgptError(f"{places}; merge seeds or tiles of one image")
        # Attributes are compared as text, because files of other programs may hold anything under our names.
        ours, theirs = (str(s.attributes.get("ngpt:sampler")) for s in (stack, first))
        if ours != theirs:
            made = f"{stack.path} was made by sampler '{ours}' and {first.path} by '{theirs}'"
            raise NgptError(f"{made}; their variances cannot be merged: name one with --sampler")
        for name in (_means(stack) ^ _means(first)) - {"shared"}:
            has, lacks = (stack, first) if name in _means(stack) else (first, stack)
            raise NgptError(f"{has.path} has '{name}' and {lacks.path} has not; merge stacks with the same layers")
        ours, theirs = (str(s.attributes.get("ngpt:frame")) for s in (stack, first))
        if ours != theirs:
            raise NgptError(f"{stack.path} is frame {ours} and {first.path} frame {theirs}; merge stacks of one frame")
        for mean, name in VARIANCES.items():
            if n > 1 and mean in stack and name not in stack and any(name in other for other in stacks):
                raise NgptError(f"{stack.path} has no '{name}' though it has {n} samples per pixel; render it again")
        for seed in _seeds(stack):
            for other in seen.setdefault(seed, []):
                if stack.place.data.common(other.place.data):
                    raise NgptError(
                        f"{stack.path} and {other.path} were both rendered with seed {seed}, so they hold the "
                        "same samples; render one of them with another --seed"
                    )
            seen[seed].append(stack)
    for stack in stacks:
        strange = next((name for name in pass_through(stack) if not name.startswith(DIAGNOSTICS)), None)
        if strange is not None:
            raise NgptError(
                f"{stack.path}: channel '{strange}' has no mean; merge renders before they are reconstructed"
            )


def _means(stack: GradientStack) -> set[str]:
    """The names of layers and diagnostics that are averaged over samples."""
    return {*stack.names, *pass_through(stack)} - {*VARIANCES.values(), "samples"}


def _samples(stack: GradientStack) -> int:
    """The attribute ``ngpt:spp``. Raises NgptError if it is missing or not a positive whole number."""
    spp = stack.attributes.get("ngpt:spp")
    if not isinstance(spp, int | np.integer) or spp < 1:
        what = "has no attribute 'ngpt:spp'" if spp is None else f"attribute 'ngpt:spp' is {spp!r}"
        raise NgptError(f"{stack.path}: {what}, so its weight is not known; render it with ngpt")
    return int(spp)


def _number(stack: GradientStack, name: str) -> Any:
    """An attribute, int or float. Raises NgptError if it is negative or not a finite number."""
    given, value = stack.attributes[name], stack.number(name)
    if value is None or value < 0:
        raise NgptError(f"{stack.path}: attribute '{name}' is {given!r}, and no number that can be merged; remove it")
    return given


def _seeds(stack: GradientStack) -> list[str]:
    seed = str(stack.attributes.get("ngpt:seed", "")).split()
    if not seed:
        raise NgptError(
            f"{stack.path}: has no attribute 'ngpt:seed', so its samples might be those of another; render it with ngpt"
        )
    return seed
