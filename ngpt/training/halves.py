"""The loss of pairs: compares a network's result from one half of the samples with the other half, without a reference.

A and B are independent renders of the same view, and f is the network. f(A) is compared with the image of B at three
scales, and its differences with the gradients of B:

    L = sum over s = 0, 1, 2 of   mean rho( D_s(f(A) - y)² / D_s(m² + ε + v) )
      + sum over dx, dy of        mean rho( (Δ f(A) - g)² / (0.01 (m² + ε) + v_g) )

    y, g     the image of B, without directly visible emission, and its dx, dy
    D_s      the mean over 2^s x 2^s pixels
    m        the mean over 3x3 pixels of f(A), a constant for the derivative
    v, v_g   the variances of the image and of dx, dy of A (``spread``)
    rho      Huber's function of the squared error: the square up to ``KNEE``², linear in the error beyond it

The noise of B is independent of A and has mean 0. So it adds a constant to the expected square, and the minimum is at
the truth [Lehtinen et al. 2018, "Noise2Noise"]. Gradients have 5 to 24 times less noise than the image, so their term
shows errors that are hidden in the noise of the image [compare Guo et al. 2019, "GradNet", where input and target are
the same render].

Divisors are computed only from A. Divisors from B would be large where B is bright by chance, and results would be too
dark.
"""

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

SCALES, KNEE = 3, 3.0
# ε. Division by the exposure makes the typical radiance 4. If it was 1/4 before, squares become 16² times as large, and
# 0.25 is about 16² times the ε = 0.001 of relMSE.
DARK = 0.25
# The 0.01 of the formula: a share of the squared light, which is added to the variance of gradients.
RELATIVE = 0.01
# A variance is at least AROUND times the typical one in its window, because estimates from few samples are noisy.
AROUND, WINDOW = 3.0, 5


def halves(prediction: Tensor, other: dict[str, Tensor]) -> Tensor:
    """L of f(A), (N, 3, H, W) divided by the exposure of A. ``other`` is the target in the same units:

    ``primal``, ``dx``, ``dy``           (N, 3, H, W) of B
    ``primal_se``, ``dx_se``, ``dy_se``  (N, 3, H, W) standard errors from A
    ``counts``                           (N, 1, H, W) weights: 1, or 0 for pixels that are left out, such as lamps
    """
    return judged(prediction, avg_pool2d(prediction.detach(), 3, 1, 1, count_include_pad=False), other)


def judged(prediction: Tensor, smooth: Tensor, other: dict[str, Tensor]) -> Tensor:
    """L, with ``smooth`` as m."""
    light, counts, total = smooth.square() + DARK, other["counts"], prediction.new_zeros(())
    images = counts * (prediction - other["primal"]), light + spread(other["primal_se"]), counts
    for scale in range(SCALES):
        error, size, share = (avg_pool2d(image, 2**scale) for image in images)
        total = total + _mean((error / share.clamp(min=0.5**SCALES)).square() / size, share)
    for name, axis in (("dx", -1), ("dy", -2)):
        length = counts.shape[axis] - 1
        gradient, light_here, noise = (
            layer.narrow(axis, 0, length) for layer in (other[name], light, spread(other[f"{name}_se"]))
        )
        both = counts.narrow(axis, 0, length) * counts.narrow(axis, 1, length)
        error = prediction.diff(dim=axis) - gradient
        total = total + _mean(error.square() / (RELATIVE * light_here + noise), both)
    return total


def spread(errors: Tensor) -> Tensor:
    """Variances from standard errors (N, 3, H, W): at least three times the typical variance of 5x5 pixels.

    The typical variance is the fourth power of the mean of fourth roots, which single large variances hardly change.
    """
    around = avg_pool2d(errors.sqrt(), WINDOW, 1, WINDOW // 2, count_include_pad=False)
    return torch.maximum(errors.square(), AROUND * around.pow(4))


def _mean(squares: Tensor, share: Tensor) -> Tensor:
    """The mean of rho(squares) over pixels and channels, with the weights ``share`` (N, 1, H, W) of pixels."""
    straight = 2 * KNEE * squares.clamp(min=KNEE**2).sqrt() - KNEE**2
    rho = torch.where(squares < KNEE**2, squares, straight)
    return (share * rho).sum() / (squares.shape[1] * share.sum()).clamp(min=1)
