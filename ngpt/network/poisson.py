"""A head that draws the image of another head toward the gradients, by a screened Poisson equation.

The network predicts weights, which say how far to trust the image and the differences in each pixel. D is the image of
the other head, and w_d, w_x and w_y are the weights. The result approaches the image I that minimises

    sum of  w_d |I - D|² + w_x |I(x+1, y) - I(x, y) - dx|² + w_y |I(x, y+1) - I(x, y) - dy|²

[the screened Poisson equation of gradient-domain rendering, Lehtinen et al. 2013; with a weight for each term, as
Rousselle et al. 2016 and Manzi et al. 2016 compute them from variances].

The unknown is the change u = I - D, whose differences should be the residuals r = dx - ΔD (and the same for dy). The
equation is solved at ``SCALES`` resolutions, from the coarsest to the finest. At each resolution, ``sweeps`` steps of a
damped Jacobi iteration start from the change at the coarser one. So a result depends only on nearby pixels, and tiles
agree with the whole image. Coarser changes are means over 2 x 2 pixels. A residual between two coarser pixels is the
mean, over their two rows, of r(2x, y) / 2 + r(2x+1, y) + r(2x+2, y) / 2. In this mean, each row is weighted by its
inverse variance. The weights w serve as inverse variances of single residuals.
"""

from dataclasses import dataclass, field
from typing import Any

from ngpt.network.heads import Direct, OwnHead
from ngpt.network.operations import X, Y

# The number of resolutions: the coarsest pixels are 8 wide.
SCALES = 4
# Variances relative to the squared brightness. IMAGE_VARIANCE is that of the image D, and LEAST_VARIANCE is added to
# the measured variances of differences. The network corrects the weights that result from them.
IMAGE_VARIANCE, LEAST_VARIANCE = 2e-3, 1e-5
# The network changes the logarithm of a weight by at most RANGE. DAMPING is the length of a step of the iteration.
RANGE, DAMPING = 10.0, 0.8
# Far less than any weight. It keeps fractions finite where all weights are 0.
NONE = 1e-12

GRADIENTS = ("dx", "dy", "dx_noise", "dy_noise")


@dataclass(frozen=True)
class Poisson(OwnHead):
    """The screened Poisson equation with the image of the head ``inner``; ``sweeps`` is at least 1."""

    inner: OwnHead = field(default_factory=Direct)
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
    def reach(self) -> int:
        # A step reads the next pixel. Means and bilinear interpolation read the coarser pixel and its neighbour.
        return self.inner.reach + sum((self.sweeps + 2) << scale for scale in range(SCALES))

    @property
    def outputs(self) -> int:
        return self.inner.outputs + 3 * SCALES

    def logarithm(self, math: Any, prediction: Any, images: list[Any]) -> Any:
        own, first = self.inner.outputs, len(images) - len(GRADIENTS)
        image = math.signed_exp(self.inner.logarithm(math, math.part(prediction, 0, own), images[:first]))
        return math.signed_log(
            solved(math, image, math.part(prediction, own, self.outputs), images[first:], self.sweeps)
        )


def solved(math: Any, image: Any, logits: Any, gradients: list[Any], sweeps: int) -> Any:
    """``image`` (N, 3, H, W), drawn toward the gradients. H and W are divisible by 2^(SCALES - 1).

    ``math``       ``Tensors`` or ``Nodes`` of ``ngpt.network.operations``
    ``logits``     (N, 3 SCALES, H, W): for each resolution, finest first, numbers that are added to the logarithms of
                   w_d, w_x and w_y, which are computed from variances. These numbers are averaged over the pixels of
                   the resolution
    ``gradients``  the layers ``GRADIENTS``: dx and dy (N, 3, H, W), and their standard errors divided by the brightness
                   (N, 1, H, W), 0 where unknown
    """
    dx, dy, x_noise, y_noise = gradients
    logits = math.tanh(logits * (1 / RANGE)) * RANGE
    x_rest, y_rest = dx - (math.after(image, X) - image), dy - (math.after(image, Y) - image)
    weights = [x_noise * 0.0 + 1 / IMAGE_VARIANCE, _precision(math, x_noise), _precision(math, y_noise)]
    levels: list[tuple[list[Any], Any, Any]] = []
    for scale in range(SCALES):
        if scale:
            logits = math.halved(math.part(logits, 3, 3 * (SCALES - scale + 1)))
            x_rest, of_dx = _coarser(math, x_rest, weights[1], X)
            y_rest, of_dy = _coarser(math, y_rest, weights[2], Y)
            weights = [math.halved(weights[0]), of_dx, of_dy]
        of_image, of_dx, of_dy = (w * math.exp(math.part(logits, i, i + 1)) for i, w in enumerate(weights))
        # The last pixel has no difference to a next one.
        weights = [of_image, math.inside(of_dx, X), math.inside(of_dy, Y)]
        levels.append((weights, x_rest, y_rest))
    change = None
    for level in reversed(levels):
        change = _swept(math, None if change is None else math.doubled(change), level, sweeps)
    return image + change


def _precision(math: Any, noise: Any) -> Any:
    """Inverse variances of differences from standard errors; where these are 0 (unknown), that of the image."""
    return math.where_positive(noise, math.inverse(noise * noise + LEAST_VARIANCE), 1 / IMAGE_VARIANCE)


def _coarser(math: Any, difference: Any, weight: Any, axis: int) -> tuple[Any, Any]:
    """Residuals along an axis at half the resolution, and their inverse variances."""
    even, odd = math.every_other(difference, 0, axis), math.every_other(difference, 1, axis)
    path = (even + math.after(even, axis)) * 0.5 + odd
    variance = math.inverse(weight + NONE)
    even, odd = math.every_other(variance, 0, axis), math.every_other(variance, 1, axis)
    trust = math.inverse((even + math.after(even, axis)) * 0.25 + odd)
    across = X + Y - axis
    first, second = math.every_other(trust, 0, across), math.every_other(trust, 1, across)
    total = first + second
    mean = first * math.every_other(path, 0, across) + second * math.every_other(path, 1, across)
    return mean / (total + NONE), total


def _swept(math: Any, change: Any, level: tuple[list[Any], Any, Any], sweeps: int) -> Any:
    """``change`` after the steps at one resolution; None stands for zero.

    ``level`` holds the three weights, and the residuals of dx and dy.
    """
    (of_image, right, below), x_rest, y_rest = level
    left, above = math.before(right, X), math.before(below, Y)
    share = math.inverse(of_image + left + right + above + below) * DAMPING
    left, right, above, below = (share * weight for weight in (left, right, above, below))
    given = left * math.before(x_rest, X) - right * x_rest + above * math.before(y_rest, Y) - below * y_rest
    if change is None:
        # The first step from zero.
        change, sweeps = given, sweeps - 1
    for _ in range(sweeps):
        beside = left * math.before(change, X) + right * math.after(change, X)
        beside = beside + above * math.before(change, Y) + below * math.after(change, Y)
        change = change * (1 - DAMPING) + given + beside
    return change
