"""Reconstruction over time: each frame's result, blended with the results of the frames before it.

    y = x + b (h - x)        x: this frame's result by any method; h: the last y, seen along the layer ``motion``

How much history counts, b, is made of

    features      no history where albedo, normal and depth of the frame before are not those of this pixel now: what
                  comes into sight takes nothing from what hid it
    variances     with r the variance of h over that of x: b = 1 / (1 + r), and y has (1 - b)² + b² r. So the first n
                  frames of a shot at rest are averaged, up to ``LONGEST`` of them, and fewer of a fast one
    evidence      h knows nothing of this frame's noisy primal p, of variance σ². In a window with weights w,

                      b* = [Σ w (h - x)(p - x) + k] / Σ w (h - x)²,    k = d Σ w σ²

                  is the b of least squared error of y against the truth, where d is the share of a pixel's noise that
                  the method leaves in it. What both h and x get wrong, blur above all, cancels. b* has a variance of
                  its own, and the mean of both b, weighted by their variances, is taken. Where lighting or reflections
                  change, b* falls, to 0 on fast ones

    change        less history where h - x is many times what it is around: edges that were seen otherwise

b* is the minimum of Stein's unbiased risk over the line from x to h; Rousselle et al. 2013, "Robust denoising using
feature and color information", choose between filters by that risk. Where direct emission is known, the rest alone is
blended. The method may be any, and knows nothing of time.
"""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter, maximum_filter, minimum_filter

from ngpt.repair import repair
from ngpt.stack import GradientStack
from ngpt.warp import warped

# Frames that history may count for: what changes slowly, and is not seen by the evidence, lags by no more.
LONGEST = 16
# Image widths a frame, at which it counts for half as many: what is seen from elsewhere looks otherwise.
FAST = 0.005
# Pixels, of the window of the evidence (standard deviation).
WINDOW = 4.0
# What b may be off from that of the variances, before there is evidence (standard deviation).
DOUBT = 0.12
# Differences of features beyond what is allowed, at which history counts exp(-1) = 0.37. A pixel that two surfaces
# share in parts u and 1 - u has features with a standard deviation of sqrt(u (1 - u) / spp) times what they differ by.
MIXED = 1.0
# Times the change around it, from which a pixel's counts the less.
UNUSUAL = 15.0
ALBEDO, NORMAL, DEPTH = 0.1, 0.2, 0.03


@dataclass(frozen=True)
class _History:
    """What a frame hands on to the next: result without direct emission, its relative variance, features, frame."""

    light: np.ndarray
    variance: np.ndarray
    features: dict[str, np.ndarray]
    frame: object


class Temporal:
    """Blends the frames of a shot, in their order, one after the other."""

    def __init__(self) -> None:
        self._history: _History | None = None
        self.weight = np.zeros((1, 1), np.float32)  # b of the last frame, (H, W)

    @property
    def share(self) -> float:
        """The mean of b in the last frame, from 0 (a restart) to nearly 1."""
        return float(self.weight.mean())

    def next(self, stack: GradientStack, image: np.ndarray) -> np.ndarray:
        """The next frame's result, (H, W, 3) float32: ``image``, its result by any method, blended with those before.

        It is ``image`` itself for a first frame, and after a cut: where the stack has no layer ``motion``, is of
        another size, or says that the frame before it was another one (``ngpt:previousFrame``).
        """
        data = repair(stack, gradients=False)
        now = np.asarray(image, np.float32) - data.direct
        frame = stack.attributes.get("ngpt:frame")
        relative = np.ones(now.shape[:2], np.float32)
        features = data.features
        self.weight = np.zeros(now.shape[:2], np.float32)
        before = self._history
        if before is not None and _follows(stack, before):
            motion = stack["motion"]
            history, found = warped(before.light, motion, sharp=True)
            spread = warped(before.variance[..., None], motion)[0][..., 0]
            then = {name: warped(layer, motion)[0] for name, layer in before.features.items() if name in features}
            trust = found * _agreement(features, then, found)
            speed = np.linalg.norm(np.where(found[..., None], motion, 0), axis=-1) / motion.shape[1]
            spread = np.maximum(spread, (1 + speed / FAST) / LONGEST)
            b = _share(now, history, data.image, data.noise, trust, 1 / (1 + spread))
            relative = (np.square(1 - b) + np.square(b) * spread).astype(np.float32)
            now = now + b[..., None] * (history - now)
            self.weight = b
            # They have noise as well, and are blended as the light is, that they stay those of its pixels.
            features = features | {name: features[name] + b[..., None] * (then[name] - features[name]) for name in then}
        self._history = _History(now, relative, features, frame)
        return (now + data.direct).astype(np.float32)


def _follows(stack: GradientStack, before: _History) -> bool:
    """Whether the last frame is the one that the stack's motion leads to."""
    if "motion" not in stack or stack["motion"].shape[:2] != before.light.shape[:2]:
        return False
    previous = stack.attributes.get("ngpt:previousFrame")
    return previous is None or before.frame is None or previous == before.frame


def _agreement(now: dict[str, np.ndarray], then: dict[str, np.ndarray], found: np.ndarray) -> np.ndarray:
    """How far the features ``then`` are those of each pixel now, (H, W) from 0 to 1."""
    strange = np.zeros(found.shape)
    for name, scale in (("albedo", ALBEDO), ("normal", NORMAL), ("depth", DEPTH)):
        if name not in then:
            continue
        here, there = now[name], then[name]
        if name == "depth":
            here, there = (np.log(np.maximum(layer, 1e-6)) for layer in (here, there))
            # A camera that comes nearer changes all depths: alike, if not by the same factor.
            there = there + (np.median((here - there)[found]) if found.any() else 0)
        low, high = minimum_filter(here, (3, 3, 1)), maximum_filter(here, (3, 3, 1))
        allowed = MIXED * np.sqrt((here - low) * (high - here))
        beyond = np.maximum(np.abs(there - here) - allowed, 0) / scale
        strange += np.square(beyond).sum(axis=-1)
    return np.exp(-strange).astype(np.float32)


def _share(
    x: np.ndarray, h: np.ndarray, p: np.ndarray, variance: np.ndarray | None, trust: np.ndarray, first: np.ndarray
) -> np.ndarray:
    """b of the evidence and of the variances (``first``) together, (H, W) from 0 to ``first``."""
    rest, change = p - x, h - x
    if variance is None:
        variance = np.full_like(p, np.nan)
    # That of single pixels is known no better than they are, and goes with their values.
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
    b = (np.where(squares > 0, evidence, 0) * precise + first / DOUBT**2) / (precise + 1 / DOUBT**2)
    return trust * np.clip(b, 0, first)


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
    smooth = gaussian_filter(filled.astype(np.float64), (2, 2, 0), mode="nearest")
    return np.maximum(smooth, 1e-6 * smooth.mean() + 1e-30)


def _kept(rest: np.ndarray, noise: np.ndarray, trust: np.ndarray) -> float:
    """d: the share of its own noise that a method leaves in a pixel, from 0 (smooth) to 1 (the noisy image itself).

    For a projection, E (p - x)² is σ² (1 - d), and more where x is biased: so d is no less than this.
    """
    ratio = _mean((np.square(rest) / noise).mean(axis=-1))
    return float(np.clip(1 - np.median(ratio), 0, 1))


def _mean(image: np.ndarray) -> np.ndarray:
    return gaussian_filter(image, WINDOW, mode="nearest", truncate=3)
