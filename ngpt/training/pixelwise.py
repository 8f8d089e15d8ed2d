"""Losses that compare pixel by pixel, in tone-mapped or relative radiance."""

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from ngpt.measure.distances import flip as _flip
from ngpt.measure.distances.perceptual import tone_mapped
from ngpt.measure.distances.structural import ms_ssim
from ngpt.network import oidnet
from ngpt.network.transfer import signed_log, srgb

# The number of resolutions of ``pyramid``, and its exposures.
_SCALES, _EXPOSURES = 4, (0.25, 1.0, 4.0)
# For ``flip``: typical radiance over the exposure is 4. The first exposure maps it to white. The last one maps 32 times
# this radiance to white.
_WHITES = (0.25, 0.0078)
# The parts of ``pu``.
_PU_L1, _PU_STRUCTURE = 0.16, 0.84


def l1(prediction: Tensor, target: Tensor) -> Tensor:
    """Mean |R(p) - R(t)|, with R the tone mapping ``tone_mapped``."""
    return (tone_mapped(prediction) - tone_mapped(target)).abs().mean()


def gradient_l1(prediction: Tensor, target: Tensor) -> Tensor:
    """Mean |R(Δp) - R(Δt)| of the differences along x, plus that along y; an axis of one pixel adds 0.

    Differences are only between pixels of the image.
    """
    total = prediction.new_zeros(())
    for axis in (-1, -2):
        if prediction.shape[axis] > 1:
            total = total + l1(prediction.diff(dim=axis), target.diff(dim=axis))
    return total


def relative(prediction: Tensor, target: Tensor, epsilon: float = 1e-2) -> Tensor:
    """Mean |p - t| / (|p| + |t| + ε), in [0, 1): dark pixels count as much as bright ones."""
    return ((prediction - target).abs() / (prediction.abs() + target.abs() + epsilon)).mean()


def huber(prediction: Tensor, target: Tensor, epsilon: float = 1e-2, knee: float = 0.5) -> Tensor:
    """Mean of Huber's function of e = (p - t) / √(p² + ε): e² / 2 up to the knee, straight beyond it.

    In its gradient √(p² + ε) counts as a constant. Where the noise of the target is below the knee, the minimum is at
    the expectation of the target, so noise of mean 0 does no harm [Lehtinen et al. 2018, "Noise2Noise", section 3.3].
    Fireflies of the target count only by their number; a plain squared error would chase them.
    """
    error = ((prediction - target) / (prediction.detach().square() + epsilon).sqrt()).abs()
    return torch.where(error < knee, error.square() / 2, knee * (error - knee / 2)).mean()


def logarithmic(prediction: Tensor, target: Tensor) -> Tensor:
    """Mean |ln(1 + |p|) sgn p - ln(1 + |t|) sgn t|."""
    return (signed_log(prediction) - signed_log(target)).abs().mean()


def pyramid(prediction: Tensor, target: Tensor) -> Tensor:
    """Mean |p - t| of display-encoded images at 4 resolutions and 3 exposures, in [0, 1].

    How visible an error is depends on its width: eyes average out fine noise, above all noise of colours, but not an
    offset of a whole patch [Andersson et al. 2020, "FLIP", section 4.1, here with box filters]. The SSIM in the
    structural distance does not see such offsets, because it subtracts the means of patches. Each resolution has half
    the pixels of the last, rounded up.
    """
    total = prediction.new_zeros(())
    for exposure in _EXPOSURES:
        a, b = (srgb(tone_mapped(exposure * image.clamp(min=0)).clamp(max=1)) for image in (prediction, target))
        for scale in range(_SCALES):
            if scale:
                a, b = (avg_pool2d(image, 2, ceil_mode=True) for image in (a, b))
            total = total + (a - b).abs().mean()
    return total / (_SCALES * len(_EXPOSURES))


def flip(prediction: Tensor, target: Tensor) -> Tensor:
    """Mean HDR-FLIP in [0, 1), in each pixel the larger of two exposures: the difference that a viewer sees when
    flipping images.

    It filters by the resolution of the eye and compares in the Lab colour space [Andersson et al. 2020 and 2021].
    """
    return _flip.flip(prediction, target, _WHITES)


def pu(prediction: Tensor, target: Tensor) -> Tensor:
    """0.16 mean |p' - t'| + 0.84 (1 - MS-SSIM(p', t')): the training loss of OIDN, at the exposure it would give t.

    x' are codes of its perceptual curve, in which equal steps look equal at all brightnesses of displays.
    [Open Image Denoise 2.4.1, training/loss.py; its windows are Gaussians of 11 pixels, these are boxes of 7.]
    """
    scale = oidnet.exposure(target)
    a, b = (oidnet.perceptual(scale * image.clamp(min=0)) for image in (prediction, target))
    # Below 0 the curve has no gradient: this term draws negative predictions back to 0.
    black = scale * prediction.clamp(max=0).abs()
    return _PU_L1 * ((a - b).abs() + black).mean() + _PU_STRUCTURE * (1 - ms_ssim(a, b)).mean()
