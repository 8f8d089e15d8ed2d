"""The weight of history by the rules whose equations are in ``ngpt.sequence.history``."""

from dataclasses import dataclass

import numpy as np

from ngpt.system.late import ndimage

# The standard deviation, in pixels, of the Gaussian window of the evidence.
WINDOW = 4.0
# Before any evidence is seen, b is assumed to lie within this standard deviation of the b that the variances give.
DOUBT = 0.12
# If a feature differs by this much more than is allowed, the weight of history falls to exp(-1) = 0.37.
ALBEDO, NORMAL, DEPTH = 0.1, 0.2, 0.03
# The scale of the allowed difference. If two surfaces share a pixel in parts u and 1 - u, its features have a standard
# deviation of sqrt(u (1 - u) / spp) times the difference of both surfaces.
MIXED = 1.0
# History has less weight in a pixel whose change is more than this number of times the change around it.
UNUSUAL = 15.0


@dataclass(frozen=True)
class Evidence:
    """The evidence about the history of a frame, and the result of the rules. Symbols are as in ``history``.

    ``noise``   (H, W, 3), the variance of the primal around each pixel, positive
    ``rest``    (H, W, 3), primal - x, clamped to 4 standard deviations of that noise
    ``best``    (H, W), b*; 0 where h = x
    ``weight``  (H, W), the weight of b* when it is averaged with the b that the variances give, 0 to 1
    ``share``   (H, W), the resulting b, from 0 to the b that the variances give
    """

    noise: np.ndarray
    rest: np.ndarray
    best: np.ndarray
    weight: np.ndarray
    share: np.ndarray


def agreement(now: dict[str, np.ndarray], then: dict[str, np.ndarray], found: np.ndarray) -> np.ndarray:
    """How well the features ``then`` agree with the features ``now``, (H, W) from 0 to 1."""
    strange = np.zeros(found.shape)
    for name, scale in (("albedo", ALBEDO), ("normal", NORMAL), ("depth", DEPTH)):
        if name not in then:
            continue
        here, there = now[name], then[name]
        if name == "depth":
            here, there = (np.log(np.maximum(layer, 1e-6)) for layer in (here, there))
            # If the camera comes nearer, all depths change by similar factors, which the median removes.
            there = there + (np.median((here - there)[found]) if found.any() else 0)
        low, high = ndimage.minimum_filter(here, (3, 3, 1)), ndimage.maximum_filter(here, (3, 3, 1))
        allowed = MIXED * np.sqrt((here - low) * (high - here))
        beyond = np.maximum(np.abs(there - here) - allowed, 0) / scale
        strange += np.square(beyond).sum(axis=-1)
    return np.exp(-strange).astype(np.float32)


def weighed(
    x: np.ndarray, h: np.ndarray, p: np.ndarray, variance: np.ndarray | None, trust: np.ndarray, first: np.ndarray
) -> Evidence:
    """The evidence for x, h and this frame's primal p, (H, W, 3) each.

    ``variance``  (H, W, 3), the variance of p: NaN where it is unknown, None if it is unknown everywhere
    ``trust``     (H, W), the ``agreement`` of features
    ``first``     (H, W), the b that the variances give
    """
    rest, change = p - x, h - x
    if variance is None:
        variance = np.full_like(p, np.nan)
    # The variance of a single pixel is as noisy as its value, and correlated with it.
    noise = _noise(variance, rest)
    rest = np.clip(rest, -4 * np.sqrt(noise), 4 * np.sqrt(noise))
    trust = trust * _usual((np.square(change) / noise).mean(axis=-1), trust)
    weight = trust[..., None] / noise
    kept = _kept(rest, noise, trust)
    squares = _mean((weight * np.square(change)).sum(axis=-1))
    above = _mean((weight * (change * rest + kept * noise)).sum(axis=-1))
    # The noise of the three channels is correlated, so their standard deviations are added.
    spread = _mean(np.square((weight * np.abs(change) * np.sqrt(noise)).sum(axis=-1))) / (4 * np.pi * WINDOW**2)
    with np.errstate(divide="ignore", invalid="ignore"):
        evidence, doubt = above / squares, spread / np.square(squares)
        precise = np.where(squares > 0, 1 / np.maximum(doubt, 1e-12), 0)
    best = np.where(squares > 0, evidence, 0)
    b = (best * precise + first / DOUBT**2) / (precise + 1 / DOUBT**2)
    return Evidence(noise, rest, best, precise / (precise + 1 / DOUBT**2), trust * np.clip(b, 0, first))


def _usual(change: np.ndarray, trust: np.ndarray) -> np.ndarray:
    """1 where the change of a pixel is usual for its surroundings; less where it is much larger, as at edges.

    The change of the surroundings is a geometric mean, on which single pixels have little influence.
    """
    tiny = 1e-6 * change.mean() + 1e-30
    around = _mean(trust * np.log(change + tiny)) / np.maximum(_mean(trust), 1e-6)
    return np.minimum(1, UNUSUAL * np.exp(around) / (change + tiny))


def _noise(variance: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """The variance of the primal around each pixel, (H, W, 3), positive; estimated from ``rest`` where unknown."""
    known = np.isfinite(variance)
    filled = np.where(known, variance, np.square(rest))
    smooth = ndimage.gaussian_filter(filled.astype(np.float64), (2, 2, 0), mode="nearest")
    return np.maximum(smooth, 1e-6 * smooth.mean() + 1e-30)


def _kept(rest: np.ndarray, noise: np.ndarray, trust: np.ndarray) -> float:
    """d: the share of a pixel's own noise that the method leaves in the result, from 0 (smooth) to 1 (the noisy image).

    If the method is a projection, E (p - x)² = σ² (1 - d). A bias of x makes E (p - x)² larger, so this estimate of d
    is a lower bound. The estimate is the median over pixels where history has weight: elsewhere, as on newly visible
    surfaces, a method may leave another share.
    """
    ratio = _mean((np.square(rest) / noise).mean(axis=-1))
    trusted = ratio[trust > 0.5]
    return float(np.clip(1 - np.median(trusted), 0, 1)) if len(trusted) else 0.0


def _mean(image: np.ndarray) -> np.ndarray:
    return ndimage.gaussian_filter(image, WINDOW, mode="nearest", truncate=3)
