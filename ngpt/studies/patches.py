"""Poisson reconstruction with feature patches: small windows of the image are linear in the features.

    min  Σ |I - P|² / var P  +  Σ |∇I - G|² / var G  +  Σ_i w_i min over c of Σ_{p in window i} |I_p - c f_p|²

f_p are 1 and the features of pixel p: albedo, normal, depth. Inner minima are taken exactly, which leaves a quadratic
form in I: that of matting by closed form, with more features. The weights w_i adapt to the image and to its noise,

    w_i = STRENGTH / (residual of window i, per pixel, in the image before  +  mean var G there)

so a window that features cannot explain is let go, and all are as the noise vanishes.

[Manzi, Vicini and Zwicker 2016, "Regularizing image reconstruction for gradient-domain rendering with feature patches",
by what its abstract and the survey's section 5.1 say of it; windows by sums over boxes: He, Sun and Tang 2010, "Fast
matting using large kernel matting Laplacian matrices"]
"""

from typing import Any

import numpy as np
from scipy.ndimage import uniform_filter

from ngpt.classical.arrays import cast
from ngpt.classical.energy import keep_energy
from ngpt.classical.gradients import adjoint, differences
from ngpt.classical.leastsquares import Equations, Weighted, robust_mean, sum_of
from ngpt.classical.variances import smooth_variances, smoothed
from ngpt.repair import Repaired

RADIUS = 2  # of the windows: 5x5 pixels
# Of 0.002 to 1, about the best on coffee and teapot-caustic; so is one solve after wl2, and this radius.
STRENGTH = 0.01
# Solves after wl2, each with weights from the image before
STEPS = 1
# A feature is believed as far as its spread in a window exceeds this share of its range in the image.
RIDGE = 1e-3
TOLERANCE = 1e-3


def patches(data: Repaired) -> np.ndarray:
    """The image, (H, W, 3) float32; needs variances and features."""
    equations = Equations(data.image, data.dx, data.dy, data.trusted)
    r, scale = equations.scaled_residual()
    if scale == 0:
        return data.image
    of_primal, of_dx, of_dy = data.variances
    p_var, d_var = smooth_variances(of_primal, of_dx, of_dy, data.trusted)
    screen, weights = (np.asarray(cast(1 / v, r.dtype)) for v in (p_var, d_var))
    # Variances are relative; this is what they are relative to, in units of r.
    unit = _mean_variance(data) / scale**2
    windows = Windows(design(data.features, data.image.shape[:2]), RADIUS)
    noise = windows.mean(np.minimum(*d_var)[0])
    image = np.asarray(equations.primal, r.dtype) / scale
    u, w = np.zeros_like(image), None
    for _ in range(STEPS + 1):
        u = solve(r, screen, weights, windows, w, image, TOLERANCE)
        w = STRENGTH / (windows.residual(image + u) / max(unit, 1e-30) + noise)
    return np.asarray(keep_energy(equations.image(u, scale), data.image))


def solve(
    r: np.ndarray,
    screen: np.ndarray,
    weights: np.ndarray,
    windows: "Windows",
    w: np.ndarray | None,
    image: np.ndarray,
    tolerance: float,
    max_iterations: int = 200,
) -> np.ndarray:
    """The correction u (C, H, W) of the ``image`` in units of r; ``w`` (H, W) are the windows' weights, None for 0."""
    system = Constrained(screen, weights, windows, w)
    b = adjoint(*(weights * r))
    if w is not None:
        b = b - windows.apply(image, w)
    return system.solve(b.astype(r.dtype), tolerance, max_iterations)[0]


class Windows:
    """All windows of (2 radius + 1)² pixels, those at the border smaller, each with its least squares on the design."""

    def __init__(self, f: np.ndarray, radius: int):
        """``f`` is (N, H, W), its first plane 1."""
        self.f, self.size = f, 2 * radius + 1
        n = len(f)
        gram = np.empty((*f.shape[1:], n, n))
        for i in range(n):
            for j in range(i, n):
                gram[..., i, j] = gram[..., j, i] = self.sum(f[i] * f[j])
        self.count = gram[..., 0, 0].copy()
        slopes = np.arange(1, n)
        gram[..., slopes, slopes] += RIDGE * self.count[..., None]
        self.inverse = np.linalg.inv(gram)

    def sum(self, values: np.ndarray) -> np.ndarray:
        """(..., H, W) summed over the window around each pixel."""
        size = (1,) * (values.ndim - 2) + (self.size,) * 2
        return uniform_filter(values, size, output=np.float64, mode="constant") * self.size**2

    def mean(self, values: np.ndarray) -> np.ndarray:
        """(H, W) averaged over windows; values that are not finite are left out."""
        good = np.isfinite(values)
        return self.sum(np.where(good, values, 0.0)) / np.maximum(self.sum(good.astype(np.float64)), 1)

    def fit(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Coefficients (N, C, H, W) of planes (C, H, W) in each window, and the sums f u there."""
        sums = self.sum(self.f[:, None] * u)
        return np.einsum("hwij,jchw->ichw", self.inverse, sums), sums

    def residual(self, u: np.ndarray) -> np.ndarray:
        """What is left of the squares of u (C, H, W) in each window per pixel, summed over colours: (H, W) >= 0."""
        # Squares are much larger than what is left of them.
        u = u.astype(np.float64)
        fits, sums = self.fit(u)
        left = self.sum((u * u).sum(0)) - np.einsum("ichw,ichw->hw", fits, sums)
        return np.maximum(left, 0) / self.count

    def apply(self, u: np.ndarray, w: np.ndarray) -> np.ndarray:
        """The gradient of half of Σ w_i (what is left of u in window i), (C, H, W)."""
        fits, _ = self.fit(u)
        spread = self.sum(w * fits)
        return self.sum(w) * u - np.einsum("nhw,nchw->chw", self.f, spread)


class Constrained(Weighted):
    """The matrix of weighted least squares and that of the windows."""

    def __init__(self, screen: np.ndarray, weights: np.ndarray, windows: Windows, w: np.ndarray | None):
        self.windows, self.w = windows, w
        extra = 0 if w is None else windows.sum(w) / 8
        self.exact = weights
        # The preconditioner takes windows for differences of the same weight at the finest scale.
        super().__init__(screen, np.where(weights > 0, weights + extra, 0).astype(weights.dtype))

    def _apply(self, p: Any, out: Any) -> tuple[Any, list]:
        dx, dy = differences(p, 0, p.shape[1])
        result = adjoint(self.exact[0] * dx, self.exact[1] * dy) + self.screen * p
        if self.w is not None:
            result += self.windows.apply(p, self.w)
        return result.astype(p.dtype), [(sum_of(result * p),)]


def design(features: dict[str, np.ndarray], size: tuple[int, int]) -> np.ndarray:
    """(N, H, W): 1, and the channels of the features over their ranges, those that are the same everywhere left out."""
    planes = [np.ones(size)]
    for feature in features.values():
        for channel in np.moveaxis(feature.astype(np.float64), -1, 0):
            low, high = np.percentile(channel, (1, 99))
            if high - low > 1e-6 * max(abs(low), abs(high)):
                planes.append((np.clip(channel, low, high) - (low + high) / 2) / (high - low))
    return np.stack(planes)


def _mean_variance(data: Repaired) -> float:
    """What ``smooth_variances`` divides by."""
    primal, dx, dy = data.variances
    layers = (smoothed(primal), smoothed(dx[:, :-1], True), smoothed(dy[:-1], True))
    return robust_mean(*layers)
