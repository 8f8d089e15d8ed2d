"""Non-finite pixels: repaired from their neighbours, and their gradients trusted no more."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.ndimage import uniform_filter

from ngpt.errors import NgptError
from ngpt.stack import GradientStack

# Sides of the blocks from which the insides of holes are filled: powers of it. Tiles of networks begin at multiples.
BLOCK = 8


@dataclass(frozen=True)
class Repaired:
    """What reconstruction works on.

    ``image``    (H, W, 3) primal without direct emission, finite
    ``direct``   (H, W, 3) direct emission, finite, to be added back
    ``dx, dy``   (H, W, 3) gradients, finite (0 where they are not trusted), None where the stack has none
    ``trusted``  for dx and dy, (H, W) booleans, None if all of them are
    ``variances``  of image, dx and dy, (H, W, 3), NaN where not known; None where the stack lacks a layer of them
    ``noise``    the variance of image alone, (H, W, 3), NaN where not known; None where the stack lacks it
    ``pixels``   number of pixels whose primal was replaced
    ``gradients``  number of differences left out
    ``features``  albedo, normal and depth, those the stack holds, with 0 where they are not finite
    """

    image: np.ndarray
    direct: np.ndarray
    dx: Any
    dy: Any
    trusted: tuple[np.ndarray, np.ndarray] | None
    variances: Any
    pixels: int
    gradients: int
    features: dict[str, np.ndarray] = field(default_factory=dict)
    noise: np.ndarray | None = None

    def known_variances(self) -> dict[str, np.ndarray]:
        """Those of image, dx and dy that the stack holds, by the names of its layers; see ``variances``."""
        if self.variances is not None:
            return dict(zip(("primal_var", "dx_var", "dy_var"), self.variances, strict=True))
        return {} if self.noise is None else {"primal_var": self.noise}


def repair(stack: GradientStack) -> Repaired:
    """Separates direct emission, replaces non-finite pixels and finds the gradients that cannot be trusted.

    A difference is not trusted if it is not finite itself or one of its two pixels was not. Raises NgptError when the
    primal has no finite pixel at all.
    """
    primal = stack["primal"]
    direct = stack["direct"] if "direct" in stack else np.zeros_like(primal)
    good = _finite_pixels(primal) & _finite_pixels(direct)
    if not good.any():
        raise NgptError(f"{stack.path}: layer 'primal' has no finite pixel among {good.size}; render it again")
    # Copies only of what changes: layers of large images are large.
    if good.all():
        image = primal - direct if direct.any() else primal
    else:
        image, direct = _from_neighbours(primal, direct, good), np.where(good[..., None], direct, 0)
    features = {name: _finite(stack[name]) for name in ("albedo", "normal", "depth") if name in stack}
    # Where the camera sees an emitter, the primal's variance is that of primal and direct emission together.
    known = good & ~direct.any(axis=-1) if direct.any() else good
    noise = _where(known, stack["primal_var"]) if "primal_var" in stack else None
    if "dx" not in stack or "dy" not in stack:
        return Repaired(image, direct, None, None, None, None, int(np.sum(~good)), 0, features, noise)
    gradients, trusted = [], []
    for name, axis in (("dx", 1), ("dy", 0)):
        both = good.copy()
        here, there = (np.s_[:, :-1], np.s_[:, 1:]) if axis == 1 else (np.s_[:-1], np.s_[1:])
        both[here] &= good[there]
        both &= _finite_pixels(stack[name])
        border = np.s_[:, -1] if axis == 1 else np.s_[-1]
        both[border] = True  # no difference there, so nothing to mistrust
        layer = stack[name]
        if not both.all() or layer[border].any():
            layer = np.where(both[..., None], layer, 0)
            layer[border] = 0
        gradients.append(layer)
        trusted.append(both)
    lost = int(sum(np.sum(~t) for t in trusted))
    flags = (trusted[0], trusted[1]) if lost else None
    variances = None
    if noise is not None and "dx_var" in stack and "dy_var" in stack:
        variances = (noise, _where(trusted[0], stack["dx_var"]), _where(trusted[1], stack["dy_var"]))
    dx, dy = gradients
    return Repaired(image, direct, dx, dy, flags, variances, int(np.sum(~good)), lost, features, noise)


def _finite_pixels(layer: np.ndarray) -> np.ndarray:
    """Where all channels of (H, W, C) are finite; at once if all are, since short last axes are slow to look along."""
    good = np.isfinite(layer)
    return np.ones(layer.shape[:2], bool) if good.all() else good.all(axis=-1)


def _finite(layer: np.ndarray) -> np.ndarray:
    good = np.isfinite(layer)
    return layer if good.all() else np.where(good, layer, np.float32(0))


def _where(flags: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """The variance where ``flags`` hold, NaN elsewhere."""
    return variance if flags.all() else np.where(flags[..., None], variance, np.float32(np.nan))


def _from_neighbours(primal: np.ndarray, direct: np.ndarray, good: np.ndarray) -> np.ndarray:
    """primal - direct, with pixels that are not good replaced.

    By the mean of the good ones among their eight neighbours, or where there is none, in the inside of a larger hole,
    by the mean of those in the smallest block that has any: of 8x8 pixels, 64x64 and so on.
    """
    image = np.subtract(primal, direct, where=good[..., None], out=np.zeros_like(primal))
    weight = uniform_filter(good.astype(np.float64), 3, mode="constant")
    mean = uniform_filter(image.astype(np.float64), (3, 3, 1), mode="constant")
    near = ~good & (weight > 1e-6)
    image[near] = mean[near] / weight[near, None]
    far = ~good & ~near
    if far.any():
        there = np.where(good[..., None], image, 0).astype(np.float64)
        image[far] = _from_blocks(there, good[..., None].astype(np.float64))[far]
    return image


def _from_blocks(total: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Sums (H, W, 3) over counts (H, W, 1); where nothing was counted, those of the smallest block that has any."""
    mean = total / np.maximum(count, 1)
    if count.all() or count.size == 1:
        return mean
    coarse = _from_blocks(_block_sums(total), _block_sums(count))
    spread = coarse.repeat(BLOCK, axis=0).repeat(BLOCK, axis=1)[: len(total), : total.shape[1]]
    return np.where(count > 0, mean, spread)


def _block_sums(values: np.ndarray) -> np.ndarray:
    rows, columns = (np.arange(0, length, BLOCK) for length in values.shape[:2])
    return np.add.reduceat(np.add.reduceat(values, rows, axis=0), columns, axis=1)
