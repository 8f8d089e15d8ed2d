"""Reconstruction by iterative control variates: every pixel becomes the mean of what its neighbours say it is.

    I_p  <-  Σ_q w_pq (I_q + ΔI_qp)        q over p itself and its four neighbours, ΔI_qp the sampled difference

    cv     w_pq equal                                        [survey eq. 14]
    wcv    w_pq ~ 1 / (f_n var I_p + var ΔI_qp)              [survey eq. 20 - 22]

repeated 50 times from the primal. var I_p, not var I_q: weights of the sender would lose energy. f_n is by how much n
iterations have lowered the variance of a pixel; the reference implementation of Rousselle et al. takes 1 / Π_k≤n
(1.01 + 4 · 2⁻ᵏ). It adds 1e-4 to all variances, which depends on exposure; ``ngpt.classical.variances`` has what we do.

Memory in bytes per pixel of three float32 channels, beyond the 36 (wcv 72) of the input, with the output: 94.

[Hua et al. 2019, "A Survey on Gradient-Domain Rendering", section 5.2; Rousselle, Jarosz and Novák 2016, "Image-space
Control Variates for Rendering"]
"""

import numpy as np

from ngpt.classical.arrays import Array
from ngpt.classical.gradients import differences
from ngpt.classical.jacobi import jacobi
from ngpt.classical.leastsquares import Equations
from ngpt.classical.variances import smooth_variances, without_missing

SWEEPS = 50


def cv(primal: Array, dx: Array, dy: Array, trusted: tuple[Array, Array] | None = None, sweeps: int = SWEEPS) -> Array:
    """Uniform control variates, (H, W, C) in the units of ``primal``; arguments as of ``ngpt.classical.poisson.l2``.

    Linear in (primal, dx, dy). ``sweeps`` of the Jacobi iteration: more take more from further pixels, down to a
    constant plus the integrated gradients.
    """
    equations = Equations(primal, dx, dy, trusted)
    # Equal weights are those of exact differences.
    one = equations.xp.ones_like(equations.primal[:1])
    exact = without_missing(equations.xp.zeros_like(equations.xp.stack([one[0], one[0]])), trusted)
    return _sweep(equations, one, exact, [1.0] * sweeps)


def wcv(
    primal: Array,
    dx: Array,
    dy: Array,
    primal_var: Array,
    dx_var: Array,
    dy_var: Array,
    trusted: tuple[Array, Array] | None = None,
    sweeps: int = SWEEPS,
) -> Array:
    """Variance-weighted control variates, (H, W, C) in the units of ``primal``.

    ``*_var`` (H, W, C) are variances of the pixel means; missing values may be NaN (``ngpt.classical.variances``).
    Other arguments as of ``ngpt.classical.poisson.l2``.
    """
    equations = Equations(primal, dx, dy, trusted)
    variances = smooth_variances(primal_var, dx_var, dy_var, trusted)
    return _sweep(equations, *variances, decay(sweeps))


def decay(sweeps: int) -> list[float]:
    """f_n for the iterations n = 0 .. sweeps - 1, the factors of the primal's variance."""
    f, factors = 1.0, []
    for n in range(sweeps):
        f /= 1.01 + 4 * 0.5**n
        factors.append(f)
    return factors


def _sweep(equations: Equations, primal_var: Array, difference_var: Array, factors: list[float]) -> Array:
    """Jacobi sweeps on the correction u = I - P, one for each factor of the primal's variance.

    With weights relative to a pixel's own, a = f var I / (f var I + var Δ) <= 1, what a neighbour says beyond the
    pixel's value e is weighted by a: u += Σ a e / (1 + Σ a).
    """
    r, scale = equations.scaled_residual()
    if isinstance(r, np.ndarray):
        return equations.image(jacobi(r, primal_var, difference_var, factors), scale)
    u = equations.xp.zeros_like(r[0])
    for factor in factors:
        u = _swept(u, r, factor * primal_var, difference_var)
    return equations.image(u, scale)


def _swept(u: Array, r: Array, own: Array, difference_var: Array) -> Array:
    """The correction after one more sweep; ``own`` (1, H, W) is f var I. ``jacobi`` does the same on NumPy arrays."""
    vx, vy = difference_var
    dx, dy = differences(u, 0, u.shape[1])
    ex, ey = dx - r[0], dy - r[1]
    right, below = own / (own + vx), own / (own + vy)
    left, above = own[..., 1:] / (own[..., 1:] + vx[..., :-1]), own[:, 1:] / (own[:, 1:] + vy[:, :-1])
    weight = 1 + right + below
    weight[..., 1:] += left
    weight[:, 1:] += above
    change = right * ex + below * ey
    change[..., 1:] -= left * ex[..., :-1]
    change[:, 1:] -= above * ey[:, :-1]
    return u + change / weight
