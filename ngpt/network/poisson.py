"""A head that draws the image of another head toward the gradients, by a screened Poisson equation with predicted
weights. In each pixel the weights say how far to trust the image and the differences.

With D the image of the other head, w_d, w_x and w_y the weights, the result approaches the I that minimises

    sum of  w_d |I - D|² + w_x |I(x+1, y) - I(x, y) - dx|² + w_y |I(x, y+1) - I(x, y) - dy|²

[the screened Poisson equation of gradient-domain rendering, Lehtinen et al. 2013; with a weight for each term, as
Rousselle et al. 2016 and Manzi et al. 2016 compute them from variances].

The unknown is the change u = I - D. The given differences are the residuals of dx and dy to the differences of D:
r = dx - ΔD. The ``SCALES`` resolutions are solved from the coarsest to the finest. At each one, ``sweeps`` steps of a
damped Jacobi iteration start from the change of the coarser one. So a result depends only on nearby pixels, and tiles
agree with the whole. Coarser changes are means over 2 x 2 pixels. A difference between two of these is the mean, over
two rows, of r(2x, y) / 2 + r(2x+1, y) + r(2x+2, y) / 2. Each row is weighted by its inverse variance; the weights serve
as inverse variances.

The computation is written once, for PyTorch and for ONNX graphs: ``math`` has all operations other than +, -, * and /.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, pad

from ngpt.network.heads import Direct, Head
from ngpt.network.transfer import signed_exp, signed_log

# The number of resolutions: the coarsest pixels are 8 wide.
SCALES = 4
# Variances relative to the squared brightness; the network's weights correct them. The first is that of the image. The
# second is added to the measured variance of differences.
IMAGE_VARIANCE, LEAST_VARIANCE = 2e-3, 1e-5
# The network changes the logarithm of a weight by at most RANGE. DAMPING is the length of a step.
RANGE, DAMPING = 10.0, 0.8
# Far less than any weight: keeps fractions finite where all weights are 0.
NONE = 1e-12

GRADIENTS = ("dx", "dy", "dx_noise", "dy_noise")
# Axes of (N, C, H, W); the end of a slice that has no end.
_X, _Y, _END = 3, 2, 2**63 - 1


@dataclass(frozen=True)
class Poisson(Head):
    """The screened Poisson equation around the head ``inner``, see above; ``sweeps`` is at least 1."""

    inner: Head = field(default_factory=Direct)
    sweeps: int = 4

    @property
    def neutral(self) -> bool:  # type: ignore[override]
        return self.inner.neutral

    @property
    def normalise(self) -> bool:  # type: ignore[override]
        return self.inner.normalise

    @property
    def reads(self) -> tuple[str, ...]:
        return (*self.inner.reads, *GRADIENTS)

    @property
    def radius(self) -> int:
        return self.inner.radius

    @property
    def reach(self) -> int:
        # A step reads the next pixel; means and bilinear interpolation read the coarser pixel and its neighbour.
        return self.inner.reach + sum((self.sweeps + 2) << scale for scale in range(SCALES))

    @property
    def outputs(self) -> int:
        return self.inner.outputs + 3 * SCALES

    def forward(self, prediction: Tensor, images: list[Tensor]) -> Tensor:
        own, r = self.inner.outputs, self.radius
        image = signed_exp(self.inner.forward(prediction[:, :own], images[: -len(GRADIENTS)]))
        gradients = [layer[..., r : -r or None, r : -r or None] for layer in images[-len(GRADIENTS) :]]
        return signed_log(solved(_Torch, image, prediction[:, own:], gradients, self.sweeps))

    def graph(self, op: Any, prediction: Any, images: list[Any]) -> Any:
        math, own, r = _Onnx(op), self.inner.outputs, self.radius
        image = op.signed_exp(self.inner.graph(op, math.part(prediction, 0, own), images[: -len(GRADIENTS)]))
        gradients = images[-len(GRADIENTS) :]
        if r:
            gradients = [op.Slice(layer, [r, r], [-r, -r], [2, 3]) for layer in gradients]
        return op.signed_log(solved(math, image, math.part(prediction, own, self.outputs), gradients, self.sweeps))


def solved(math: Any, image: Any, logits: Any, gradients: list[Any], sweeps: int) -> Any:
    """``image`` (N, 3, H, W) drawn toward the gradients; sides are divisible by 2^(SCALES - 1).

    ``logits``   (N, 3 SCALES, H, W): for each resolution, finest first, corrections of the logarithms of w_d, w_x and
                 w_y, relative to the weights by variances; averaged over the pixels of the resolution
    ``gradients``  the layers ``GRADIENTS``: dx and dy (N, 3, H, W), and their standard errors over the brightness
                 (N, 1, H, W), 0 where not known
    """
    dx, dy, x_noise, y_noise = gradients
    logits = math.tanh(logits * (1 / RANGE)) * RANGE
    x_rest, y_rest = dx - (math.after(image, _X) - image), dy - (math.after(image, _Y) - image)
    weights = [x_noise * 0.0 + 1 / IMAGE_VARIANCE, _precision(math, x_noise), _precision(math, y_noise)]
    levels: list[tuple[list[Any], Any, Any]] = []
    for scale in range(SCALES):
        if scale:
            logits = math.halved(math.part(logits, 3, 3 * (SCALES - scale + 1)))
            x_rest, of_dx = _coarser(math, x_rest, weights[1], _X)
            y_rest, of_dy = _coarser(math, y_rest, weights[2], _Y)
            weights = [math.halved(weights[0]), of_dx, of_dy]
        of_image, of_dx, of_dy = (w * math.exp(math.part(logits, i, i + 1)) for i, w in enumerate(weights))
        # There is no pixel after the last one.
        weights = [of_image, math.inside(of_dx, _X), math.inside(of_dy, _Y)]
        levels.append((weights, x_rest, y_rest))
    change = None
    for level in reversed(levels):
        change = _swept(math, None if change is None else math.doubled(change), level, sweeps)
    return image + change


def _precision(math: Any, noise: Any) -> Any:
    """Inverse variances of differences. A standard error of 0 means unknown; it gives the weight of the image."""
    return math.where_positive(noise, math.inverse(noise * noise + LEAST_VARIANCE), 1 / IMAGE_VARIANCE)


def _coarser(math: Any, difference: Any, weight: Any, axis: int) -> tuple[Any, Any]:
    """Differences along an axis at half the resolution, and their inverse variances."""
    even, odd = math.every_other(difference, 0, axis), math.every_other(difference, 1, axis)
    path = (even + math.after(even, axis)) * 0.5 + odd
    variance = math.inverse(weight + NONE)
    even, odd = math.every_other(variance, 0, axis), math.every_other(variance, 1, axis)
    trust = math.inverse((even + math.after(even, axis)) * 0.25 + odd)
    across = _X + _Y - axis
    first, second = math.every_other(trust, 0, across), math.every_other(trust, 1, across)
    total = first + second
    mean = first * math.every_other(path, 0, across) + second * math.every_other(path, 1, across)
    return mean / (total + NONE), total


def _swept(math: Any, change: Any, level: tuple[list[Any], Any, Any], sweeps: int) -> Any:
    """``change`` after the steps at one resolution; None starts from zero.

    ``level``  the three weights, and the residuals of dx and dy
    """
    (of_image, right, below), x_rest, y_rest = level
    left, above = math.before(right, _X), math.before(below, _Y)
    share = math.inverse(of_image + left + right + above + below) * DAMPING
    left, right, above, below = (share * weight for weight in (left, right, above, below))
    given = left * math.before(x_rest, _X) - right * x_rest + above * math.before(y_rest, _Y) - below * y_rest
    if change is None:
        # The first step from zero.
        change, sweeps = given, sweeps - 1
    for _ in range(sweeps):
        beside = left * math.before(change, _X) + right * math.after(change, _X)
        beside = beside + above * math.before(change, _Y) + below * math.after(change, _Y)
        change = change * (1 - DAMPING) + given + beside
    return change


class _Torch:
    """``math`` on tensors. ``before`` and ``after`` give the value of the neighbouring pixel; 0 beyond the border."""

    exp, tanh, inverse = torch.exp, torch.tanh, torch.reciprocal

    @staticmethod
    def part(x: Tensor, first: int, last: int) -> Tensor:
        return x[:, first:last]

    @staticmethod
    def halved(x: Tensor) -> Tensor:
        return avg_pool2d(x, 2)

    @staticmethod
    def doubled(x: Tensor) -> Tensor:
        return interpolate(x, scale_factor=2.0, mode="bilinear", align_corners=False)

    @staticmethod
    def every_other(x: Tensor, first: int, axis: int) -> Tensor:
        return x[..., first::2] if axis == _X else x[..., first::2, :]

    @staticmethod
    def before(x: Tensor, axis: int) -> Tensor:
        return pad(x[..., :-1], (1, 0)) if axis == _X else pad(x[..., :-1, :], (0, 0, 1, 0))

    @staticmethod
    def after(x: Tensor, axis: int) -> Tensor:
        return pad(x[..., 1:], (0, 1)) if axis == _X else pad(x[..., 1:, :], (0, 0, 0, 1))

    @staticmethod
    def inside(x: Tensor, axis: int) -> Tensor:
        return pad(x[..., :-1], (0, 1)) if axis == _X else pad(x[..., :-1, :], (0, 0, 0, 1))

    @staticmethod
    def where_positive(x: Tensor, then: Tensor, otherwise: float) -> Tensor:
        return torch.where(x > 0, then, otherwise)


class _Onnx:
    """The operations of ``_Torch`` as nodes of a graph."""

    def __init__(self, op: Any):
        self._op = op
        self.exp, self.tanh, self.inverse = op.Exp, op.Tanh, op.Reciprocal

    def part(self, x: Any, first: int, last: int) -> Any:
        return self._op.Slice(x, [first], [last], [1])

    def halved(self, x: Any) -> Any:
        return self._op.AveragePool(x, kernel_shape=[2, 2], strides=[2, 2])

    def doubled(self, x: Any) -> Any:
        sizes = np.array([1, 1, 2, 2], np.float32)
        return self._op.Resize(x, None, sizes, mode="linear", coordinate_transformation_mode="half_pixel")

    def every_other(self, x: Any, first: int, axis: int) -> Any:
        return self._op.Slice(x, [first], [_END], [axis], [2])

    def before(self, x: Any, axis: int) -> Any:
        return self._op.Pad(self._op.Slice(x, [0], [-1], [axis]), [1, 0], 0.0, [axis])

    def after(self, x: Any, axis: int) -> Any:
        return self._op.Pad(self._op.Slice(x, [1], [_END], [axis]), [0, 1], 0.0, [axis])

    def inside(self, x: Any, axis: int) -> Any:
        return self._op.Pad(self._op.Slice(x, [0], [-1], [axis]), [0, 1], 0.0, [axis])

    def where_positive(self, x: Any, then: Any, otherwise: float) -> Any:
        return self._op.Where(self._op.Greater(x, 0.0), then, otherwise)
