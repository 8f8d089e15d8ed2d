"""How much of history is evidence for: the rules of ``ngpt.sequence.history``, whose equations they are."""

from dataclasses import dataclass

import numpy as np

from ngpt.system.late import ndimage

# Pixels, of the window of the evidence (standard deviation).
WINDOW = 4.0
# How far b may be from the b of the variances, before there is evidence (standard deviation).
DOUBT = 0.12
# Differences of features beyond what is allowed, at which history counts exp(-1) = 0.37. A pixel that two surfaces
# share in parts u and 1 - u has features with a standard deviation of sqrt(u (1 - u) / spp) times what they differ by.
MIXED = 1.0
# Times the change around it, from which a pixel's counts the less.
UNUSUAL = 15.0
ALBEDO, NORMAL, DEPTH = 0.1, 0.2, 0.03


@dataclass(frozen=True)
class Evidence:
    """What is known of a frame's history, and what the rules make of it; arrays (H, W), but the first two (H, W, 3).

    ``noise``   the variance of the primal around each pixel, positive
    ``rest``    primal - x, within 4 standard deviations of that noise
    ``best``    b*, of least squared error by this frame's primal; 0 where h is x
    ``weight``  how much of that counts beside the b of the variances, 0 to 1
    ``share``   b of both together, from 0 to the b of the variances
    """

    noise: np.ndarray
    rest: np.ndarray
    best: np.ndarray
    weight: np.ndarray
    share: np.ndarray


def agreement(now: dict[str, np.ndarray], then: dict[str, np.ndarray], found: np.ndarray) -> np.ndarray:
    """How well the features ``then`` agree with the features of each pixel now, (H, W) from 0 to 1."""
    strange = np.zeros(found.shape)
    for name, scale in (("albedo", ALBEDO), ("normal", NORMAL), ("depth", DEPTH)):
        if name not in then:
            continue
        here, there = now[name], then[name]
        if name == "depth":
            here, there = (np.log(np.maximum(layer, 1e-6)) for layer in (here, there))
            # A camera that comes nearer changes all depths: alike, if not by the same factor.
            there = there + (np.median((here - there)[found]) if found.any() else 0)
        low, high = ndimage.minimum_filter(here, (3, 3, 1)), ndimage.maximum_filter(here, (3, 3, 1))
        allowed = MIXED * np.sqrt((here - low) * (high - here))
        beyond = np.maximum(np.abs(there - here) - allowed, 0) / scale
        strange += np.square(beyond).sum(axis=-1)
    return np.exp(-strange).astype(np.float32)


def weighed(
    x: np.ndarray, h: np.ndarray, p: np.ndarray, variance: np.ndarray | None, trust: np.ndarray, first: np.ndarray
) -> Evidence:
    """The evidence of this frame's primal p on x and h (H, W, 3); ``trust`` (H, W) is the agreement of features.

    ``variance`` is the variance of p, (H, W, 3), NaN where not known, None if it is known nowhere; ``first`` is the b
    (H, W) of the variances.
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
    # Noise of the channels goes together, and so does their part in the variance of `above`.
    spread = _mean(np.square((weight * np.abs(change) * np.sqrt(noise)).sum(axis=-1))) / (4 * np.pi * WINDOW**2)
    with np.errstate(divide="ignore", invalid="ignore"):
        evidence, doubt = above / squares, spread / np.square(squares)
        precise = np.where(squares > 0, 1 / np.maximum(doubt, 1e-12), 0)
    best = np.where(squares > 0, evidence, 0)
    b = (best * precise + first / DOUBT**2) / (precise + 1 / DOUBT**2)
    return Evidence(noise, rest, best, precise / (precise + 1 / DOUBT**2), trust * np.clip(b, 0, first))


def _usual(change: np.ndarray, trust: np.ndarray) -> np.ndarray:
    """1 where history differs from now as it does around a pixel, less where by more: edges that were seen otherwise.

    Around a pixel is the geometric mean, which single ones do not move.
    """
    tiny = 1e-6 * change.mean() + 1e-30
    around = _mean(trust * np.log(change + tiny)) / np.maximum(_mean(trust), 1e-6)
    return np.minimum(1, UNUSUAL * np.exp(around) / (change + tiny))


def _noise(variance: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """The variance of the primal around each pixel, (H, W, 3), positive; of what the method took off where unknown."""
    known = np.isfinite(variance)
    filled = np.where(known, variance, np.square(rest))
    smooth = ndimage.gaussian_filter(filled.astype(np.float64), (2, 2, 0), mode="nearest")
    return np.maximum(smooth, 1e-6 * smooth.mean() + 1e-30)


def _kept(rest: np.ndarray, noise: np.ndarray, trust: np.ndarray) -> float:
    """d: the share of its own noise that a method leaves in a pixel, from 0 (smooth) to 1 (the noisy image itself).

    For a projection, E (p - x)² is σ² (1 - d), and more where x is biased: so d is no less than this. It is the median
    where history counts: elsewhere, as in what just came into sight, a method may leave more noise or less.
    """
    ratio = _mean((np.square(rest) / noise).mean(axis=-1))
    trusted = ratio[trust > 0.5]
    return float(np.clip(1 - np.median(trusted), 0, 1)) if len(trusted) else 0.0


def _mean(image: np.ndarray) -> np.ndarray:
    return ndimage.gaussian_filter(image, WINDOW, mode="nearest", truncate=3)
