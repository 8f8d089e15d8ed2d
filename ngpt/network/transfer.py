"""Transfer functions: between radiance, of any magnitude, and the range that networks and losses are good at.

Each is a pair, ``forward`` and its exact inverse, elementwise on tensors of any shape.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Transfer:
    """A transfer function and its inverse; ``inverse(forward(x)) == x`` for x in the ``domain``."""

    forward: Callable[[Tensor], Tensor]
    inverse: Callable[[Tensor], Tensor]
    domain: str


def signed_log(x: Tensor) -> Tensor:
    """sgn(x) ln(1 + |x|): all of the reals, close to x near 0 [Kettunen et al. 2019, section 4.2].

    Grows by 0.69 per stop: 1e12 becomes 27.6.
    """
    # Two halves rather than sgn(x), which would hide the slope of 1 at 0 from automatic differentiation.
    return torch.log1p(torch.clamp(x, min=0)) - torch.log1p(torch.relu(-x))


def signed_exp(y: Tensor) -> Tensor:
    """sgn(y) (exp|y| - 1), the inverse of ``signed_log``. In float32, whatever comes in; overflows beyond 88.7."""
    y = y.float()
    return torch.expm1(torch.clamp(y, min=0)) - torch.expm1(torch.relu(-y))


def srgb(x: Tensor) -> Tensor:
    """Linear [0, 1] to the sRGB curve [IEC 61966-2-1]; odd, so that values below 0 keep their sign."""
    a = torch.abs(x)
    # The power has an infinite slope at 0, which would reach the other branch's gradient as 0 * inf.
    curve = 1.055 * torch.clamp(a, min=0.0031308) ** (1 / 2.4) - 0.055
    return torch.where(a <= 0.0031308, 12.92 * x, torch.sign(x) * curve)


def inverse_srgb(y: Tensor) -> Tensor:
    """The inverse of ``srgb``."""
    a = torch.abs(y)
    return torch.sign(y) * torch.where(a <= 12.92 * 0.0031308, a / 12.92, ((a + 0.055) / 1.055) ** 2.4)


def reinhard(x: Tensor) -> Tensor:
    """x / (1 + |x|) for each channel: all of the reals to (-1, 1)."""
    return x / (1 + torch.abs(x))


def inverse_reinhard(y: Tensor) -> Tensor:
    """y / (1 - |y|), the inverse of ``reinhard``; |y| < 1."""
    return y / (1 - torch.abs(y))


TRANSFERS = {
    "signed-log": Transfer(signed_log, signed_exp, "all reals"),
    "srgb": Transfer(srgb, inverse_srgb, "all reals, made for [0, 1]"),
    "reinhard": Transfer(reinhard, inverse_reinhard, "all reals"),
}
