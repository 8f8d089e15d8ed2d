"""Repairs non-finite pixels from their neighbours, and marks their gradients as not trusted."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ngpt.errors import NgptError
from ngpt.layers import FEATURE_NOISE
from ngpt.stack import GradientStack
from ngpt.subpixels import spread, subpixels
from ngpt.system.late import ndimage

# Holes are filled from blocks whose sides are powers of this number. Tiles of networks begin at multiples of it.
BLOCK = 8


@dataclass(frozen=True)
class Repaired:
    """The finite data that a reconstruction reads. Variances are NaN where they are not known.

    ``image``    (H, W, 3) primal without direct emission; for methods that read gradients, also without ``caustic``
    ``direct``   (H, W, 3) direct emission, which is added to the result
    ``dx, dy``   (H, W, 3) gradients, 0 where they are not trusted; None if the stack has none
    ``trusted``  where dx and dy are trusted, (H, W) booleans each; None if all differences are trusted
    ``variances``  the variances of image, dx and dy, (H, W, 3) each; None if the stack lacks one of them
    ``pixels``   number of pixels whose primal was replaced
    ``gradients``  number of differences left out
    ``features``  albedo, normal and depth, if the stack has them; 0 where they are not finite
    ``noise``    the variance of image, (H, W, 3); None if the stack lacks it
    ``caustic``  (H, W, 3) light that gradients exclude, which is denoised separately and added to the result; None if
                 there is none
    ``caustic_var``  the variance of caustic, (H, W, 3); None if the stack lacks it
    ``feature_noise``  the variance of albedo or normal, whichever is larger, averaged over the image; None: not known
    ``empty``    the empty pixels (``ngpt.coverage``), (H, W) booleans; None if the stack has no alpha
    ``fine``     primal, albedo and normal by subpixels (``ngpt.subpixels``), if the stack has them
    ``parts``    diffuse and specular light, and the variances ``diffuse_var`` and ``specular_var``, if the stack has
    them
    ``by_oidn``  OIDN's images of these data (``ngpt.network.inputs.Oidn``); None until a method needs them
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
    caustic: np.ndarray | None = None
    caustic_var: np.ndarray | None = None
    feature_noise: float | None = None
    empty: np.ndarray | None = None
    fine: dict[str, np.ndarray] = field(default_factory=dict)
    parts: dict[str, np.ndarray] = field(default_factory=dict)
    by_oidn: Any = None

    def known_variances(self) -> dict[str, np.ndarray]:
        """The known variances of image, dx and dy, by names of their layers: all three, only primal_var, or none."""
        if self.variances is not None:
            return dict(zip(("primal_var", "dx_var", "dy_var"), self.variances, strict=True))
        return {} if self.noise is None else {"primal_var": self.noise}


def repair(stack: GradientStack, gradients: bool = True) -> Repaired:
    """Separates direct emission, replaces non-finite pixels, and finds the gradients that cannot be trusted.

    ``gradients``  whether ``caustic`` is separated too, as is right for methods that read gradients or leave the light
                   of photons to another method. If False, image and its variance include ``caustic``

    A difference is not trusted if it or one of its two pixels is not finite. Raises NgptError if no pixel of the primal
    is finite.
    """
    primal = stack["primal"]
    direct = stack["direct"] if "direct" in stack else np.zeros_like(primal)
    good = finite_pixels(primal) & finite_pixels(direct)
    caustic = stack["caustic"] if "caustic" in stack and stack["caustic"].any() else None
    if caustic is not None:
        good &= finite_pixels(caustic)
    if not good.any():
        raise NgptError(f"{stack.path}: layer 'primal' has no finite pixel among {good.size}; render it again")
    # Layers may be large, so they are copied only if they change.
    image = primal
    # Inf - Inf may occur here. The result is replaced below.
    with np.errstate(invalid="ignore"):
        if direct.any():
            image = image - direct
        if caustic is not None and gradients:
            image = image - caustic
    if not good.all():
        image, direct = _from_neighbours(image, good), np.where(good[..., None], direct, 0)
        caustic = None if caustic is None else _from_neighbours(caustic, good)
    features = {name: _finite(stack[name]) for name in ("albedo", "normal", "depth") if name in stack}
    # Where the camera sees an emitter, the primal's variance includes that of the direct emission.
    known = good & ~direct.any(axis=-1) if direct.any() else good
    noise = _where(known, variance_of_primal(stack, gradients)) if "primal_var" in stack else None
    feature_noise = stack.number(FEATURE_NOISE)
    apart: dict[str, Any] = {"parts": _parts(stack, good)}
    apart["feature_noise"] = None if feature_noise is None or feature_noise < 0 else feature_noise
    if stack.fine:
        light = image + direct if caustic is None or not gradients else image + direct + caustic
        apart["fine"] = _finite_subpixels(stack, light, features)
    if caustic is not None and gradients:
        variance = _where(good, stack["caustic_var"]) if "caustic_var" in stack else None
        apart |= {"caustic": caustic, "caustic_var": variance}
    if "dx" not in stack or "dy" not in stack:
        return Repaired(image, direct, None, None, None, None, int(np.sum(~good)), 0, features, noise, **apart)
    differences, trusted = [], []
    for name, axis in (("dx", 1), ("dy", 0)):
        both = good.copy()
        here, there = (np.s_[:, :-1], np.s_[:, 1:]) if axis == 1 else (np.s_[:-1], np.s_[1:])
        both[here] &= good[there]
        both &= finite_pixels(stack[name])
        border = np.s_[:, -1] if axis == 1 else np.s_[-1]
        both[border] = True  # there is no difference
        layer = stack[name]
        if not both.all() or layer[border].any():
            layer = np.where(both[..., None], layer, 0)
            layer[border] = 0
        differences.append(layer)
        trusted.append(both)
    lost = int(sum(np.sum(~t) for t in trusted))
    flags = (trusted[0], trusted[1]) if lost else None
    variances = None
    if noise is not None and "dx_var" in stack and "dy_var" in stack:
        variances = (noise, _where(trusted[0], stack["dx_var"]), _where(trusted[1], stack["dy_var"]))
    dx, dy = differences
    return Repaired(image, direct, dx, dy, flags, variances, int(np.sum(~good)), lost, features, noise, **apart)


def _parts(stack: GradientStack, good: np.ndarray) -> dict[str, np.ndarray]:
    """Returns ``Repaired.parts``. Pixels that are not ``good`` or not finite in a part are filled from neighbours."""
    held = [name for name in ("diffuse", "specular") if name in stack]
    for name in held:
        good = good & finite_pixels(stack[name])
    parts = {name: stack[name] if good.all() else _from_neighbours(stack[name], good) for name in held}
    return parts | {f"{name}_var": _where(good, stack[f"{name}_var"]) for name in held if f"{name}_var" in stack}


def variance_of_primal(stack: GradientStack, gradients: bool = False) -> np.ndarray:
    """The variance of the primal, (H, W, 3), or with ``gradients`` only of its light outside ``caustic``.

    The variance of the whole primal is NaN where the variance of ``caustic`` is not known.
    """
    variance = stack["primal_var"]
    if gradients or "caustic" not in stack:
        return variance
    without = np.where(stack["caustic"].any(axis=-1, keepdims=True), np.float32(np.nan), variance)
    if "caustic_var" not in stack:
        return without
    further = stack["caustic_var"]
    return np.where(np.isfinite(further) & (further >= 0) & (variance >= 0), variance + further, without)


def finite_pixels(layer: np.ndarray) -> np.ndarray:
    """Where all channels of (H, W, C) are finite, (H, W) booleans."""
    good = np.isfinite(layer)
    # Most layers are finite, and for these the slow reduction along a short last axis is not needed.
    return np.ones(layer.shape[:2], bool) if good.all() else good.all(axis=-1)


def _finite_subpixels(
    stack: GradientStack, light: np.ndarray, features: dict[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """The subpixels of a stack. Non-finite ones get the repaired value of their pixel in ``light`` or ``features``."""
    k = subpixels(stack.fine, stack.width)
    fine = {}
    for name, layer in stack.fine.items():
        good = finite_pixels(layer)
        pixels = light if name == "primal" else features[name]
        fine[name] = layer if good.all() else np.where(good[..., None], layer, spread(pixels, k))
    return fine


def _finite(layer: np.ndarray) -> np.ndarray:
    good = np.isfinite(layer)
    return layer if good.all() else np.where(good, layer, np.float32(0))


def _where(flags: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """The variance where ``flags`` are True, NaN elsewhere."""
    return variance if flags.all() else np.where(flags[..., None], variance, np.float32(np.nan))


def _from_neighbours(light: np.ndarray, good: np.ndarray) -> np.ndarray:
    """The light (H, W, 3) with all pixels replaced that are not ``good``.

    A replaced pixel becomes the mean of the good pixels among its eight neighbours. If no neighbour is good, the pixel
    becomes the mean of the good pixels in the smallest block around it that has any. Blocks have 8x8 pixels, 64x64, and
    so on.
    """
    image = np.where(good[..., None], light, np.float32(0))
    weight = ndimage.uniform_filter(good.astype(np.float64), 3, mode="constant")
    mean = ndimage.uniform_filter(image.astype(np.float64), (3, 3, 1), mode="constant")
    near = ~good & (weight > 1e-6)
    image[near] = mean[near] / weight[near, None]
    far = ~good & ~near
    if far.any():
        there = np.where(good[..., None], image, 0).astype(np.float64)
        image[far] = _from_blocks(there, good[..., None].astype(np.float64))[far]
    return image


def _from_blocks(total: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Divides sums (H, W, 3) by counts (H, W, 1). Where a count is 0, takes the ratio in the smallest counted block."""
    mean = total / np.maximum(count, 1)
    if count.all() or count.size == 1:
        return mean
    coarse = _from_blocks(_block_sums(total), _block_sums(count))
    spread = coarse.repeat(BLOCK, axis=0).repeat(BLOCK, axis=1)[: len(total), : total.shape[1]]
    return np.where(count > 0, mean, spread)


def _block_sums(values: np.ndarray) -> np.ndarray:
    rows, columns = (np.arange(0, length, BLOCK) for length in values.shape[:2])
    return np.add.reduceat(np.add.reduceat(values, rows, axis=0), columns, axis=1)
