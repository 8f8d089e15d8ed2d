"""Transfer functions between radiance of any magnitude and numbers in a range that suits networks and losses.

They are elementwise, for tensors of any shape, and odd: f(-x) = -f(x).
"""

import torch
from torch import Tensor


def signed_log(x: Tensor) -> Tensor:
    """sgn(x) ln(1 + |x|); close to x near 0, and 27.6 for 1e12 [Kettunen et al. 2019, section 4.2]."""
    # With sgn(x), automatic differentiation would not find the slope of 1 at 0.
    return torch.log1p(torch.clamp(x, min=0)) - torch.log1p(torch.relu(-x))


def signed_exp(y: Tensor) -> Tensor:
    """sgn(y) (exp|y| - 1), the inverse of ``signed_log``, in float32; infinite for |y| > 88.7."""
    y = y.float()
    return torch.expm1(torch.clamp(y, min=0)) - torch.expm1(torch.relu(-y))


def srgb(x: Tensor) -> Tensor:
    """The sRGB curve of linear values in [0, 1] [IEC 61966-2-1]; values below 0 keep their sign."""
    a = torch.abs(x)
    # Without the clamp, the infinite slope of the power at 0 would make the gradient of the other branch 0 * inf.
    curve = 1.055 * torch.clamp(a, min=0.0031308) ** (1 / 2.4) - 0.055
    return torch.where(a <= 0.0031308, 12.92 * x, torch.sign(x) * curve)
