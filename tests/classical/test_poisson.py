"""l2 against a sparse direct solver, l1 against iteratively reweighted least squares, and the laws of both."""

import numpy as np
import pytest
from scipy import sparse
from scipy.sparse.linalg import spsolve

from ngpt.classical.gradients import forward_differences
from ngpt.classical.poisson import l1, l2
from ngpt.errors import NgptError


def equations(height, width, alpha, trusted=None):
    """The sparse matrix K of the energy, one row per equation, with rows of untrusted differences set to zero."""

    def difference(n):
        return sparse.eye(n - 1, n, k=1) - sparse.eye(n - 1, n)

    along_x = sparse.kron(sparse.eye(height), difference(width))
    along_y = sparse.kron(difference(height), sparse.eye(width))
    if trusted is not None:
        along_x = sparse.diags(trusted[0][:, :-1].ravel().astype(float)) @ along_x
        along_y = sparse.diags(trusted[1][:-1].ravel().astype(float)) @ along_y
    return sparse.vstack([alpha * sparse.eye(height * width), along_x, along_y]).tocsr()


def right_hand_side(primal, dx, dy, alpha):
    return np.concatenate([(alpha * primal).reshape(-1, 3), dx[:, :-1].reshape(-1, 3), dy[:-1].reshape(-1, 3)])


def solve_directly(primal, dx, dy, alpha, trusted=None, weights=None):
    matrix = equations(*primal.shape[:2], alpha, trusted)
    weights = sparse.eye(matrix.shape[0]) if weights is None else sparse.diags(weights)
    normal = (matrix.T @ weights @ matrix).tocsc()
    rhs = matrix.T @ weights @ right_hand_side(primal, dx, dy, alpha)
    return np.stack([spsolve(normal, rhs[:, c]) for c in range(3)], axis=-1).reshape(primal.shape)


def l1_energy(image, primal, dx, dy, alpha):
    residual = equations(*primal.shape[:2], alpha) @ image.reshape(-1, 3) - right_hand_side(primal, dx, dy, alpha)
    return np.sum(np.linalg.norm(residual, axis=1))


@pytest.mark.parametrize("shape", [(17, 23), (1, 7), (5, 1), (2, 2), (1, 1)])
@pytest.mark.parametrize("alpha", [0.01, 0.2, 5.0])
def test_l2_is_the_direct_solution(rng, shape, alpha):
    primal, dx, dy = rng.normal(size=(3, *shape, 3))
    expected = solve_directly(primal, dx, dy, alpha)
    assert np.abs(l2(primal, dx, dy, alpha) - expected).max() < 1e-9
    single = l2(*(a.astype(np.float32) for a in (primal, dx, dy)), alpha)
    assert single.dtype == np.float32
    assert np.abs(single - expected).max() < 2e-5


@pytest.mark.parametrize("alpha", [0.05, 0.2])
def test_l2_without_the_untrusted_differences(rng, alpha):
    primal, dx, dy = rng.normal(size=(3, 13, 18, 3))
    trusted = tuple(rng.random((2, 13, 18)) > 0.1)
    expected = solve_directly(primal, dx, dy, alpha, trusted)
    dx[~trusted[0]], dy[~trusted[1]] = 1e3, -1e3
    assert np.abs(l2(primal, dx, dy, alpha, trusted) - expected).max() < 1e-6


def test_l1_reaches_the_energy_of_reweighted_least_squares(noisy_stack, rng):
    stack, _ = noisy_stack
    primal, dx, dy = (stack[name].astype(np.float64) for name in ("primal", "dx", "dy"))
    outliers = rng.random(primal.shape[:2]) < 0.03
    primal[outliers] += 20
    dx[rng.random(primal.shape[:2]) < 0.02] += 5
    alpha = 0.2
    image = primal
    for i in range(60):  # slow and simple: every step is a direct solve
        matrix = equations(*primal.shape[:2], alpha)
        residual = matrix @ image.reshape(-1, 3) - right_hand_side(primal, dx, dy, alpha)
        weights = 1 / (np.linalg.norm(residual, axis=1) + 0.1 * 0.8**i)
        image = solve_directly(primal, dx, dy, alpha, weights=weights)
    best = l1_energy(image, primal, dx, dy, alpha)
    assert l1_energy(l2(primal, dx, dy), primal, dx, dy, alpha) > 1.1 * best  # the problem is not trivial
    assert l1_energy(l1(primal, dx, dy), primal, dx, dy, alpha) < 1.005 * best


@pytest.mark.parametrize("solver", [l2, l1])
def test_lower_error_than_the_primal(noisy_stack, solver):
    stack, clean = noisy_stack
    error = np.mean((solver(stack["primal"], stack["dx"], stack["dy"]) - clean) ** 2)
    assert error < 0.2 * np.mean((stack["primal"] - clean) ** 2)


def test_l1_ignores_outliers_that_spoil_l2(noisy_stack):
    stack, clean = noisy_stack
    primal = stack["primal"].copy()
    primal[8, 11] = 1e4
    errors = [np.abs(solver(primal, stack["dx"], stack["dy"]) - clean).max() for solver in (l1, l2)]
    assert errors[0] < 0.3 < 10 < errors[1]


@pytest.mark.parametrize("solver", [l2, l1])
@pytest.mark.parametrize("alpha", [1e-3, 0.2, 1e3])
def test_exact_gradients_return_the_image(rng, solver, alpha):
    image = rng.random((9, 14, 3)).astype(np.float32) * 100
    assert np.abs(solver(image, *forward_differences(image), alpha) - image).max() < 1e-4


@pytest.mark.parametrize("solver", [l2, l1])
@pytest.mark.parametrize("k", [2.0**-10, 3.0, 2.0**10])
def test_follows_the_exposure(noisy_stack, solver, k):
    stack, _ = noisy_stack
    layers = [stack[name] for name in ("primal", "dx", "dy")]
    scaled = solver(*(np.float32(k) * layer for layer in layers))
    assert np.abs(scaled / k - solver(*layers)).max() < 1e-4


@pytest.mark.parametrize("solver", [l2, l1])
def test_mirrored_and_transposed_input(noisy_stack, solver):
    stack, _ = noisy_stack
    primal, dx, dy = (stack[name].astype(np.float64) for name in ("primal", "dx", "dy"))
    image = solver(primal, dx, dy)
    mirrored_dx = np.zeros_like(dx)
    mirrored_dx[:, :-1] = -dx[:, -2::-1]
    assert np.allclose(solver(primal[:, ::-1], mirrored_dx, dy[:, ::-1]), image[:, ::-1], atol=1e-9)
    transposed = solver(*(a.transpose(1, 0, 2) for a in (primal, dy, dx)))
    assert np.allclose(transposed, image.transpose(1, 0, 2), atol=1e-9)


def test_l2_is_additive_over_light_groups(rng):
    groups = rng.normal(size=(2, 3, 11, 9, 3))
    total = l2(*groups.sum(axis=0))
    assert np.allclose(l2(*groups[0]) + l2(*groups[1]), total, atol=1e-10)


def test_l2_keeps_the_mean_even_for_tiny_alpha(rng):
    primal, dx, dy = rng.random((3, 40, 30, 3)).astype(np.float32)
    image = l2(primal, dx, dy, alpha=1e-6)
    assert np.abs(image.mean(axis=(0, 1)) - primal.mean(axis=(0, 1))).max() < 1e-4


@pytest.mark.parametrize("alpha", [0.0, -1.0, np.nan, np.inf])
def test_alpha_must_be_positive(rng, alpha):
    with pytest.raises(NgptError, match="alpha"):
        l2(*rng.normal(size=(3, 4, 4, 3)), alpha)
