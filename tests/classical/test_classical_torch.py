"""The classical reconstructions on torch tensors: the same numbers as NumPy's, and derivatives."""

import subprocess
import sys

import numpy as np
import pytest
from solvers import METHODS, noisy_stack

torch = pytest.importorskip("torch")

from ngpt.classical.arrays import dct2, idct2  # noqa: E402
from ngpt.classical.controlvariates import cv, wcv  # noqa: E402
from ngpt.classical.leastsquares import solve_weighted  # noqa: E402
from ngpt.classical.poisson import l1, l2  # noqa: E402
from ngpt.classical.variances import auto_alpha  # noqa: E402
from ngpt.classical.weighted import wl2  # noqa: E402

# Threads only get into each other's way on images this small.
torch.set_num_threads(1)

DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
on_every_device = pytest.mark.parametrize("device", DEVICES)


def test_importing_and_running_ngpt_does_not_import_torch():
    program = (
        "import sys, numpy as np, ngpt; a = np.ones((5, 4, 3), 'f');"
        "s = ngpt.GradientStack.from_arrays(primal=a, dx=a, dy=a, primal_var=a, dx_var=a, dy_var=a);"
        "[ngpt.denoise(s, m) for m in ('primal', 'l2', 'l1', 'cv', 'wcv', 'wl2')];"
        "assert 'torch' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", program], check=True)


@pytest.mark.parametrize("size", [(1, 1), (1, 2), (2, 3), (5, 4), (7, 9), (16, 1), (12, 30)])
def test_cosine_transforms_are_scipys(size):
    x = np.random.default_rng(0).standard_normal((2, *size))
    expected = dct2(x.copy())
    transformed = dct2(torch.from_numpy(x))
    assert np.allclose(transformed, expected, atol=1e-12)
    assert np.allclose(idct2(transformed), x, atol=1e-12)


@on_every_device
@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("size", [(1, 1), (1, 6), (31, 24)])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_tensors_and_arrays_give_the_same(device, name, size, dtype):
    _, *data, variances = noisy_stack(*size, dtype=dtype)
    expected = METHODS[name](*data, variances)
    tensors = [torch.from_numpy(a).to(device) for a in data]
    result = METHODS[name](*tensors, [torch.from_numpy(v).to(device) for v in variances])
    assert result.dtype == tensors[0].dtype and result.device == tensors[0].device
    # wl2 stops at a tolerance of its own; the many iterations of l1 multiply the rounding of float32.
    tolerance = {"wl2": 1e-3, "l1": 5e-5}.get(name, 1e-5)
    assert np.abs(result.cpu().numpy() - expected).max() <= tolerance * np.abs(expected).max()


@on_every_device
def test_untrusted_differences(device):
    _, *data, _ = noisy_stack(14, 15, dtype=np.float64)
    trusted = np.random.default_rng(0).random((2, 14, 15)) > 0.2
    flags = [torch.from_numpy(t).to(device) for t in trusted]
    tensors = [torch.from_numpy(a).to(device) for a in data]
    for method in (l2, l1, cv):
        expected = method(*data, trusted=tuple(trusted))
        assert np.allclose(method(*tensors, trusted=tuple(flags)).cpu(), expected, atol=1e-4)


def test_auto_alpha_of_tensors():
    variances = noisy_stack(14, 15)[-1]
    assert auto_alpha(*map(torch.from_numpy, variances)) == pytest.approx(auto_alpha(*variances))


def parameters(height, width, count=3):
    _, *data, _ = noisy_stack(height, width, channels=2, dtype=np.float64)
    return [torch.from_numpy(a).requires_grad_() for a in data][:count]


@pytest.mark.parametrize("alpha", [0.2, 2.0])
@pytest.mark.parametrize("size", [(4, 5), (1, 3), (2, 2)])
def test_the_derivative_of_l2(size, alpha):
    assert torch.autograd.gradcheck(lambda *a: l2(*a, alpha), parameters(*size))


def test_the_derivative_of_cv_and_wcv():
    _, *_, variances = noisy_stack(4, 5, channels=2, dtype=np.float64)
    fixed = [torch.from_numpy(v) for v in variances]
    assert torch.autograd.gradcheck(lambda *a: cv(*a, sweeps=4), parameters(4, 5))
    assert torch.autograd.gradcheck(lambda *a: wcv(*a, *fixed, sweeps=4), parameters(4, 5))


def test_the_derivative_of_weighted_least_squares_also_by_its_weights():
    random = np.random.default_rng(0)
    r = random.standard_normal((2, 2, 3, 3))
    r[0, ..., -1] = r[1, ..., -1, :] = 0
    weights, screen = random.uniform(0.5, 2, (2, 1, 3, 3)), random.uniform(0.1, 1, (1, 3, 3))
    arguments = [torch.from_numpy(a).requires_grad_() for a in (r, screen, weights)]

    def solution(r, screen, weights):
        # The unused differences have no equation.
        mask = torch.ones_like(weights)
        mask[0, ..., -1], mask[1, ..., -1, :] = 0, 0
        return solve_weighted(r * mask, screen, weights * mask, 1e-13)[0]

    assert torch.autograd.gradcheck(solution, arguments, atol=1e-6, check_undefined_grad=False)


def test_derivatives_are_finite_everywhere():
    _, *data, variances = noisy_stack(20, 21)
    data[0][3:9, 4:9], data[1][:], data[2][:] = 0, 0, 0  # residuals of exactly zero
    for method in (l1, lambda *a: wl2(*a, *map(torch.from_numpy, variances))):
        arguments = [torch.from_numpy(a).requires_grad_() for a in data]
        (method(*arguments) ** 2).sum().backward()
        assert all(torch.isfinite(a.grad).all() and a.grad.abs().sum() > 0 for a in arguments)


def test_the_derivative_of_wl2_is_that_of_finite_differences():
    _, *data, variances = noisy_stack(7, 6, dtype=np.float64)
    weights = [torch.from_numpy(v) for v in variances]
    arguments = [torch.from_numpy(a).requires_grad_() for a in data]
    wl2(*arguments, *weights)[3, 2, 1].backward()
    step = torch.zeros_like(arguments[0])
    step[4, 3] = 1e-3
    with torch.no_grad():
        change = wl2(arguments[0] + step, *arguments[1:], *weights) - wl2(arguments[0] - step, *arguments[1:], *weights)
    assert (arguments[0].grad * step).sum() == pytest.approx(float(change[3, 2, 1] / 2), rel=0.05)
