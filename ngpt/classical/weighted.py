"""Variance-weighted least squares: every equation is weighted by its inverse variance.

    wl2   min  Σ |I - P|² / var P  +  Σ |∇I - G|² / var G

This is the most likely image if the noise is normal and independent, with these variances. All colours of a pixel have
the same weight (``ngpt.classical.variances``). The variances take the place of α.

Solved by conjugate gradients with the cosine transforms as preconditioner (``ngpt.classical.leastsquares``). Memory in
bytes per pixel of three float32 channels: 165 with the output, beyond the 72 of the input.
"""

import numpy as np

from ngpt.classical.leastsquares import Equations, solve_weighted
from ngpt.classical.variances import smooth_variances

# The relative residual at which the solver stops.
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

    ``*_var`` (H, W, C) are variances of the pixel means; missing values may be NaN. Other arguments are as for
    ``ngpt.classical.poisson.l2``. Linear in (primal, dx, dy) for given variances.
    """
    equations = Equations(primal, dx, dy, trusted)
    r, scale = equations.scaled_residual()
    variances = smooth_variances(primal_var, dx_var, dy_var, trusted)
    screen, weights = (1 / variance.astype(r.dtype, copy=False) for variance in variances)
    u, _ = solve_weighted(r, screen, weights, TOLERANCE)
    return equations.image(u, scale)
