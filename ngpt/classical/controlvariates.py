"""Reconstruction by iterative control variates: every pixel becomes the mean of its neighbours' estimates of it.

    I_p  <-  Σ_q w_pq (I_q + ΔI_qp)        q over p itself and its four neighbours, ΔI_qp the sampled difference

    cv     w_pq equal                                        [survey eq. 14]
    wcv    w_pq ~ 1 / (f_n var I_p + var ΔI_qp)              [survey eq. 20 - 22]

repeated 50 times from the primal. var I_p, not var I_q: weights of the sender would lose energy. f_n is the factor by
which n iterations have lowered the variance of a pixel; the reference implementation of Rousselle et al. takes 1 /
Π_k≤n (1.01 + 4 · 2⁻ᵏ). It adds 1e-4 to all variances, which depends on exposure; ``ngpt.classical.variances`` has what
we do.

After the first few iterations f_n hardly changes. From there on, ``wcv`` takes 12 steps of different lengths in place
of 44 iterations [scheduled relaxation: Yang and Mittal 2014, "Acceleration of the Jacobi iterative method by factors
exceeding 100 using scheduled relaxation"]. An iteration multiplies a wave by 1 - λ, with λ by its length and the
variances, and a step of length s multiplies it by 1 - s λ. The products over all iterations agree within 0.03.

Memory in bytes per pixel of three float32 channels, beyond the 36 (wcv 72) of the input, with the output: 94.

[Hua et al. 2019, "A Survey on Gradient-Domain Rendering", section 5.2; Rousselle, Jarosz and Novák 2016, "Image-space
Control Variates for Rendering"]
"""

import numpy as np

from ngpt.classical.jacobi import jacobi
from ngpt.classical.leastsquares import Equations
from ngpt.classical.variances import smooth_variances, without_missing

# Iterations of cv.
SWEEPS = 50
# For wcv: iterations by the formula; f and the lengths of the steps after them, found by least squares on the products.
# Short steps remove the short waves that long steps enlarge. In this order no wave is ever larger than at the start.
_FIRST, _LATE = 6, 1 / 85
_STEPS = (0.57, 12.3, 0.592, 12.3, 0.634, 4.29, 0.702, 2.47, 0.807, 1.66, 0.969, 1.225)


def cv(
    primal: np.ndarray,
    dx: np.ndarray,
    dy: np.ndarray,
    trusted: tuple[np.ndarray, np.ndarray] | None = None,
    sweeps: int = SWEEPS,
) -> np.ndarray:
    """Uniform control variates, (H, W, C) in the units of ``primal``; arguments as of ``ngpt.classical.poisson.l2``.

    Linear in (primal, dx, dy). ``sweeps`` of the Jacobi iteration: with more of them, farther pixels count more, up to
    a constant plus the integrated gradients.
    """
    equations = Equations(primal, dx, dy, trusted)
    # Exact differences give equal weights.
    one = np.ones_like(equations.primal[:1])
    exact = without_missing(np.zeros((2, *one.shape[1:]), one.dtype), trusted)
    return _sweep(equations, one, exact, [(1.0, 1.0)] * sweeps)


def wcv(
    primal: np.ndarray,
    dx: np.ndarray,
    dy: np.ndarray,
    primal_var: np.ndarray,
    dx_var: np.ndarray,
    dy_var: np.ndarray,
    trusted: tuple[np.ndarray, np.ndarray] | None = None,
    sweeps: int | None = None,
) -> np.ndarray:
    """Variance-weighted control variates, (H, W, C) in the units of ``primal``.

    ``*_var`` (H, W, C) are variances of the pixel means; missing values may be NaN (``ngpt.classical.variances``).
    Other arguments as of ``ngpt.classical.poisson.l2``. ``sweeps``: only this number of the first sweeps of
    ``schedule``.
    """
    equations = Equations(primal, dx, dy, trusted)
    variances = smooth_variances(primal_var, dx_var, dy_var, trusted)
    return _sweep(equations, *variances, schedule()[:sweeps])


def schedule() -> list[tuple[float, float]]:
    """For each iteration of wcv the factor f of the primal's variance, and the step s: the change counts s times."""
    f, first = 1.0, []
    for n in range(_FIRST):
        f /= 1.01 + 4 * 0.5**n
        first.append((f, 1.0))
    return first + [(_LATE, step) for step in _STEPS]


def _sweep(
    equations: Equations, primal_var: np.ndarray, difference_var: np.ndarray, schedule: list[tuple[float, float]]
) -> np.ndarray:
    """Jacobi sweeps on the correction u = I - P, by ``schedule``.

    With weights relative to a pixel's own, a = f var I / (f var I + var Δ) <= 1, a neighbour's estimate less the
    pixel's value, e, is weighted by a: u += s Σ a e / (1 + Σ a).
    """
    r, scale = equations.scaled_residual()
    return equations.image(jacobi(r, primal_var, difference_var, schedule), scale)
