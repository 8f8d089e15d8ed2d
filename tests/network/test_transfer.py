"""Transfer functions and their inverses."""

import pytest
import torch

from ngpt.network.transfer import TRANSFERS, signed_exp, signed_log

RANGES = {
    "signed-log": [0, 1e-30, 1e-8, 1e-3, 0.5, 1, 65504, 1e12],
    "srgb": [0, 1e-8, 0.003, 0.0031308, 0.0032, 0.5, 1],
    "reinhard": [0, 1e-8, 1e-3, 0.5, 1, 100],
}


@pytest.mark.parametrize("name", TRANSFERS)
def test_inverses_and_signs(name):
    transfer = TRANSFERS[name]
    x = torch.tensor(RANGES[name])
    both = torch.cat([-x.flip(0), x])
    y = transfer.forward(both)
    assert torch.all(y.diff() >= 0) and torch.equal(y, -y.flip(0))
    # One rounding of y = 27.6 is two millionths of 1e12.
    assert torch.allclose(transfer.inverse(y), both, rtol=4e-6 if name != "reinhard" else 2e-5, atol=0)


@pytest.mark.parametrize("name", TRANSFERS)
def test_slopes_are_finite_and_those_of_the_function(name):
    x = torch.tensor([-0.5, -1e-3, 0.0, 1e-3, 0.5], dtype=torch.float64, requires_grad=True)
    y = TRANSFERS[name].forward(x)
    y.sum().backward()
    h = 1e-7
    with torch.no_grad():
        numeric = (TRANSFERS[name].forward(x + h) - TRANSFERS[name].forward(x - h)) / (2 * h)
    assert torch.isfinite(x.grad).all() and torch.allclose(x.grad, numeric, rtol=1e-4)


def test_the_inverse_runs_in_float32():
    y = signed_log(torch.tensor([5.0])).half()
    assert signed_exp(y).dtype == torch.float32
    assert torch.isfinite(signed_exp(torch.tensor([88.0]).bfloat16())).all()
