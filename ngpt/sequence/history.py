"""Reconstruction over time: each frame's result, blended with the results of the frames before it.

    y = x + b (h - x)        x: this frame's result by any method; h: the last y, seen along the layer ``motion``

The weight b of history depends on

    features      where albedo, normal and depth of the last frame differ from those of this pixel, history has no
                  weight. So a newly visible surface gets nothing from the surface that hid it
    variances     with r the variance of h over the variance of x: b = 1 / (1 + r), and y has the relative variance
                  (1 - b)² + b² r. So the first n frames of a shot at rest are averaged, up to ``LONGEST`` of them, and
                  fewer of a fast shot
    evidence      h is independent of this frame's noisy primal p, of variance σ². In a window with weights w,

                      b* = [Σ w (h - x)(p - x) + k] / Σ w (h - x)²,    k = d Σ w σ²

                  is the b with the least squared error of y against the truth. d is the share of a pixel's noise that
                  the method leaves in it. Errors that h and x share, mainly blur, cancel. b* has a variance of its own.
                  The b of the variances and b* are averaged, with their inverse variances as weights. Where lighting or
                  reflections change, b* falls; for fast changes it is 0
    change        history has less weight where h - x is much larger than around the pixel, as at edges

b* is the minimum of Stein's unbiased risk over the line from x to h [Rousselle et al. 2013, "Robust denoising using
feature and color information"]. These are the rules (``ngpt.sequence.evidence``). A network, which reads more data,
corrects their b (``ngpt.sequence.network``). Where direct emission is known, only the other light is blended.
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from ngpt.coverage import kept_within
from ngpt.magnitude import WIDE, enlarged, magnitude, scaled
from ngpt.repair import repair
from ngpt.sequence.evidence import agreement, weighed
from ngpt.sequence.network import Blend, Corrections, shipped
from ngpt.sequence.warp import warped
from ngpt.stack import GradientStack
from ngpt.windows import Place

# The largest number of frames that history may count for. Slow changes, which the evidence does not detect, lag by at
# most this number of frames.
LONGEST = 16
# The motion, in image widths per frame, at which history counts for half as many frames, because surfaces look
# different from another viewpoint.
FAST = 0.005
# A mean weight of history below this counts as 0, because it would be shown as 0 %.
NOTHING = 0.005
NO_MOTION = "no layer 'motion'"


@dataclass(frozen=True)
class _History:
    """The data that a frame passes on to the next: its result without direct emission, and the variance of that."""

    light: np.ndarray
    direct: np.ndarray
    variance: np.ndarray
    features: dict[str, np.ndarray]
    place: Place
    frame: object = None


class Temporal:
    """Blends the frames of a shot, in their order, one after the other.

    ``corrections``  the network that corrects the rules (``ngpt.sequence.network``). The default is the network that
                     comes with ngpt, if ONNX Runtime is installed; None: the rules without a network
    """

    def __init__(self, corrections: Corrections | Literal["shipped"] | None = "shipped") -> None:
        self.corrections = shipped() if corrections == "shipped" else corrections
        self._history: _History | None = None
        self.blend: Blend | None = None  # the inputs of the last frame's blend; None for a restart
        self.weight = np.zeros((1, 1), np.float32)  # b of the last frame, (H, W)
        self.reason = ""  # why history had no weight in the last frame; "" if it had

    @property
    def share(self) -> float:
        """The mean of b in the last frame, from 0 (a restart) to nearly 1."""
        return float(self.weight.mean())

    def next(self, stack: GradientStack, image: np.ndarray, previous: np.ndarray | None = None) -> np.ndarray:
        """The blended result of the next frame, (H, W, 3) float32. ``image`` is its result by any method.

        For a first frame and after a cut, it is ``image`` itself. There is a cut if the stack has no layer ``motion``,
        is a picture of another size, or names another frame before it (``ngpt:previousFrame``). Frames may be parts of
        a picture that move and change their size: history is looked up at their place in the picture.

        ``previous`` (H, W, 3) takes the place of the last result that this method has returned. It may be given for a
        first frame, too; then the features of the frame before are unknown.
        """
        power = magnitude(stack)
        data = repair(scaled(stack, power), gradients=False)
        now = enlarged(np.asarray(image, np.float32), -power) - data.direct
        frame = stack.number("ngpt:frame")
        relative = np.ones(now.shape[:2], np.float32)
        features = data.features
        self.weight, self.blend = np.zeros(now.shape[:2], np.float32), None
        before = self._history
        self.reason = "the first frame" if before is None else _cut(stack, before)
        if previous is not None:
            given = repair(GradientStack({"primal": previous}), gradients=False).image
            if before is None or before.light.shape != given.shape:
                place = Place.whole(*given.shape[1::-1])
                before = _History(given, np.zeros_like(given), np.ones(given.shape[:2], np.float32), {}, place)
            before = replace(before, light=given - before.direct)
        if before is not None and (shift := _shift(stack, before)) is not None:
            light_before = enlarged(before.light, -power)
            noisy = data.image
            if max(float(np.abs(light).max()) for light in (now, light_before, noisy)) > WIDE:
                now, light_before, noisy = (light.astype(np.float64) for light in (now, light_before, noisy))
            motion = stack["motion"]
            history, found = warped(light_before, motion, sharp=True, shift=shift)
            spread = warped(before.variance[..., None], motion, shift=shift)[0][..., 0]
            then = {
                name: warped(layer, motion, shift=shift)[0]
                for name, layer in before.features.items()
                if name in features
            }
            trust = found * agreement(features, then, found)
            speed = np.linalg.norm(np.where(found[..., None], motion, 0), axis=-1) / motion.shape[1]
            spread = np.maximum(spread, (1 + speed / FAST) / LONGEST)
            first = 1 / (1 + spread)
            evidence = weighed(now, history, noisy, data.noise, trust, first)
            if self.corrections is None:
                b = evidence.share
                now = now + b[..., None] * (history - now)
            else:
                self.blend = Blend(now, history, noisy, evidence, trust, first, speed, features)
                now, b = self.blend.by(self.corrections(self.blend.inputs()))
            relative = (np.square(1 - b) + np.square(b) * spread).astype(np.float32)
            self.weight = b
            self.reason = _doubt(b, found, trust)
            # Features have noise, too. They are blended with the same weights, so that they still match the light.
            features = features | {name: features[name] + b[..., None] * (then[name] - features[name]) for name in then}
        # Stored in the units of the stack, because the next stack may have another magnitude.
        light, direct = enlarged(now, power), enlarged(data.direct, power)
        self._history = _History(light, direct, relative, features, stack.place, frame)
        # History keeps light of pixels that are empty: by chance, they may have light in the next frame.
        return kept_within(enlarged((now + data.direct).astype(np.float32), power), stack)

    def assume(self, variance: float) -> None:
        """Sets the variance of the last result, relative to the variance of one frame."""
        if self._history is not None:
            self._history = replace(self._history, variance=np.full_like(self._history.variance, variance))


def _shift(stack: GradientStack, before: _History) -> tuple[int, int] | None:
    """The position of the stack's first pixel in the last frame; None at a cut."""
    previous = stack.number("ngpt:previousFrame")
    follows = previous is None or before.frame is None or previous == before.frame
    return stack.place.shift_in(before.place) if follows and "motion" in stack else None


def _cut(stack: GradientStack, before: _History) -> str:
    """Why there is a cut between the last frame and the stack."""
    if "motion" not in stack:
        return NO_MOTION
    previous = stack.number("ngpt:previousFrame")
    if previous is not None and before.frame is not None and previous != before.frame:
        return f"is made after frame {previous:g}, and the frame before is {before.frame:g}"
    return f"is {stack.place}, and the frame before {before.place}"


def _doubt(weight: np.ndarray, found: np.ndarray, trust: np.ndarray) -> str:
    """Why history has no weight, if the mean of ``weight`` is about 0; else "".

    ``found`` says where motion leads into the last frame, and ``trust`` how well the features agree.
    """
    if weight.mean() >= NOTHING:
        return ""
    if not found.any():
        return "motion is not known, or leads out of the frame before"
    if trust.mean() < NOTHING:
        return "albedo, normal or depth differ from the frame before, where motion leads"
    return "the light differs from the frame before by more than its noise"
