"""Variance-weighted least squares: every equation counts by how well it is known.

    wl2   min  Σ |I - P|² / var P  +  Σ |∇I - G|² / var G

The maximum-likelihood image for independent normal noise of these variances. Colours share a weight, see
``ngpt.classical.variances``, and there is no α: the variances are what α stands in for.

Solved by conjugate gradients with the cosine transforms as preconditioner (``ngpt.classical.leastsquares``). Memory in
bytes per pixel of three float32 channels, beyond the 72 of the input: 165 with the output.
"""

import numpy as np

from ngpt.classical.leastsquares import Equations, solve_weighted
from ngpt.classical.variances import smooth_variances

# Relative residual at which to stop.
TOLERANCE = 1e-4


def wl2(
    primal: np.ndarray,
    dx: np.ndarray,
    dy: np.ndarray,
    primal_var: np.ndarray,
    dx_var: np.ndarray,
    dy_var: np.ndarray,
    trusted: tuple[np.ndarray, np.ndarray] | None = None,
) -> np.ndarray:
    """The variance-weighted least-squares image, (H, W, C) in the units of ``primal``.

    ``*_var`` (H, W, C) are variances of the pixel means; missing values may be NaN. Other arguments as of
    ``ngpt.classical.poisson.l2``. Linear in (primal, dx, dy) for given variances.
    """
    equations = Equations(primal, dx, dy, trusted)
    r, scale = equations.scaled_residual()
    variances = smooth_variances(primal_var, dx_var, dy_var, trusted)
    screen, weights = (1 / variance.astype(r.dtype, copy=False) for variance in variances)
    u, _ = solve_weighted(r, screen, weights, TOLERANCE)
    return equations.image(u, scale)
