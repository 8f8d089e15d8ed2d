"""Screened Poisson reconstruction: the image near the primal whose differences are the sampled gradients.

    l2   min  Σ α² |I - P|²   + Σ |∇I - G|²     exact, by cosine transforms
    l1   min  Σ α ‖I - P‖     + Σ ‖∇I - G‖      robust to outliers, by ADMM around the same transforms

P is the primal image, G the sampled gradients. Sums run over pixels and differences. ‖.‖ is the Euclidean norm over the
colour channels, so l1 treats a colour as one vector. Differences are forward differences with Neumann boundaries: no
equation crosses the border. α multiplies the residual, as in the reference implementations (0.2 there and here).

Both solve for the correction u = I - P, whose right-hand side ∇ᵀ(G - ∇P) has mean zero. So with exact gradients the
result is the primal for every α. l2 keeps the mean of the image exactly, even if α² is lost in rounding.

Memory in bytes per pixel of three float32 channels, beyond the 36 of the input and with the 12 of the output: l2 16
(and 10 MB for bands of rows), l1 165; ``tests/classical/test_classical.py`` checks this. It is twice as much if the
range of the input needs double precision (``ngpt.classical.leastsquares.FLOAT32_RANGE``).

[Hua et al. 2019, "A Survey on Gradient-Domain Rendering", eq. 5 and section 5; Bhat et al. 2008, "Fourier Analysis of
the 2D Screened Poisson Equation for Gradient Domain Problems"]
"""

import numpy as np

from ngpt.classical.arrays import by_rows, empty
from ngpt.classical.gradients import adjoint_by_rows, differences
from ngpt.classical.leastsquares import Equations, robust_mean, solve, solve_weighted, sum_of
from ngpt.errors import NgptError

DEFAULT_ALPHA = 0.2

# ADMM: the over-relaxation, and the threshold 1 + FIRST_STRIDE · DECAYⁿ in units of the mean residual. The long strides
# at the beginning move outliers, which would take hundreds of iterations with short strides. Of twenty such schedules,
# this one comes within 0.5 % of the minimum in the fewest iterations on the worst of eight stacks: 46. On the others it
# takes 28 to 41.
RELAXATION = 1.6
FIRST_STRIDE = 300.0
DECAY = 0.75

# The number of iterations over which progress is measured after the strides have become short.
WINDOW = 5


def l2(
    primal: np.ndarray,
    dx: np.ndarray,
    dy: np.ndarray,
    alpha: float = DEFAULT_ALPHA,
    trusted: tuple[np.ndarray, np.ndarray] | None = None,
) -> np.ndarray:
    """The exact minimiser of the squared energy, (H, W, C) in the units of ``primal``.

    ``primal``, ``dx``, ``dy``  (H, W, C) float32 or float64, finite; the last column of dx and row of dy are ignored
    ``alpha``    weight of the primal's residual, > 0: a small one trusts the gradients, a large one the primal
    ``trusted``  (H, W) booleans for dx and dy: a difference that is False has no weight; None trusts all

    Linear in (primal, dx, dy), so reconstructions of light groups add up to the reconstruction of their sum. With
    ``trusted``, the equations are solved by conjugate gradients (``leastsquares.solve_weighted``), to 1e-8 of the
    residual.
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
    """The minimiser of the sum of norms, (H, W, C); arguments are as for ``l2``.

    The iteration stops when five steps lower the sum of norms by less than the share ``tolerance``. It is then within
    0.5 % of the minimum. The result is robust to outliers, but not linear, and too dark where a few bright samples
    carry the light, because the norm leads to medians, and the square to means.
    """
    check_alpha(alpha)
    equations = Equations(primal, dx, dy, trusted)
    r, scale = equations.scaled_residual()
    u, _ = least_norms(r, float(alpha), trusted, tolerance, max_iterations)
    return equations.image(u, scale)


def least_norms(
    r: np.ndarray, alpha: float, trusted, tolerance: float, max_iterations: int
) -> tuple[np.ndarray, list[float]]:
    """The correction u (C, H, W) that minimises Σ ‖K u - (0, r)‖, K = (α, ∂x, ∂y), and the energy after each iteration.

    There is no energy before the strides are short. In an energy, a norm counts at most as a thousand times the mean
    norm at the start. ``r`` (2, C, H, W) has a magnitude near 1, as by ``Equations.scaled_residual``.

    ADMM [Boyd et al. 2011, "Distributed Optimization and Statistical Learning via ADMM", section 3.4] on the residuals
    e = K u - r. The cosine transforms also solve its inner problem KᵀK u = Kᵀ(...). In the form of Douglas and
    Rachford, the only state is s = e + scaled dual variable, and shrink(s) = factor · s is the residual to aim at.
    """
    channels = len(r[0])
    # 1 for every equation that counts. The unused column and row may be 1, because their residual is 0.
    counts = np.ones_like(r[:1, :1]) if trusted is None else _counts(r, trusted)

    def residual(u, first, last):
        e = np.stack([alpha * u[:, first:last], *differences(u, first, last)])
        e[1:] -= r[..., first:last, :]
        return e

    def norm(e):
        # The tiny number keeps ratios of thresholds to norms finite.
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
        # The proximal operator of the norm shortens each colour by the threshold, but not in equations that do not
        # count.
        shorter = (1 - threshold * counts[:, :, first:last] / norm(new)).clip(0, None)
        v = (2 * shorter - 1) * new
        total = v[0].sum((1, 2), dtype=np.float64)
        v[1:] += r[..., first:last, :]
        return alpha * v[0], v[1], v[2], new, shorter, energy, total

    b, _ = adjoint_by_rows(lambda i, j: (None, *r[..., i:j, :]), empty(r, channels))
    u, free = solve(b, alpha**2, mean=0.0), [empty(b, channels), empty(b, channels)]
    s, norms, _ = by_rows(start, empty(r, 3, channels), empty(r, 3, 1))
    # The unit of the iteration is the mean residual, so that it follows the exposure of the image. Outliers must not
    # determine this unit. Their energy may exceed that of all other pixels, so it must not decide when to stop.
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
