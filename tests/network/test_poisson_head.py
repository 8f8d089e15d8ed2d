"""The head that draws an image toward the gradients: what it solves, and what it leaves alone."""

import numpy as np
import pytest
import torch
from solvers import solve_sparse
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


def test_many_sweeps_solve_the_equation():
    """Against a direct solver, with weights of all sizes: what the network says counts as e to that many powers."""
    _, blurred, (dx, dy, _, _) = scene()
    noise = 0.02 + 0.2 * torch.rand(2, 1, 1, H, W)
    logits = torch.zeros(1, 3 * poisson.SCALES, H, W)
    logits[:, :3] = torch.randn(1, 3, H, W)
    result = solved(blurred, [dx, dy, *noise], 1000, logits).double().numpy()[0]
    powers = poisson.RANGE * torch.tanh(logits[0, :3].double() / poisson.RANGE)
    variances = [torch.full((H, W), poisson.IMAGE_VARIANCE), *(noise[:, 0, 0] ** 2 + poisson.LEAST_VARIANCE)]
    own, right, below = ((torch.exp(p) / v).numpy() for p, v in zip(powers, variances, strict=True))
    weights = np.concatenate([own.ravel(), right[:, :-1].ravel(), below[:-1].ravel()])
    layers = (layer[0].permute(1, 2, 0).double().numpy() for layer in (blurred, dx, dy))
    assert np.abs(result.transpose(1, 2, 0) - solve_sparse(*layers, 1.0, weights)).max() < 1e-4


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
