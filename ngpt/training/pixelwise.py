"""Losses that compare pixel by pixel, in tone-mapped or relative radiance."""

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from ngpt.measure.distances.perceptual import tone_mapped
from ngpt.network.transfer import srgb

# The number of resolutions of ``pyramid``, and its exposures.
_SCALES, _EXPOSURES = 4, (0.25, 1.0, 4.0)


def l1(prediction: Tensor, target: Tensor) -> Tensor:
    """Mean |R(p) - R(t)|, with R the tone mapping ``tone_mapped``."""
    return (tone_mapped(prediction) - tone_mapped(target)).abs().mean()


def gradient_l1(prediction: Tensor, target: Tensor) -> Tensor:
    """Mean |R(Δp) - R(Δt)| of the differences along x, plus the same along y; an axis of one pixel adds 0."""
    total = prediction.new_zeros(())
    for axis in (-1, -2):
        if prediction.shape[axis] > 1:
            total = total + l1(prediction.diff(dim=axis), target.diff(dim=axis))
    return total


def relative(prediction: Tensor, target: Tensor, epsilon: float = 1e-2) -> Tensor:
    """Mean |p - t| / (|p| + |t| + ε), in [0, 1): dark pixels count as much as bright ones."""
    return ((prediction - target).abs() / (prediction.abs() + target.abs() + epsilon)).mean()


def huber(prediction: Tensor, target: Tensor, epsilon: float = 1e-2, knee: float = 0.5) -> Tensor:
    """Mean of Huber's function of e = (p - t) / √(p² + ε): e² / 2 up to the knee, and linear beyond it.

    For the gradient, √(p² + ε) is a constant. If the noise of the target is below the knee, the minimum is at the
    expectation of the target, so noise of mean 0 does no harm [Lehtinen et al. 2018, "Noise2Noise", section 3.3].
    Fireflies in the target count only by their number; with a squared error, they would dominate.
    """
    error = ((prediction - target) / (prediction.detach().square() + epsilon).sqrt()).abs()
    return torch.where(error < knee, error.square() / 2, knee * (error - knee / 2)).mean()


def pyramid(prediction: Tensor, target: Tensor) -> Tensor:
    """Mean |p - t| of display-encoded images at 4 resolutions and 3 exposures, in [0, 1].

    The visibility of an error depends on its width: eyes average fine noise, above all noise of colours, but not an
    offset of a whole patch [Andersson et al. 2020, "FLIP", section 4.1, here with box filters]. The structural distance
    does not detect such offsets, because SSIM subtracts the means of patches. Each resolution is half as fine as the
    last, rounded up.
    """
    total = prediction.new_zeros(())
    for exposure in _EXPOSURES:
        a, b = (srgb(tone_mapped(exposure * image.clamp(min=0)).clamp(max=1)) for image in (prediction, target))
        for scale in range(_SCALES):
            if scale:
                a, b = (avg_pool2d(image, 2, ceil_mode=True) for image in (a, b))
            total = total + (a - b).abs().mean()
    return total / (_SCALES * len(_EXPOSURES))
