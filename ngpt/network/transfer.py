"""Transfer functions between radiance of any magnitude and the range that suits networks and losses.

All are elementwise, on tensors of any shape, and odd: f(-x) = -f(x).
"""

import torch
from torch import Tensor


def signed_log(x: Tensor) -> Tensor:
    """sgn(x) ln(1 + |x|) for all real x; close to x near 0 [Kettunen et al. 2019, section 4.2].

    It grows by 0.69 per stop: 1e12 becomes 27.6.
    """
    # Two halves rather than sgn(x), which would hide the slope of 1 at 0 from automatic differentiation.
    return torch.log1p(torch.clamp(x, min=0)) - torch.log1p(torch.relu(-x))


def signed_exp(y: Tensor) -> Tensor:
    """sgn(y) (exp|y| - 1), the inverse of ``signed_log``. Computed in float32; overflows for |y| > 88.7."""
    y = y.float()
    return torch.expm1(torch.clamp(y, min=0)) - torch.expm1(torch.relu(-y))


def srgb(x: Tensor) -> Tensor:
    """Linear [0, 1] to the sRGB curve [IEC 61966-2-1]; odd, so that values below 0 keep their sign."""
    a = torch.abs(x)
    # The power has an infinite slope at 0, which would reach the other branch's gradient as 0 * inf.
    curve = 1.055 * torch.clamp(a, min=0.0031308) ** (1 / 2.4) - 0.055
    return torch.where(a <= 0.0031308, 12.92 * x, torch.sign(x) * curve)
