"""Estimates the standard error of each pixel of a reconstruction, for any method.

The method runs a second time on the stack with added noise. The variances of the added noise are those of the stack.
Noise that pixels share is added from the layer ``shared``, because a denoiser removes white noise but not shared noise.
The standard error is the root mean square change of the image over about 9x9 pixels, times a factor that was measured
for each method. docs/use/uncertainty.md says how good the estimate is, and where it fails.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from ngpt.coverage import empty_pixels
from ngpt.errors import NgptError
from ngpt.layers import DIFFERENCES
from ngpt.merging import VARIANCES
from ngpt.methods import Result, reconstruct
from ngpt.shared import shared_variance
from ngpt.stack import GradientStack
from ngpt.subpixels import means, spread, subpixels
from ngpt.system.late import ndimage

SPREAD = 2.6  # standard deviation, in pixels, of the window over which the change is averaged: as large as 9x9 pixels
SEED = 20261122
# Factors that bench/uncertainty.py of commit e61ee6f3 measured on the scenes named there. FACTOR, the most frequent
# value, is for all other methods.
FACTORS = {"primal": 0.9, "l2": 0.9, "l1": 1.7, "cv": 0.85, "wcv": 1.1, "wl2": 1.4}
FACTOR = 1.2


def reconstruct_with_error(
    stack: GradientStack, method: str = "auto", *, halves: tuple[GradientStack, GradientStack] | None = None, **options
) -> Result:
    """Like ``ngpt.reconstruct``, but with ``Result.error``: the standard error (H, W, 3) float32, in the image's unit.

    It takes twice the time of ``ngpt.reconstruct``. ``halves`` are two stacks of independent halves of the samples,
    such as those that ``stack`` was merged from. With halves, it takes four times the time of ``ngpt.reconstruct``, and
    0.4 to 0.75 times as many values are wrong by more than five standard errors.

    The error is NaN in pixels where a variance is not finite. The same stacks give the same bits. Raises NgptError if
    the stack has no variances, if a half is of another size or place, if both halves have the same seed, and as
    ``reconstruct`` does.
    """
    result = reconstruct(stack, method, **options)
    again = reconstruct(noisier(stack), method, **options)
    factor, known = FACTORS.get(result.method, FACTOR), known_noise(stack)
    error, seconds = change(result.image, again.image, known), result.seconds + again.seconds
    if halves is not None:
        _check_halves(stack, halves)
        one, other = (reconstruct(half, result.method, **options) for half in halves)
        # Each half has twice the variance, so their difference has four times the variance of their mean.
        error = np.sqrt((error**2 + (change(one.image, other.image, known) / 2) ** 2) / 2)
        seconds += one.seconds + other.seconds
    return replace(result, error=(factor * error).astype(np.float32), seconds=seconds)


def _check_halves(stack: GradientStack, halves: tuple[GradientStack, GradientStack]) -> None:
    """Raises NgptError if these cannot be halves of the samples of the stack."""
    for half in halves:
        known = half.place.known and stack.place.known
        if half.place.data != stack.place.data if known else half.place.data.size != stack.place.data.size:
            places = f"a half of the samples is {half.place} and the stack {stack.place}"
            raise NgptError(f"{places}; give two stacks of the same view, such as those that it was merged from")
    one, other = (set(str(half.attributes.get("ngpt:seed", "")).split()) for half in halves)
    if both := one & other:
        raise NgptError(f"both halves have seed {min(both)}, and so the same samples; give stacks of different seeds")


def known_noise(stack: GradientStack) -> np.ndarray:
    """Where all variances are finite, (H, W) booleans. Border differences and non-finite differences do not count."""
    known = np.ones((stack.height, stack.width), bool)
    inside: Any
    for name, inside in (("primal", np.s_[:]), ("caustic", np.s_[:]), ("dx", np.s_[:, :-1]), ("dy", np.s_[:-1])):
        if name in stack and VARIANCES[name] in stack:
            finite = np.isfinite(stack[VARIANCES[name]][inside]).all(axis=-1)
            if name in DIFFERENCES:
                finite |= ~np.isfinite(stack[name][inside]).all(axis=-1)
            known[inside] &= finite
    return known


def noisier(stack: GradientStack) -> GradientStack:
    """Returns the stack with added noise of the stack's variances. Where a variance is not finite, no noise is added.

    As the noise that pixels share, the layer ``shared`` is added as it is. White noise is added for the other part of
    the variance. Raises NgptError if the stack lacks variances.
    """
    stack.require("primal_var", why="an estimate of the error")
    for name in ("dx", "dy"):
        if name in stack:
            stack.require(f"{name}_var", why="an estimate of the error of what gradients give")
    rng = np.random.default_rng(SEED)
    layers = {}
    for name, variance in VARIANCES.items():
        # Noise is drawn for missing layers too, so that the noise of other layers does not depend on them.
        drawn = rng.standard_normal(stack["primal"].shape, np.float32)
        if name in stack and variance in stack:
            known = np.maximum(np.nan_to_num(stack[variance], posinf=0.0), 0)
            if name in ("primal", "caustic"):
                known = np.where(empty_pixels(stack)[..., None], 0, known)
            noise = np.sqrt(known) * drawn
            if name == "primal" and "shared" in stack:
                own, shared = (
                    known - shared_variance(stack["shared"]),
                    np.nan_to_num(stack["shared"], posinf=0, neginf=0),
                )
                noise = np.sqrt(np.maximum(own, 0)) * drawn + np.where(known > 0, shared, 0)
            layers[name] = stack[name] + noise
    if "caustic" in layers:
        # The caustic is part of the primal, but the noise added to the primal above is only that of its other light.
        layers["primal"] = layers["primal"] + (layers["caustic"] - stack["caustic"])
    if not stack.fine or "primal" not in layers:
        return stack.replace(**layers)
    k = subpixels(stack.fine, stack.width)
    fine = _noisier_subpixels(stack, layers["primal"] - stack["primal"], rng, k)
    layers["primal"] = means(fine["primal"], k)
    return replace(stack.replace(**layers), fine=fine)


def _noisier_subpixels(
    stack: GradientStack, noise: np.ndarray, rng: np.random.Generator, k: int
) -> dict[str, np.ndarray]:
    """The subpixels with the ``noise`` of their pixels, plus noise of their own whose mean over each pixel is 0.

    The variance of a subpixel is K² times the variance of its pixel, without the noise that pixels share.
    """
    variance = np.nan_to_num(stack["primal_var"], posinf=0.0)
    if "shared" in stack:
        variance = variance - shared_variance(stack["shared"])
    variance = np.where(empty_pixels(stack)[..., None], 0, np.maximum(variance, 0))
    drawn = rng.standard_normal(stack.fine["primal"].shape, np.float32)
    drawn -= spread(means(drawn, k), k)
    own = spread(k * np.sqrt(variance), k) * drawn
    return stack.fine | {"primal": (stack.fine["primal"] + spread(noise, k) + own).astype(np.float32)}


def change(image: np.ndarray, other: np.ndarray, known: np.ndarray | None = None) -> np.ndarray:
    """The root of the mean squared difference of two images in a Gaussian window, (H, W, 3) double precision.

    Pixels that are not ``known`` (H, W) do not count, and are NaN in the result.
    """
    difference = other.astype(np.float64) - image
    if known is None or known.all():
        scale = float(np.abs(difference).max()) or 1.0
        return scale * np.sqrt(np.maximum(_around(np.square(difference / scale)), 0))
    difference[~known] = 0
    share = np.where(known, _around(known[..., None].astype(np.float64))[..., 0], np.nan)
    return change(np.zeros_like(difference), difference) / np.sqrt(share)[..., None]


def _around(values: np.ndarray) -> np.ndarray:
    return ndimage.gaussian_filter(values, (SPREAD, SPREAD, 0), mode="reflect", truncate=3)
