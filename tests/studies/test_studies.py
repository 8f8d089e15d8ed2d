"""Methods of section 5 of the survey: each against an independent solution, and laws of all."""

import numpy as np
import pytest
from full_stack import full_stack
from solvers import energy, l1_by_irls, noisy_stack, operator, right_hand_side, solve_sparse

import ngpt
from ngpt.classical.gradients import forward_differences
from ngpt.classical.leastsquares import Equations
from ngpt.methods import by_standing
from ngpt.repair import repair
from ngpt.stack import GradientStack
from ngpt.studies import patches as patches_module
from ngpt.studies.bcd import collaborative
from ngpt.studies.norms import irls
from ngpt.studies.patches import Windows, design
from ngpt.studies.resampling import resampled

ROWS = ("irls", "wl1", "patches", "nfor-wcv", "nfor-l1", "nfor-wcv-alone", "bcd", "bcd-wl2", "bcd-l1")
every_row = pytest.mark.parametrize("name", ROWS)


def image_of(name, stack):
    return ngpt.denoise(stack, name)


def window_matrix(f, radius, w):
    """Σ_i w_i (window i less its regression on f), a dense matrix on images in row order, with our ridge."""
    height, width = f.shape[1:]
    total = np.zeros((height * width,) * 2)
    number = np.arange(height * width).reshape(height, width)
    for y in range(height):
        for x in range(width):
            here = np.s_[max(y - radius, 0) : y + radius + 1, max(x - radius, 0) : x + radius + 1]
            place = number[here].ravel()
            F = f[:, here[0], here[1]].reshape(len(f), -1).T
            ridge = patches_module.RIDGE * len(place) * np.diag([0.0] + [1.0] * (len(f) - 1))
            left = np.eye(len(place)) - F @ np.linalg.solve(F.T @ F + ridge, F.T)
            total[np.ix_(place, place)] += w[y, x] * left
    return total


def test_patches_solve_what_a_dense_solver_solves(rng):
    _, primal, dx, dy, _ = noisy_stack(9, 12, dtype=np.float64)
    f = design({"albedo": rng.random((9, 12, 2)), "flat": np.ones((9, 12, 1))}, (9, 12))
    assert len(f) == 3 and np.ptp(f[1:], axis=(1, 2)) == pytest.approx(1, abs=0.1)
    screen, w = rng.random((1, 9, 12)) + 0.1, rng.random((9, 12)) * 3
    weights = rng.random((2, 1, 9, 12)) + 0.1
    weights[0, ..., -1], weights[1, ..., -1, :] = 0, 0
    r, scale = Equations(primal, dx, dy).scaled_residual()
    u = patches_module.solve(r, screen, weights, Windows(f, 2), w, np.moveaxis(primal, -1, 0) / scale, 1e-10)
    K, b = operator(9, 12, 1.0), right_hand_side(primal, dx, dy, 1.0)
    W = np.concatenate([screen.ravel(), weights[0, 0, :, :-1].ravel(), weights[1, 0, :-1].ravel()])
    matrix = (K.T.multiply(W) @ K).toarray() + window_matrix(f, 2, w)
    expected = np.linalg.solve(matrix, K.T @ (W[:, None] * b)).reshape(primal.shape)
    assert np.allclose(primal + scale * np.moveaxis(u, 0, -1), expected, atol=1e-6)
    # And windows do something: without them the solution is another.
    without = solve_sparse(primal, dx, dy, 1.0, W)
    assert np.abs(without - expected).max() > 0.01


def test_what_windows_leave_is_what_regression_leaves(rng):
    f = design({"albedo": rng.random((7, 8, 1))}, (7, 8))
    u, one = rng.standard_normal((1, 7, 8)), np.zeros((7, 8))
    one[3, 4] = 1
    left = u.ravel() @ window_matrix(f, 1, one) @ u.ravel() / 9
    assert Windows(f, 1).residual(u)[3, 4] == pytest.approx(left)
    # What is linear in the features leaves nothing but the ridge.
    assert Windows(f, 1).residual(3 + 2 * f[1:]).max() < 0.1 * Windows(f, 1).residual(f[1:] ** 2 * 10).max()


def test_patches_know_what_features_tell(rng, monkeypatch):
    """A texture that the albedo tells, and noise on all the rest."""
    monkeypatch.setattr(patches_module, "STRENGTH", 1.0)
    albedo = 0.2 + 0.6 * (np.mgrid[:32, :32].sum(0) // 3 % 2)[..., None] * np.ones(3)
    clean = {"primal": albedo, "dx": forward_differences(albedo)[0], "dy": forward_differences(albedo)[1]}
    layers = {name: layer + 0.2 * rng.standard_normal(layer.shape) for name, layer in clean.items()}
    layers |= {f"{name}_var": np.full(albedo.shape, 0.04) for name in clean}
    features = {"albedo": albedo, "normal": np.zeros(albedo.shape), "depth": np.ones((32, 32, 1))}
    stack = GradientStack.from_arrays(**layers, **features)
    error = {name: np.mean((image_of(name, stack) - albedo) ** 2) for name in ("wl2", "patches")}
    assert error["patches"] < 0.5 * error["wl2"]


@pytest.mark.parametrize("seed", [0, 1])
def test_irls_has_the_energy_of_l1(seed):
    _, primal, dx, dy, _ = noisy_stack(24, 20, seed)
    image = irls(repair(GradientStack.from_arrays(primal=primal, dx=dx, dy=dy)), 0.2)
    data = [a.astype(np.float64) for a in (primal, dx, dy)]
    assert energy(image, *data, 0.2) < 1.01 * energy(l1_by_irls(*data, 0.2), *data, 0.2)


def test_collaborative_denoising_lowers_noise_and_keeps_edges(rng):
    clean = np.ones((40, 48, 3)) * [1, 2, 3]
    clean[:, 24:] *= 4
    clean[20:] *= 2
    deviation = 0.2 * clean
    noisy = clean + deviation * rng.standard_normal(clean.shape)
    image = collaborative(noisy, deviation**2)
    assert image.dtype == np.float32
    assert np.mean((image / clean - 1) ** 2) < 0.1 * 0.2**2
    assert np.mean(image[:, 22:26] / clean[:, 22:26]) == pytest.approx(1, abs=0.05)
    # Without noise there is nothing to do, whatever the image.
    detail = rng.random((16, 16, 3)).astype(np.float32)
    assert np.allclose(collaborative(detail, np.zeros_like(detail)), detail, atol=1e-4)


def test_every_row_is_a_study():
    assert {*ROWS, "nlm"} == set(by_standing("study"))


def test_resampling_draws_each_pixel_from_its_runs_and_gradients_apart(rng):
    runs = [full_stack(40, 50, seed=i) for i in range(4)]
    merged = runs[0].replace(**{name: np.mean([run[name] for run in runs], axis=0) for name in ("primal", "dx", "dy")})
    found = [resampled(runs, merged, seed) for seed in range(40)]
    for name in ("primal", "dx", "dy"):
        draws, among = np.stack([f[name] for f in found]), np.stack([run[name] for run in runs])
        # Means over draws are those of runs, and their variance that of four of them drawn with replacement.
        deviation = among.std(axis=0) / 2
        assert np.abs(draws.mean(0) - merged[name])[deviation > 0].mean() < 0.2 * deviation[deviation > 0].mean()
        assert (draws.var(0).sum() / (deviation**2).sum()) == pytest.approx(1, abs=0.05)
    # The first run four times happens once in 256 times, to the primal and to dx apart.
    single = [
        (np.stack([f[name] for f in found])[:, :, 1:-1] == runs[0][name][:, 1:-1]).all(-1) for name in ("primal", "dx")
    ]
    assert single[0].mean() == pytest.approx(1 / 256, rel=0.3)
    assert (single[0] & single[1]).mean() < 3e-4
    same = resampled([runs[0]] * 4, runs[0])
    assert np.allclose(same["primal"], runs[0]["primal"])


@every_row
def test_exposure_only_scales(name):
    one, two = (image_of(name, full_stack(18, 26, scale)) for scale in (1.0, 1024.0))
    assert one.dtype == np.float32 and np.allclose(1024 * one, two, rtol=0.01, atol=0.01 * np.abs(two).max())
    assert np.abs(one - full_stack(18, 26)["primal"]).max() > 0.01


@every_row
@pytest.mark.parametrize("size", [(1, 1), (1, 9), (9, 1), (2, 3)])
def test_any_size(name, size):
    assert np.isfinite(image_of(name, full_stack(*size))).all()


@every_row
def test_pixels_that_are_not_finite_do_not_spread(name):
    stack = full_stack(18, 26)
    layers = {layer: stack[layer].copy() for layer in ("primal", "dx", "dy", "primal_var", "albedo")}
    for layer in layers.values():
        layer[5:8, 6:9], layer[12, 3, 1] = np.nan, np.inf
    image = image_of(name, stack.replace(**layers))
    assert np.isfinite(image).all() and image.max() < 3 * stack["primal"].max()


@every_row
def test_exact_gradients_without_noise_return_the_image(name, rng):
    image = rng.random((20, 30, 3)).astype(np.float32) + 0.1
    dx, dy = forward_differences(image)
    zero = {f"{layer}_var": np.zeros_like(image) for layer in ("primal", "dx", "dy")}
    features = {"albedo": image, "normal": np.zeros_like(image), "depth": np.ones((20, 30, 1), np.float32)}
    result = image_of(name, GradientStack.from_arrays(primal=image, dx=dx, dy=dy, **zero, **features))
    assert np.abs(result - image).max() < 2e-3
