"""Reconstruction by iterative control variates: every pixel becomes the mean of its neighbours' estimates of it.

    I_p  <-  Σ_q w_pq (I_q + ΔI_qp)        q over p itself and its four neighbours, ΔI_qp the sampled difference

    cv     w_pq equal                                        [survey eq. 14]
    wcv    w_pq ~ 1 / (f_n var I_p + var ΔI_qp)              [survey eq. 20 - 22]

This is repeated 50 times, beginning with the primal. The weights use var I_p. With var I_q, the variance of the
neighbour, they would lose energy. f_n is the factor by which n iterations have lowered the variance of a pixel:
f_n = 1 / Π_k≤n (1.01 + 4 · 2⁻ᵏ), as in the reference implementation of Rousselle et al. That implementation adds 1e-4
to all variances, which depends on the exposure; see ``ngpt.classical.variances`` for our addend.

After a few iterations f_n hardly changes. From there on, ``wcv`` takes 12 steps of different lengths in place of 44
iterations [scheduled relaxation: Yang and Mittal 2014, "Acceleration of the Jacobi iterative method by factors
exceeding 100 using scheduled relaxation"]. An iteration multiplies a wave by 1 - λ, where λ depends on its wavelength
and on the variances. A step of length s multiplies it by 1 - s λ. The product of all these factors is within 0.03 of
the product over 50 iterations.

Memory in bytes per pixel of three float32 channels: 94 with the output, beyond the 36 (wcv 72) of the input.

[Hua et al. 2019, "A Survey on Gradient-Domain Rendering", section 5.2; Rousselle, Jarosz and Novák 2016, "Image-space
Control Variates for Rendering"]
"""

import numpy as np

from ngpt.classical.jacobi import jacobi
from ngpt.classical.leastsquares import Equations
from ngpt.classical.variances import smooth_variances, without_missing

# Iterations of cv.
SWEEPS = 50
# For wcv: the number of iterations with f_n; then f and the lengths of the steps, which were found by least squares on
# the products. Short steps remove the short waves that long steps enlarge. In this order, no wave ever becomes larger
# than at the start.
_FIRST, _LATE = 6, 1 / 85
_STEPS = (0.57, 12.3, 0.592, 12.3, 0.634, 4.29, 0.702, 2.47, 0.807, 1.66, 0.969, 1.225)


def cv(
    primal: np.ndarray,
    dx: np.ndarray,
    dy: np.ndarray,
    trusted: tuple[np.ndarray, np.ndarray] | None = None,
    sweeps: int = SWEEPS,
) -> np.ndarray:
    """Uniform control variates, (H, W, C) in the units of ``primal``; arguments as for ``ngpt.classical.poisson.l2``.

    Linear in (primal, dx, dy). ``sweeps`` is the number of Jacobi iterations. With more iterations, distant pixels have
    more influence; in the limit, the image is a constant plus the integrated gradients.
    """
    equations = Equations(primal, dx, dy, trusted)
    # With variances of 0, all differences have the same weight.
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
    Other arguments are as for ``ngpt.classical.poisson.l2``. ``sweeps`` limits the sweeps to the first of ``schedule``;
    None: all.
    """
    equations = Equations(primal, dx, dy, trusted)
    variances = smooth_variances(primal_var, dx_var, dy_var, trusted)
    return _sweep(equations, *variances, schedule()[:sweeps])


def schedule() -> list[tuple[float, float]]:
    """(f, s) for each iteration of wcv: the factors of the primal's variance and of the change."""
    f, first = 1.0, []
    for n in range(_FIRST):
        f /= 1.01 + 4 * 0.5**n
        first.append((f, 1.0))
    return first + [(_LATE, step) for step in _STEPS]


def _sweep(
    equations: Equations, primal_var: np.ndarray, difference_var: np.ndarray, schedule: list[tuple[float, float]]
) -> np.ndarray:
    """The image after Jacobi sweeps on the correction u = I - P, one for each entry (f, s) of ``schedule``:

    u += s Σ a e / (1 + Σ a). The sums are over the neighbours of a pixel. e is a neighbour's estimate of the pixel,
    minus the pixel's value, and a = f var I / (f var I + var Δ) <= 1 is its weight, relative to the pixel's own weight.
    """
    r, scale = equations.scaled_residual()
    return equations.image(jacobi(r, primal_var, difference_var, schedule), scale)
