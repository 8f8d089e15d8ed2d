"""Least squares over an image and its differences, for the linear reconstructions and as a part of others.

The equations are I ≈ P and ∇I ≈ G. All solvers compute the correction u = I - P. For it, the equations are u ≈ 0 and
∇u ≈ r, with r = G - ∇P. So exact gradients have r = 0 and give u = 0, whatever the weights.
"""

import math

import numpy as np

from ngpt.classical.arrays import by_rows, dct2, empty, idct2, image, map_rows, planes
from ngpt.classical.gradients import adjoint_by_rows, differences
from ngpt.errors import NgptError

# If the ratio of the largest value to a typical one exceeds this, the equations are solved in double precision. In
# float32, the transforms would spread rounding errors of the largest value over all others.
FLOAT32_RANGE = 2.0**16

# In ``robust_mean``, a value counts at most as this multiple of the mean.
CLIP = 100


class Equations:
    """The right-hand sides P and G as planes (C, H, W), in double precision if their range requires it.

    ``primal``, ``dx``, ``dy``  (H, W, C) float32 or float64, finite
    ``trusted``  (H, W) booleans for dx and dy: a difference that is False has no equation; None trusts all
    """

    def __init__(
        self, primal: np.ndarray, dx: np.ndarray, dy: np.ndarray, trusted: tuple[np.ndarray, np.ndarray] | None = None
    ):
        if primal.ndim != 3 or not primal.shape == dx.shape == dy.shape:
            shapes = ", ".join(str(tuple(a.shape)) for a in (primal, dx, dy))
            raise NgptError(f"primal, dx and dy have shapes {shapes}; they must all be of one shape (H, W, C)")
        self.dtype = primal.dtype
        self.trusted = trusted
        self.primal, self.dx, self.dy = map(planes, (primal, dx, dy))
        sample = abs(primal[::4, ::4])
        self.typical = float((sample**0.5).sum() / max(int((sample > 0).sum()), 1)) ** 2

    def residual(self, first: int, last: int) -> tuple[np.ndarray, np.ndarray]:
        """r = G - ∇P of rows first .. last - 1, (C, rows, W) for dx and dy, 0 where there is no equation."""
        x, y = differences(self.primal, first, last)
        x, y = self.dx[:, first:last] - x, self.dy[:, first:last] - y
        x[..., -1] = 0
        if last == self.primal.shape[1]:
            y[..., -1, :] = 0
        if self.trusted is not None:
            x, y = (np.where(t[first:last], v, 0) for t, v in zip(self.trusted, (x, y), strict=True))
        return x, y

    def divergence(self) -> np.ndarray:
        """∇ᵀ r as (C, H, W), the right-hand side of least squares with equal weights."""

        def rows(first, last):
            x, y = self.residual(first, last)
            return None, x, y, _peak(x, y)

        b, peaks = adjoint_by_rows(rows, empty(self.primal, len(self.primal), channels_last=True))
        return b if self._holds(peaks) else self.divergence()

    def scaled_residual(self) -> tuple[np.ndarray, float]:
        """(r / scale, scale) with r as (2, C, H, W). The scale is a power of two near the mean of |r|; 0 if r is 0."""

        def rows(first, last):
            r = np.stack(self.residual(first, last))
            return r, _peak(r), sum_of(abs(r))

        r, bands = by_rows(rows, empty(self.primal, 2, len(self.primal)))
        if not self._holds([peak for peak, _ in bands]):
            return self.scaled_residual()
        mean = sum(total for _, total in bands) / math.prod(r.shape)
        scale = 2.0 ** round(math.log2(mean)) if mean > 0 else 0.0
        if scale > 0:
            r, _ = by_rows(lambda first, last: (r[..., first:last, :] * (1 / scale),), r)
        return r, scale

    def _holds(self, peaks: list) -> bool:
        """Whether the precision suffices. If not, switches to double. ``peaks`` has the largest |r| of each band."""
        peak = float(np.max(peaks))
        if not math.isfinite(peak):
            raise NgptError("primal, dx or dy holds values that are not finite; ngpt.reconstruct() repairs them first")
        if peak <= FLOAT32_RANGE * self.typical or self.primal.dtype == np.float64:
            return True
        self.primal, self.dx, self.dy = (a.astype(np.float64, copy=False) for a in (self.primal, self.dx, self.dy))
        return False

    def image(self, u: np.ndarray, scale: float = 1.0, out: np.ndarray | None = None) -> np.ndarray:
        """P + scale · u as (H, W, C), in the precision of the input. ``out`` (C, H, W) is memory for the result."""
        out = empty(u, len(u), channels_last=True) if out is None else out

        def rows(first, last):
            part = u[:, first:last] if scale == 1 else scale * u[:, first:last]
            return (self.primal[:, first:last] + part,)

        return image(by_rows(rows, out)[0]).astype(self.dtype, copy=False)


def _peak(*arrays: np.ndarray) -> float:
    """The largest absolute value, 0 for empty arrays. It is not finite if one of the values is not."""
    extremes = [abs(float(v)) for a in arrays if math.prod(a.shape) for v in (a.min(), a.max())]
    return float(np.max(extremes, initial=0))


def solve(b: np.ndarray, screen: float, mean: np.ndarray | float | None = None) -> np.ndarray:
    """The planes u (C, H, W) with (screen + ∇ᵀ∇) u = b; b is overwritten.

    The cosine transform of type II diagonalises ∇ᵀ∇ under Neumann boundaries [Bhat et al. 2008]. ``mean`` (C) is the
    mean of u if it is known. Otherwise it is computed by a division by ``screen``, which enlarges rounding errors if
    ``screen`` is small.
    """
    height, width = b.shape[-2:]
    λy, λx = ((4 * np.sin(np.pi / 2 * np.arange(n) / n) ** 2).astype(b.dtype) for n in (height, width))
    # In the layout of b, because NumPy is slow if the axes of two arrays have different orders in memory.
    screened = np.zeros_like(b[:, :1]) + screen
    screened += λx
    coefficients = dct2(b)
    coefficients, _ = by_rows(lambda i, j: (coefficients[:, i:j] / (λy[i:j, None] + screened),), coefficients)
    if mean is not None:
        coefficients[:, 0, 0] = mean * math.sqrt(height * width)
    return idct2(coefficients)


def solve_weighted(
    r: np.ndarray, screen: np.ndarray | float, weights: np.ndarray, tolerance: float, max_iterations: int = 200
) -> tuple[np.ndarray, int]:
    """The u (C, H, W) that minimises Σ screen |u|² + Σ weights |∇u - r|², and the number of iterations it took.

    ``r`` is (2, C, H, W), 0 in the unused column and row; ``weights`` (2, 1, H, W) >= 0; ``screen`` > 0, either
    (1, H, W) or one number for all pixels.

    Conjugate gradients stop when the norm of the residual, by the preconditioner, is ``tolerance`` times the first.
    """
    flux = weights * r
    b, _ = adjoint_by_rows(lambda i, j: (None, *flux[..., i:j, :]), empty(r, len(r[0])))
    return Weighted(screen, weights).solve(b, tolerance, max_iterations)


class Weighted:
    """The matrix screen + ∇ᵀ weights ∇ and its preconditioner D^-1/2 (σ + ∇ᵀ∇)⁻¹ D^-1/2, by cosine transforms.

    If ``screen`` is an array, D is the mean weight around a pixel plus ``screen`` [Concus and Golub 1973, "Use of Fast
    Direct Methods for the Efficient Numerical Solution of Nonseparable Elliptic Equations"]. If ``screen`` is a number,
    D is 1, and the mean of the solution is 0, as is that of the right-hand side.
    """

    def __init__(self, screen: np.ndarray | float, weights: np.ndarray):
        self.weights = weights
        self.mean: float | None = None
        if isinstance(screen, float):
            self.screen = np.full_like(weights[0], screen)
            self.scaling = np.ones_like(weights[0])
            self.σ = screen
            self.mean = 0.0
            return
        self.screen = screen
        mean = _around(weights) / _around(unused_zeroed(np.ones_like(weights))).clip(1, None)
        self.scaling = (mean + screen) ** -0.5
        self.σ = float((screen * self.scaling**2).mean())

    def solve(self, b: np.ndarray, tolerance: float, max_iterations: int) -> tuple[np.ndarray, int]:
        zeros = np.zeros_like
        u, p, residual, q, z = zeros(b), zeros(b), b, empty(b, len(b)), empty(b, len(b))
        z, gain = self._precondition(residual, z)
        goal, previous = tolerance**2 * gain, math.inf
        for iteration in range(max_iterations):
            if not gain > goal:
                return u, iteration
            p = _plus(z, gain / previous, p, p)
            q, energies = self._apply(p, q)
            step, previous = gain / total_of(energies), gain
            u, residual = _plus(u, step, p, u), _plus(residual, -step, q, residual)
            z, gain = self._precondition(residual, z)
        return u, max_iterations

    def _precondition(self, residual: np.ndarray, out: np.ndarray) -> tuple[np.ndarray, float]:
        """z = D^-1/2 (σ + ∇ᵀ∇)⁻¹ D^-1/2 residual, and the scalar product of z and the residual."""
        out, _ = by_rows(lambda i, j: (self.scaling[:, i:j] * residual[:, i:j],), out)
        out = solve(out, self.σ, self.mean)

        def finish(i, j):
            z = self.scaling[:, i:j] * out[:, i:j]
            return z, sum_of(z * residual[:, i:j])

        z, products = by_rows(finish, out)
        return z, total_of(products)

    def _apply(self, p: np.ndarray, out: np.ndarray) -> tuple[np.ndarray, list]:
        """(screen + ∇ᵀ weights ∇) p, and its scalar product with p as a list of parts, one for each band."""

        def rows(i, j):
            dx, dy = differences(p, i, j)
            x, y, own = self.weights[0, :, i:j] * dx, self.weights[1, :, i:j] * dy, self.screen[:, i:j] * p[:, i:j]
            return own, x, y, sum_of(x * dx + y * dy + own * p[:, i:j])

        result, energies = adjoint_by_rows(rows, out)
        return result, energies


def _plus(a: np.ndarray, factor: float, b: np.ndarray, out: np.ndarray) -> np.ndarray:
    return by_rows(lambda i, j: (a[:, i:j] + factor * b[:, i:j],), out)[0]


def unused_zeroed(differences: np.ndarray) -> np.ndarray:
    """(2, C, H, W) values of differences with the unused column of dx and row of dy set to 0, in place."""
    differences[0, ..., -1] = 0
    differences[1, ..., -1, :] = 0
    return differences


def _around(weights: np.ndarray) -> np.ndarray:
    """Sum of the weights of a pixel's differences, (1, H, W)."""
    total = weights[0, ..., :] + weights[1]
    total[..., 1:] += weights[0, ..., :-1]
    total[..., 1:, :] += weights[1, ..., :-1, :]
    return total


def sum_of(values: np.ndarray) -> float:
    """The sum, accumulated in double precision."""
    return float(values.sum(dtype=np.float64))


def total_of(bands: list) -> float:
    """The sum over ``bands``: lists of one value each, which ``by_rows`` returns last."""
    return float(sum(value for (value,) in bands))


def robust_mean(*layers: np.ndarray) -> float:
    """A mean of values >= 0 in arrays of any shape, in which a value counts at most as ``CLIP`` times the mean.

    It is close to the mean for ordinary data, and a few pixels of 1e12 hardly change it.
    """
    rows = [layer.reshape(-1, layer.shape[-1]) for layer in layers if math.prod(layer.shape)]
    count = sum(math.prod(values.shape) for values in rows)
    mean = math.inf
    while True:
        clipped = sum(_clipped_sum(values, CLIP * mean) for values in rows) / max(count, 1)
        if not clipped < 0.5 * mean:
            return clipped
        mean = clipped


def _clipped_sum(values: np.ndarray, most: float) -> float:
    return sum(map_rows(lambda first, last: sum_of(values[first:last].clip(None, most)), values))
