"""Reconstruction by iterative control variates: every pixel becomes the mean of its neighbours' estimates of it.

    I_p  <-  Σ_q w_pq (I_q + ΔI_qp)        q over p itself and its four neighbours, ΔI_qp the sampled difference

    cv     w_pq equal                                        [survey eq. 14]
    wcv    w_pq ~ 1 / (f_n var I_p + var ΔI_qp)              [survey eq. 20 - 22]

repeated 50 times, beginning with the primal. The weights have var I_p: with var I_q, the variance of the neighbour,
they would lose energy. f_n is the factor by which n iterations have lowered the variance of a pixel. The reference
implementation of Rousselle et al. sets f_n = 1 / Π_k≤n (1.01 + 4 · 2⁻ᵏ), and so do we. It also adds 1e-4 to all
variances, which depends on the exposure; ``ngpt.classical.variances`` says what we add.

After the first few iterations f_n hardly changes. From there on, ``wcv`` takes 12 steps of different lengths in place
of 44 iterations [scheduled relaxation: Yang and Mittal 2014, "Acceleration of the Jacobi iterative method by factors
exceeding 100 using scheduled relaxation"]. An iteration multiplies a wave by 1 - λ, where λ depends on the length of
the wave and on the variances. A step of length s multiplies it by 1 - s λ. The product of all factors is within 0.03 of
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
# For wcv: the number of iterations by the formula; then f and the lengths of the steps, found by least squares on the
# products. Short steps remove the short waves that long steps enlarge. In this order, no wave is ever larger than at
# the start.
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

    Linear in (primal, dx, dy). ``sweeps`` is the number of Jacobi iterations. The more there are, the more do distant
    pixels count; in the limit, the image is a constant plus the integrated gradients.
    """
    equations = Equations(primal, dx, dy, trusted)
    # Differences of variance 0 have equal weights.
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
    """(f, s) for each iteration of wcv: the factor of the primal's variance, and the factor of the change."""
    f, first = 1.0, []
    for n in range(_FIRST):
        f /= 1.01 + 4 * 0.5**n
        first.append((f, 1.0))
    return first + [(_LATE, step) for step in _STEPS]


def _sweep(
    equations: Equations, primal_var: np.ndarray, difference_var: np.ndarray, schedule: list[tuple[float, float]]
) -> np.ndarray:
    """Jacobi sweeps on the correction u = I - P, by ``schedule``.

    u += s Σ a e / (1 + Σ a) over the neighbours of a pixel: e is the neighbour's estimate of the pixel, minus the
    pixel's value, and a = f var I / (f var I + var Δ) <= 1 its weight, relative to the pixel's own weight.
    """
    r, scale = equations.scaled_residual()
    return equations.image(jacobi(r, primal_var, difference_var, schedule), scale)
