"""Screened Poisson reconstruction: the image near the primal whose differences are the sampled gradients.

    l2   min  Σ α² |I - P|²   + Σ |∇I - G|²     exact, by cosine transforms
    l1   min  Σ α ‖I - P‖     + Σ ‖∇I - G‖      robust to outliers, by ADMM around the same transforms

P is the primal image, G the sampled gradients; sums run over pixels and differences, ‖.‖ is the Euclidean norm over the
colour channels, so that l1 treats a colour as one vector. Forward differences with Neumann boundaries: no equation
crosses the border. α multiplies the residual, as in the reference implementations (0.2 there and here).

Both solve for the correction u = I - P, whose right-hand side ∇ᵀ(G - ∇P) has mean zero: exact gradients return the
primal as it is for every α, and the mean of the image is kept exactly by l2 even where α² vanishes beside rounding.

Memory in bytes per pixel of three float32 channels, beyond the 36 of the input and with the 12 of the output: l2 16
(and 10 MB for bands of rows), l1 165; ``tests/classical/test_classical.py`` holds them to it.
Twice as much where the range of the input asks for double precision (``ngpt.classical.leastsquares.FLOAT32_RANGE``).

[Hua et al. 2019, "A Survey on Gradient-Domain Rendering", eq. 5 and section 5; Bhat et al. 2008, "Fourier Analysis of
the 2D Screened Poisson Equation for Gradient Domain Problems"]
"""

import numpy as np

from ngpt.classical.arrays import by_rows, empty
from ngpt.classical.gradients import adjoint_by_rows, differences
from ngpt.classical.leastsquares import Equations, robust_mean, solve, solve_weighted, sum_of
from ngpt.errors import NgptError

DEFAULT_ALPHA = 0.2

# ADMM: over-relaxation, and the threshold in units of the mean residual, 1 + FIRST_STRIDE · DECAYⁿ. Long strides at
# first move the outliers; with only short strides this takes hundreds of iterations. Among twenty such schedules, this
# one takes the fewest iterations to within 0.5 % of the minimum in the worst of eight stacks: 46, and 28 to 41 in the
# others.
RELAXATION = 1.6
FIRST_STRIDE = 300.0
DECAY = 0.75

# Iterations over which progress is judged, once the strides have become short.
WINDOW = 5


def l2(
    primal: np.ndarray,
    dx: np.ndarray,
    dy: np.ndarray,
    alpha: float = DEFAULT_ALPHA,
    trusted: tuple[np.ndarray, np.ndarray] | None = None,
) -> np.ndarray:
    """The exact minimiser of the squared energy, (H, W, C) in the units of ``primal``.

    ``primal``, ``dx``, ``dy``  (H, W, C) float32 or float64, finite; last column of dx and row of dy are ignored
    ``alpha``    weight of the primal's residual, > 0: small trusts the gradients, large the primal
    ``trusted``  for dx and dy, (H, W) booleans: a difference marked False gets no weight

    Linear in (primal, dx, dy), so reconstructions of light groups add up to the reconstruction of their sum. Untrusted
    differences are left to conjugate gradients (``leastsquares.solve_weighted``), to 1e-8 of the residual.
    """
    check_alpha(alpha)
    equations = Equations(primal, dx, dy, trusted)
    if trusted is None:
        u = solve(equations.divergence(), float(alpha) ** 2, mean=0.0)
        return equations.image(u, out=u)
    r, scale = equations.scaled_residual()
    weights = np.stack(trusted).astype(r.dtype)[:, None]
    u, _ = solve_weighted(r, float(alpha) ** 2, weights, tolerance=1e-8)
    return equations.image(u, scale)


def l1(
    primal: np.ndarray,
    dx: np.ndarray,
    dy: np.ndarray,
    alpha: float = DEFAULT_ALPHA,
    trusted: tuple[np.ndarray, np.ndarray] | None = None,
    tolerance: float = 7e-4,
    max_iterations: int = 300,
) -> np.ndarray:
    """The minimiser of the sum of norms, (H, W, C); arguments as of ``l2``.

    Stops when five iterations lower the energy by less than ``tolerance`` of it, which leaves it within 0.5 % of the
    minimum. Robust to outliers, but not linear, and it darkens where few bright samples carry the energy: the norm
    seeks the median where l2 seeks the mean.
    """
    check_alpha(alpha)
    equations = Equations(primal, dx, dy, trusted)
    r, scale = equations.scaled_residual()
    u, _ = least_norms(r, float(alpha), trusted, tolerance, max_iterations)
    return equations.image(u, scale)


def least_norms(
    r: np.ndarray, alpha: float, trusted, tolerance: float, max_iterations: int
) -> tuple[np.ndarray, list[float]]:
    """The correction u (C, H, W) that minimises Σ ‖K u - (0, r)‖, K = (α, ∂x, ∂y), and the energies on the way.

    (These begin once the strides are short; a norm beyond a thousand times the mean of the first counts as a thousand.)

    ``r`` (2, C, H, W) of a magnitude near 1, as ``Equations.scaled_residual`` gives it.

    ADMM [Boyd et al. 2011, "Distributed Optimization and Statistical Learning via ADMM", section 3.4] on the residuals
    e = K u - r, whose inner problem KᵀK u = Kᵀ(...) is again the one the transforms solve. In the form of Douglas and
    Rachford, s = e + scaled dual variable is all the state: shrink(s) = factor · s is the residual to aim at.
    """
    channels = len(r[0])
    # 1 for every equation that counts; the unused column and row have residual 0 and count for nothing.
    counts = np.ones_like(r[:1, :1]) if trusted is None else _counts(r, trusted)

    def residual(u, first, last):
        e = np.stack([alpha * u[:, first:last], *differences(u, first, last)])
        e[1:] -= r[..., first:last, :]
        return e

    def norm(e):
        # The tiny number keeps thresholds over norms finite.
        return np.sqrt((e * e).sum(1, keepdims=True) + 1e-30)

    def start(first, last):
        e = residual(u, first, last)
        return e, norm(e)

    def iterate(first, last):
        e, previous = residual(u, first, last), s[:, :, first:last]
        energy = sum_of(norm(e).clip(None, limit) * counts[:, :, first:last]) if settled else 0.0
        # shrunk + fall (previous - shrunk) + RELAXATION (e - shrunk), where shrunk = factor previous. The dual
        # variable, previous - shrunk, is scaled by the threshold and falls with it.
        new = (fall + (1 - fall - RELAXATION) * factor[:, :, first:last]) * previous
        new += RELAXATION * e
        # The proximal operator of the norm shortens each colour by the threshold; equations that do not count are left
        # as they are.
        shorter = (1 - threshold * counts[:, :, first:last] / norm(new)).clip(0, None)
        v = (2 * shorter - 1) * new
        total = v[0].sum((1, 2), dtype=np.float64)
        v[1:] += r[..., first:last, :]
        return alpha * v[0], v[1], v[2], new, shorter, energy, total

    b, _ = adjoint_by_rows(lambda i, j: (None, *r[..., i:j, :]), empty(r, channels))
    u, free = solve(b, alpha**2, mean=0.0), [empty(b, channels), empty(b, channels)]
    s, norms, _ = by_rows(start, empty(r, 3, channels), empty(r, 3, 1))
    # In units of the mean residual, the iteration follows the exposure of the image. Outliers must not set this unit.
    # They must not decide when to stop either, with an energy that dwarfs the rest of the image.
    mean = robust_mean(norms)
    limit, stride = 1000 * mean, max(FIRST_STRIDE * mean, float(norms.max()) / 10)
    threshold = mean + stride
    factor = np.ones_like(norms)
    energies: list[float] = []
    best = u
    for _ in range(max_iterations if mean > 0 else 0):
        settled = stride < 0.5 * mean
        stride *= DECAY
        fall, threshold = (mean + stride) / threshold, mean + stride
        b, s, factor, bands = adjoint_by_rows(iterate, free.pop(), s, factor)
        energies += [sum(energy for energy, _ in bands)] if settled else []
        better, worse = (best, u) if settled and energies[-1] > min(energies) else (u, best)
        if worse is not better:
            free.append(worse)
        best = better
        if len(energies) > WINDOW and min(energies[:-WINDOW]) < (1 + tolerance) * min(energies):
            break
        u = solve(b, alpha**2, sum(total for _, total in bands) / (alpha * r.shape[2] * r.shape[3]))
    return best, energies


def _counts(r: np.ndarray, trusted) -> np.ndarray:
    """(3, 1, H, W): 1 for the equations that count, 0 for the others; all equations of the primal count."""
    return np.stack([np.ones_like(trusted[0]), *trusted]).astype(r.dtype)[:, None]


def check_alpha(alpha: float) -> None:
    """Raises NgptError unless alpha is a number in 1e-15 .. 1e15, whose square float32 can hold."""
    if not (isinstance(alpha, int | float | np.number) and 1e-15 <= alpha <= 1e15):
        raise NgptError(f"alpha {alpha}: must be a number in 1e-15 .. 1e15; the usual one is {DEFAULT_ALPHA}")
