"""Losses that compare pixel by pixel, in tone-mapped or relative radiance."""

from torch import Tensor

from ngpt.network.transfer import signed_log


def tone_mapped(image: Tensor) -> Tensor:
    """R(x) = x / (1 + mean over channels of |x|), (N, 3, H, W): keeps hues; a saturated pixel tends to 3, grey to 1.

    [Kettunen et al. 2019, section 5.1, and their code]
    """
    return image / (1 + image.abs().mean(1, keepdim=True))


def l1(prediction: Tensor, target: Tensor) -> Tensor:
    """Mean |R(p) - R(t)|."""
    return (tone_mapped(prediction) - tone_mapped(target)).abs().mean()


def gradient_l1(prediction: Tensor, target: Tensor) -> Tensor:
    """Mean |R(Δp) - R(Δt)| of the differences along x, plus that along y; 0 for a single row or column.

    Both images' differences are taken within the image, so that none compares with nothing.
    """
    total = prediction.new_zeros(())
    for axis in (-1, -2):
        if prediction.shape[axis] > 1:
            total = total + l1(prediction.diff(dim=axis), target.diff(dim=axis))
    return total


def relative(prediction: Tensor, target: Tensor, epsilon: float = 1e-2) -> Tensor:
    """Mean |p - t| / (|p| + |t| + ε), in [0, 1): as much for dark pixels as for bright ones."""
    return ((prediction - target).abs() / (prediction.abs() + target.abs() + epsilon)).mean()


def logarithmic(prediction: Tensor, target: Tensor) -> Tensor:
    """Mean |ln(1 + |p|) sgn p - ln(1 + |t|) sgn t|."""
    return (signed_log(prediction) - signed_log(target)).abs().mean()
