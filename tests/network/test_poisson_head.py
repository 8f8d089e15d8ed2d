"""The head that draws an image toward the gradients: what it solves, and what it leaves alone."""

import numpy as np
import pytest
import torch
from scipy.sparse import coo_matrix, diags
from scipy.sparse.linalg import spsolve
from torch.nn.functional import avg_pool2d

from ngpt.network import poisson
from ngpt.network.operations import Tensors

H, W = 16, 24


def scene(height=H, width=W):
    """An image, the image blurred, its differences, and their relative errors: 0.001 of them all."""
    torch.manual_seed(0)
    truth = torch.rand(1, 3, height, width) + torch.linspace(0, 2, width)
    dx, dy = torch.zeros_like(truth), torch.zeros_like(truth)
    dx[..., :-1], dy[..., :-1, :] = truth.diff(dim=-1), truth.diff(dim=-2)
    noise = torch.full((1, 1, height, width), 1e-3)
    return truth, avg_pool2d(truth, 5, 1, 2, count_include_pad=False), [dx, dy, noise, noise.clone()]


def solved(image, gradients, sweeps=4, logits=None):
    if logits is None:
        logits = torch.zeros(1, 3 * poisson.SCALES, *image.shape[-2:])
    return poisson.solved(Tensors, image, logits, gradients, sweeps)


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
    logits = torch.zeros(1, 3 * poisson.SCALES, H, W)
    logits[:, :3] = torch.randn(1, 3, H, W)
    result = solved(blurred, [dx, dy, *noise], 1000, logits).double().numpy()[0]
    powers = poisson.RANGE * torch.tanh(logits[0, :3].double() / poisson.RANGE)
    variances = [torch.full((H, W), poisson.IMAGE_VARIANCE), *(noise[:, 0, 0] ** 2 + poisson.LEAST_VARIANCE)]
    weights = [(torch.exp(p) / v).numpy() for p, v in zip(powers, variances, strict=True)]
    for colour in range(3):
        layers = (layer[0, colour].double().numpy() for layer in (blurred, dx, dy))
        assert np.abs(result[colour] - direct(*layers, weights)).max() < 1e-4


def test_wide_errors_go_by_the_coarse_resolutions():
    """A whole part of the image is too bright; one step at only the finest resolution would not see it."""
    truth, _, gradients = scene(64, 64)
    wrong = truth.clone()
    wrong[..., 16:32, 16:32] += 1
    assert (solved(wrong, gradients) - truth)[..., 22:26, 22:26].abs().mean() < 0.4


def test_a_difference_that_the_network_distrusts_changes_nothing():
    truth, _, (dx, dy, x_noise, y_noise) = scene()
    dx[..., 7, 9] = 1e3
    noisy = solved(truth, [dx, dy, x_noise, y_noise])
    assert (noisy - truth).abs().max() > 50
    by_variance, logits = x_noise.clone(), torch.zeros(1, 3 * poisson.SCALES, H, W)
    by_variance[..., 7, 9], logits[:, 1, 7, 9] = 1e6, -50
    assert (solved(truth, [dx, dy, by_variance, y_noise]) - truth).abs().max() < 0.1
    assert (solved(truth, [dx, dy, x_noise, y_noise], logits=logits) - noisy).abs().max() > 40


@pytest.mark.parametrize("noise", [0.0, 1e-3, 10.0])
def test_what_the_gradients_agree_with_stays_as_it_is(noise):
    truth, _, gradients = scene()
    gradients[2:] = [torch.full_like(layer, noise) for layer in gradients[2:]]
    logits = torch.randn(1, 3 * poisson.SCALES, H, W)
    assert torch.allclose(solved(truth, gradients, logits=logits), truth, atol=2e-5)
