"""Variance-weighted least squares: every equation counts by how well it is known.

    wl2   min  Σ |I - P|² / var P  +  Σ |∇I - G|² / var G

The maximum-likelihood image for independent normal noise of these variances. Colours share a weight, see
``ngpt.variances``, and there is no α: the variances are what α stands in for.

Solved by conjugate gradients with the cosine transforms as preconditioner (``ngpt.leastsquares``).
"""

from ngpt.arrays import Array, cast
from ngpt.leastsquares import Equations, solve_weighted
from ngpt.variances import smooth_variances

# Relative residual at which to stop.
TOLERANCE = 1e-4


def wl2(
    primal: Array,
    dx: Array,
    dy: Array,
    primal_var: Array,
    dx_var: Array,
    dy_var: Array,
    trusted: tuple[Array, Array] | None = None,
) -> Array:
    """The variance-weighted least-squares image, (H, W, C) in the units of ``primal``.

    ``*_var`` (H, W, C) are variances of the pixel means; missing values may be NaN. Other arguments as of
    ``ngpt.poisson.l2``. Linear in (primal, dx, dy) for given variances.
    """
    equations = Equations(primal, dx, dy, trusted)
    primal_var, difference_var = (
        cast(v, equations.work) for v in smooth_variances(primal_var, dx_var, dy_var, trusted)
    )
    r, scale = equations.scaled_residual()
    u, _ = solve_weighted(r, 1 / primal_var, 1 / difference_var, TOLERANCE)
    return equations.image(u, scale)
