"""What the tests of the classical reconstructions share: data, methods under one call, and a slow reference for l1."""

import numpy as np
from scipy.sparse import diags, eye, kron, vstack
from scipy.sparse.linalg import splu

from ngpt.classical.controlvariates import cv, wcv
from ngpt.classical.gradients import forward_differences
from ngpt.classical.poisson import l1, l2
from ngpt.classical.weighted import wl2

# Every method as f(primal, dx, dy, variances, trusted).
METHODS = {
    "l2": lambda p, x, y, v, t=None: l2(p, x, y, trusted=t),
    "l1": lambda p, x, y, v, t=None: l1(p, x, y, trusted=t),
    "cv": lambda p, x, y, v, t=None: cv(p, x, y, t),
    "wcv": lambda p, x, y, v, t=None: wcv(p, x, y, *v, t),
    "wl2": lambda p, x, y, v, t=None: wl2(p, x, y, *v, t),
}


def noisy_stack(height, width, seed=0, channels=3, dtype=np.float32, noise=0.3):
    """(truth, primal, dx, dy, variances) of an image with edges and shading, noise that varies, and a few outliers."""
    random = np.random.default_rng(seed)
    y, x = np.mgrid[:height, :width] / max(height, width)
    truth = 0.2 + np.stack([np.sin(9 * x + c) ** 2 * (x + y > 0.6) + y for c in range(channels)], -1)
    layers, variances = [], []
    for image, share in ((truth, 1.0), *((d, 0.15) for d in forward_differences(truth))):
        deviation = share * noise * (0.2 + truth) * random.gamma(1, 1, (height, width, 1))
        outliers = 1 + 30 * (random.random((height, width, 1)) < 0.005)
        layers.append(image + deviation * outliers * random.standard_normal(truth.shape))
        variances.append((deviation * outliers) ** 2 * random.gamma(4, 0.25, truth.shape))
    primal, dx, dy = (a.astype(dtype) for a in layers)
    dx[:, -1], dy[-1] = 0, 0
    return truth.astype(dtype), primal, dx, dy, tuple(v.astype(dtype) for v in variances)


def operator(height, width, alpha):
    """K = (α, ∂x, ∂y) as a sparse matrix on images (H, W) in row order, without the differences that do not exist."""

    def difference(n):
        return diags([-np.ones(n - 1), np.ones(n - 1)], [0, 1], shape=(n - 1, n))

    right, down = kron(eye(height), difference(width)), kron(difference(height), eye(width))
    return vstack([alpha * eye(height * width), right, down]).tocsc()


def residual(image, primal, dx, dy, alpha):
    """K I - b, one row for each equation."""
    channels = primal.shape[-1]
    b = np.concatenate([part.reshape(-1, channels) for part in (alpha * primal, dx[:, :-1], dy[:-1])])
    return operator(*primal.shape[:2], alpha) @ image.reshape(-1, channels).astype(np.float64) - b


def solve_sparse(primal, dx, dy, alpha, weights=None):
    """argmin |W^1/2 (K I - b)|² by a sparse factorisation in double precision."""
    K = operator(*primal.shape[:2], alpha)
    W = diags(np.ones(K.shape[0]) if weights is None else weights)
    b = -residual(np.zeros_like(primal), primal, dx, dy, alpha)
    return splu((K.T @ W @ K).tocsc()).solve(K.T @ (W @ b)).reshape(primal.shape)


def energy(*data):
    """Σ of the colour norms of K I - b: what l1 minimises; arguments as of ``residual``."""
    return np.linalg.norm(residual(*data), axis=1).sum()


def l1_by_irls(primal, dx, dy, alpha, steps=60, regulariser=0.3, shrink=0.75):
    """The l1 image by iteratively reweighted least squares, every step solved exactly: slow and independent of ADMM."""
    data = primal, dx, dy, alpha
    image = solve_sparse(*data)
    scale = np.linalg.norm(residual(image, *data), axis=1).mean()
    for step in range(steps):
        norms = np.linalg.norm(residual(image, *data), axis=1)
        image = solve_sparse(*data, 1 / np.hypot(norms, scale * max(regulariser * shrink**step, 1e-6)))
    return image
