"""The head that draws an image toward the gradients: what it solves, what it leaves alone, and its graph."""

import numpy as np
import pytest
import torch
from scipy.sparse import coo_matrix, diags
from scipy.sparse.linalg import spsolve
from torch.nn.functional import avg_pool2d

from ngpt.network import poisson
from ngpt.network.model import ModelConfig, Reconstructor
from ngpt.network.poisson import solved

H, W = 16, 24
INPUTS = ("primal", "albedo", "base", "dx_base", "dy_base", "primal_noise", "dx_noise", "dy_noise")


def scene(height=H, width=W, seed=0):
    """An image, the image blurred, its differences, and their relative errors: 0.001 of them all."""
    torch.manual_seed(seed)
    truth = torch.rand(1, 3, height, width) + torch.linspace(0, 2, width)
    blurred = avg_pool2d(truth, 5, 1, 2, count_include_pad=False)
    dx, dy = torch.zeros_like(truth), torch.zeros_like(truth)
    dx[..., :-1], dy[..., :-1, :] = truth.diff(dim=-1), truth.diff(dim=-2)
    noise = torch.full((1, 1, height, width), 1e-3)
    return truth, blurred, [dx, dy, noise, noise.clone()]


def nothing(height=H, width=W):
    return torch.zeros(1, 3 * poisson.SCALES, height, width)


def direct(image, dx, dy, weights):
    """The minimiser by a sparse direct solver: (H, W) each, the weights of image, dx and dy."""
    height, width = image.shape
    at = np.arange(height * width).reshape(height, width)
    matrix, right = diags(weights[0].ravel()).tocsr(), weights[0] * image
    for here, there, d, w in (
        (at[:, :-1], at[:, 1:], dx[:, :-1], weights[1][:, :-1]),
        (at[:-1], at[1:], dy[:-1], weights[2][:-1]),
    ):
        rows = np.arange(here.size).repeat(2)
        columns = np.stack([here.ravel(), there.ravel()], 1).ravel()
        slopes = coo_matrix((np.tile([-1.0, 1.0], here.size), (rows, columns)), (here.size, at.size)).tocsr()
        matrix = matrix + slopes.T @ diags(w.ravel()) @ slopes
        right = right + (slopes.T @ (w * d).ravel()).reshape(height, width)
    return spsolve(matrix.tocsc(), right.ravel()).reshape(height, width)


def test_many_sweeps_solve_the_equation():
    """Against a direct solver, with weights of all sizes: what the network says counts as e to that many powers."""
    _, blurred, (dx, dy, _, _) = scene()
    noise = 0.02 + 0.2 * torch.rand(2, 1, 1, H, W)
    logits = nothing()
    logits[:, :3] = torch.randn(1, 3, H, W)
    result = solved(poisson._Torch, blurred, logits, [dx, dy, noise[0], noise[1]], 2000).double().numpy()[0]
    powers = poisson.RANGE * torch.tanh(logits[0, :3].double() / poisson.RANGE)
    variances = [torch.full((H, W), poisson.IMAGE_VARIANCE), *(noise[:, 0, 0] ** 2 + poisson.LEAST_VARIANCE)]
    weights = [(torch.exp(p) / v).numpy() for p, v in zip(powers, variances, strict=True)]
    for colour in range(3):
        layers = (layer[0, colour].double().numpy() for layer in (blurred, dx, dy))
        assert np.abs(result[colour] - direct(*layers, weights)).max() < 1e-4


def test_wide_errors_go_by_the_coarse_resolutions():
    """A whole half of the image is too bright; one step at the finest resolution alone would not see it."""
    truth, _, gradients = scene(64, 64)
    wrong = truth.clone()
    wrong[..., 16:32, 16:32] += 1
    result = solved(poisson._Torch, wrong, nothing(64, 64), gradients, 4)
    assert (result - truth)[..., 22:26, 22:26].abs().mean() < 0.4


def test_a_difference_that_the_network_distrusts_changes_nothing():
    truth, _, (dx, dy, x_noise, y_noise) = scene()
    dx[..., 7, 9] = 1e3
    logits = nothing()
    noisy = solved(poisson._Torch, truth, logits, [dx, dy, x_noise, y_noise], 4)
    assert (noisy - truth).abs().max() > 50
    by_variance = x_noise.clone()
    by_variance[..., 7, 9] = 1e6
    assert (solved(poisson._Torch, truth, logits, [dx, dy, by_variance, y_noise], 4) - truth).abs().max() < 0.1
    logits[:, 1, 7, 9] = -50
    assert (solved(poisson._Torch, truth, logits, [dx, dy, x_noise, y_noise], 4) - noisy).abs().max() > 40


def test_what_the_gradients_agree_with_stays_as_it_is():
    truth, _, gradients = scene()
    for noise in (0.0, 1e-3, 10.0):
        gradients[2:] = [torch.full_like(layer, noise) for layer in gradients[2:]]
        result = solved(poisson._Torch, truth, torch.randn(1, 3 * poisson.SCALES, H, W), gradients, 4)
        assert torch.allclose(result, truth, atol=2e-5)


@pytest.mark.parametrize("axis", [poisson._X, poisson._Y])
def test_coarser_differences_are_those_of_the_coarser_image(axis):
    truth, _, (dx, dy, _, _) = scene()
    difference, plain = (dx, torch.ones(1, 1, H, W)) if axis == poisson._X else (dy, torch.ones(1, 1, H, W))
    coarse, weight = poisson._coarser(poisson._Torch, difference, poisson._Torch.inside(plain, axis), axis)
    expected = avg_pool2d(truth, 2).diff(dim=axis)
    kept = [slice(None)] * 4
    kept[axis] = slice(0, -1)
    assert torch.allclose(coarse[tuple(kept)], expected, atol=1e-5)
    # Two rows of variance 1/4 + 1 + 1/4 each; nothing in the last place, which has no next one.
    assert torch.allclose(weight[tuple(kept)], torch.tensor(2 / 1.5)) and weight.select(axis, -1).max() < 1e-10


def config(**changes):
    values = {"network": "plain", "channels": (4, 4, 4, 4), "units": (), "inputs": INPUTS, "base": "wcv", "sweeps": 2}
    return ModelConfig(**values | changes)


def test_training_reaches_what_is_said_of_the_gradients():
    torch.manual_seed(0)
    model = Reconstructor(config())
    truth, blurred, (dx, dy, _, _) = scene(32, 32)
    layers = {"primal": truth, "albedo": truth.clamp(0, 1), "base": blurred, "dx": dx, "dy": dy}
    layers |= {name: torch.rand(1, 3, 32, 32) for name in ("primal_se", "dx_se", "dy_se")}
    model(layers).square().mean().backward()
    gradient = model.network.head.convolution.weight.grad
    assert torch.isfinite(gradient).all() and all(gradient[3 + i].abs().max() > 0 for i in range(3 * poisson.SCALES))
