"""Robust reconstructions by reweighted least squares: the survey's L1, as the paper solves it, and with variances.

    irls   min  Σ α ‖I - P‖ + Σ ‖∇I - G‖                          what ``l1`` minimises by ADMM
    wl1    min  Σ ‖I - P‖ / σ P  +  Σ ‖∇I - G‖ / σ G              each norm in units of its standard deviation

A solve by least squares weighs each residual by 1 / (its norm in the image before + ε), and ε falls from step to step.
[Hua et al. 2019, section 5.1; Lehtinen et al. 2013]
"""

import numpy as np

from ngpt.classical.arrays import cast
from ngpt.classical.energy import keep_energy
from ngpt.classical.gradients import differences
from ngpt.classical.leastsquares import Equations, robust_mean, solve_weighted
from ngpt.classical.poisson import DEFAULT_ALPHA
from ngpt.classical.variances import smooth_variances
from ngpt.repair import Repaired

STEPS = 11
# ε of the first step, in mean residuals, and what it is multiplied by from step to step
FIRST, FALL = 1.0, 0.5
TOLERANCE = 1e-5


def irls(data: Repaired, alpha: float = DEFAULT_ALPHA) -> np.ndarray:
    """The minimiser of the norms, (H, W, 3) float32; needs gradients."""
    shape = data.image.shape[:2]
    trusted = data.trusted or (np.ones(shape, bool),) * 2
    return _solve(data, np.full((1, *shape), alpha**2), np.stack(trusted).astype(float)[:, None])


def wl1(data: Repaired) -> np.ndarray:
    """The same, weighted by variances, with the energy of the primal; needs variances."""
    of_primal, of_dx, of_dy = data.variances
    p, d = smooth_variances(of_primal, of_dx, of_dy, data.trusted)
    return np.asarray(keep_energy(_solve(data, 1 / p, 1 / d), data.image))


def _solve(data: Repaired, screen: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """The least sum of norms, each times the root of its weight: (1, H, W) and (2, 1, H, W)."""
    equations = Equations(data.image, data.dx, data.dy, data.trusted)
    r, scale = equations.scaled_residual()
    screen, weights = (np.asarray(cast(v, r.dtype)) for v in (screen, weights))
    own, both = screen, weights
    u = np.zeros_like(r[0])
    for step in range(STEPS):
        u = np.asarray(solve_weighted(r, own, both, TOLERANCE)[0])
        e = np.stack(differences(u, 0, u.shape[1])) - r
        of_primal = np.sqrt(screen * (u * u).sum(0, keepdims=True))
        of_differences = np.sqrt(weights * (e * e).sum(1, keepdims=True))
        ε = FIRST * FALL**step * robust_mean(of_primal, of_differences) + 1e-30
        own, both = screen / (of_primal + ε), weights / (of_differences + ε)
    return np.asarray(equations.image(u, scale))
