"""Transfer functions: signs, slopes, and the inverse of the signed log."""

import pytest
import torch

from ngpt.network.transfer import signed_exp, signed_log, srgb

RANGES = {
    signed_log: [0, 1e-30, 1e-8, 1e-3, 0.5, 1, 65504, 1e12],
    srgb: [0, 1e-8, 0.003, 0.0031308, 0.0032, 0.5, 1],
}


def both_signs(values):
    x = torch.tensor(values)
    return torch.cat([-x.flip(0), x])


@pytest.mark.parametrize("transfer", RANGES)
def test_they_grow_and_are_odd_and_their_slopes_are_finite(transfer):
    y = transfer(both_signs(RANGES[transfer]))
    assert torch.all(y.diff() >= 0) and torch.equal(y, -y.flip(0))
    x = torch.tensor([-0.5, -1e-3, 0.0, 1e-3, 0.5], dtype=torch.float64, requires_grad=True)
    transfer(x).sum().backward()
    with torch.no_grad():
        numeric = (transfer(x + 1e-7) - transfer(x - 1e-7)) / 2e-7
    assert torch.isfinite(x.grad).all() and torch.allclose(x.grad, numeric, rtol=1e-4)


def test_the_inverse_of_the_signed_log_runs_in_float32():
    x = both_signs(RANGES[signed_log])
    # One rounding of y = 27.6 is two millionths of 1e12.
    assert torch.allclose(signed_exp(signed_log(x)), x, rtol=4e-6, atol=0)
    assert signed_exp(signed_log(torch.tensor([5.0])).half()).dtype == torch.float32
    assert torch.isfinite(signed_exp(torch.tensor([88.0]).bfloat16())).all()
