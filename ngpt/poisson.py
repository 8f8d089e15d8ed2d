"""Screened Poisson reconstruction: the image near the primal whose differences are the sampled gradients.

    l2   min  Σ α² |I - P|²   + Σ |∇I - G|²     exact, by cosine transforms
    l1   min  Σ α ‖I - P‖     + Σ ‖∇I - G‖      robust to outliers, by ADMM around the same transforms

P is the primal image, G the sampled gradients; sums run over pixels and differences, ‖.‖ is the Euclidean norm over the
colour channels, so that l1 treats a colour as one vector. Forward differences with Neumann boundaries: no equation
crosses the border. α multiplies the residual, as in the reference implementations (default 0.2 there and here).

Both solve for the correction u = I - P, whose right-hand side ∇ᵀ(G - ∇P) has mean zero: exact gradients return the
primal as it is for every α, and the mean of the image is kept exactly by l2 even where α² vanishes beside rounding.

[Hua et al. 2019, "A Survey on Gradient-Domain Rendering", eq. 5 and section 5; Bhat et al. 2008, "Fourier Analysis of
the 2D Screened Poisson Equation for Gradient Domain Problems"]
"""

import numpy as np
from scipy.fft import dctn, idctn

from ngpt.errors import NgptError
from ngpt.gradients import adjoint_differences, forward_differences

DEFAULT_ALPHA = 0.2

# ADMM: strength of the quadratic coupling in units of the mean residual, and over-relaxation. 1/2 needs the fewest
# iterations to within 1 % of the minimum in the worst of six stacks of our built-in scenes (docs/LOG.md, 2026-11-21).
PENALTY = 0.5
RELAXATION = 1.6
CHECK_EVERY = 5


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

    Linear in (primal, dx, dy), so reconstructions of light groups add up to the reconstruction of their sum.
    """
    system = _System(primal, dx, dy, alpha, trusted)
    return primal + _image(system.least_squares())


def l1(
    primal: np.ndarray,
    dx: np.ndarray,
    dy: np.ndarray,
    alpha: float = DEFAULT_ALPHA,
    trusted: tuple[np.ndarray, np.ndarray] | None = None,
    tolerance: float = 1e-3,
    max_iterations: int = 500,
) -> np.ndarray:
    """The minimiser of the sum of norms, (H, W, C); arguments as of ``l2``.

    Stops when ten iterations lower the energy by less than ``tolerance`` of it. Robust to outliers, but not linear, and
    it darkens where few bright samples carry the energy: the norm seeks the median where l2 seeks the mean.

    ADMM [Boyd et al. 2011, "Distributed Optimization and Statistical Learning via ADMM", section 3.4] on the residuals
    z = K u - r with K = (α, ∂x, ∂y), whose inner problem KᵀK u = Kᵀ(...) is again the one the transforms solve.
    """
    system = _System(primal, dx, dy, alpha, trusted)
    u = system.least_squares()
    residual = system.apply(u) - system.r
    best, best_energy = u, system.energy(residual)
    # In units of the mean residual, the iteration follows the exposure of the image.
    threshold = residual.dtype.type(best_energy / system.count / PENALTY)
    # Exact gradients (and an image of one pixel) leave nothing to shrink.
    if not threshold > 0:
        return primal + _image(u)
    z = residual
    y = np.zeros_like(z)  # scaled dual variable
    history = [best_energy]
    for iteration in range(1, max_iterations + 1):
        relaxed = RELAXATION * residual + (1 - RELAXATION) * z
        z = system.shrink(relaxed + y, threshold)
        y += relaxed - z
        u = system.project(system.r + z - y)
        residual = system.apply(u) - system.r
        if iteration % CHECK_EVERY == 0:
            energy = system.energy(residual)
            if energy < best_energy:
                best, best_energy = u, energy
            # ADMM may climb before it descends, so progress is judged over two checks.
            if len(history) > 1 and history[-2] - best_energy < tolerance * best_energy:
                break
            history.append(best_energy)
    return primal + _image(best)


class _System:
    """The equations K u = r, K = (α, ∂x, ∂y), r = (0, G - ∇P), of which those with weight 0 do not count.

    Inside, images are (C, H, W) and residuals (3, C, H, W), so that transforms and stencils run along memory.
    """

    def __init__(self, primal, dx, dy, alpha, trusted):
        if not (alpha > 0 and np.isfinite(alpha)):
            raise NgptError(f"alpha {alpha}: must be a positive number; the default is {DEFAULT_ALPHA}")
        height, width = primal.shape[:2]
        self.dtype = primal.dtype
        self.alpha = self.dtype.type(alpha)
        self.weights = np.ones((3, 1, height, width), bool)
        if trusted is not None:
            self.weights[1, 0], self.weights[2, 0] = trusted
        self.weights[1, 0, :, -1] = False
        self.weights[2, 0, -1, :] = False
        self.count = np.count_nonzero(self.weights)
        self.complete = self.count == 3 * height * width - height - width
        slopes = self.apply(_planes(primal))
        self.r = np.where(self.weights, np.stack([slopes[0], _planes(dx), _planes(dy)]) - slopes, self.dtype.type(0))
        # The cosine transform of type II diagonalises ∂ᵀ∂ under Neumann boundaries.
        λy, λx = (2 - 2 * np.cos(np.pi * np.arange(n) / n) for n in (height, width))
        self.inverse = (1 / (float(alpha) ** 2 + λy[:, None] + λx)).astype(self.dtype)

    def apply(self, u: np.ndarray) -> np.ndarray:
        """K u."""
        dx, dy = forward_differences(_image(u))
        return np.stack([self.alpha * u, _planes(dx), _planes(dy)])

    def adjoint(self, z: np.ndarray) -> np.ndarray:
        """Kᵀ z."""
        return self.alpha * z[0] + _planes(adjoint_differences(_image(z[1]), _image(z[2])))

    def project(self, z: np.ndarray) -> np.ndarray:
        """The u that minimises |K u - z|² over all equations, exactly."""
        coefficients = dctn(self.adjoint(z), axes=(1, 2), norm="ortho", workers=-1) * self.inverse
        # The mean by itself: differences have none, and what rounding leaves of it would be divided by α².
        height, width = z.shape[2:]
        coefficients[:, 0, 0] = z[0].mean(axis=(1, 2), dtype=np.float64) / self.alpha * np.sqrt(height * width)
        return idctn(coefficients, axes=(1, 2), norm="ortho", workers=-1)

    def least_squares(self, max_iterations: int = 200) -> np.ndarray:
        """The u that minimises |K u - r|² over the equations that count.

        Where some do not, conjugate gradients with the exact solution of all equations as preconditioner: it needs
        about as many steps as there are separate groups of missing equations, and few of those matter.
        """
        u = self.project(self.r)
        if self.complete:
            return u
        residual = np.where(self.weights, self.r - self.apply(u), self.dtype.type(0))
        goal = 8 * float(np.finfo(self.dtype).eps) * self._norm(self.r)
        direction, previous = None, None
        for _ in range(max_iterations):
            step = self.project(residual)
            gain = float(np.vdot(step, self.adjoint(residual)))
            if not gain > goal**2:
                break
            direction = step if direction is None else step + self.dtype.type(gain / previous) * direction
            image = np.where(self.weights, self.apply(direction), self.dtype.type(0))
            length = self.dtype.type(gain / self._norm(image) ** 2)
            u = u + length * direction
            residual = residual - length * image
            previous = gain
        return u

    def energy(self, residual: np.ndarray) -> float:
        """Sum of the residuals' norms over the equations that count."""
        return float(np.sum(_colour_norm(residual), dtype=np.float64, where=self.weights))

    def shrink(self, z: np.ndarray, threshold: float) -> np.ndarray:
        """Proximal operator of ``energy``: shortens each colour by ``threshold``; what does not count stays."""
        norm = np.maximum(_colour_norm(z), np.finfo(self.dtype).tiny)
        return z * np.where(self.weights, np.maximum(1 - threshold / norm, 0), self.dtype.type(1))

    @staticmethod
    def _norm(values: np.ndarray) -> float:
        return float(np.linalg.norm(values.ravel().astype(np.float64)))


def _colour_norm(z: np.ndarray) -> np.ndarray:
    return np.sqrt(np.sum(z * z, axis=1, keepdims=True))


def _planes(image: np.ndarray) -> np.ndarray:
    """(H, W, C) seen as (C, H, W)."""
    return image.transpose(2, 0, 1)


def _image(planes: np.ndarray) -> np.ndarray:
    """(C, H, W) seen as (H, W, C)."""
    return planes.transpose(1, 2, 0)
