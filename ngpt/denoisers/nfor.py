"""NFOR: nonlinearly weighted first-order regression on features, the strongest classical denoiser of path tracing.

For each pixel p, the light of its neighbourhood is fitted by a linear function of the features f,

    min over F_p, G_p of  Σ_q  w_pq |F_p + G_pᵀ (f_q - f_p) - I_q|²

[survey, equation 24; Bitterli et al. 2016, "Nonlinearly weighted first-order regression for denoising Monte Carlo
renderings", section 4]. The weights w are those of non-local means on the colours. Each fit gives values for all pixels
of its neighbourhood; these are averaged with the same weights ("collaborative filtering" in the paper).

The paper computes the weights and chooses a bandwidth by two half buffers, but a stack holds only one image. So the
part of the patch distance that the image's variance explains is subtracted [Rousselle et al. 2012, "Adaptive rendering
with non-local means filtering", equation 4], and each pixel mixes two bandwidths by Stein's unbiased estimate of their
errors.
"""

import math
from collections.abc import Iterator
from itertools import product

import numpy as np

from ngpt.magnitude import bound
from ngpt.system.late import ndimage

RADIUS = 9  # of the neighbourhood, 19x19 pixels
PATCH = 3  # radius of the patches that are compared
BANDWIDTHS = (0.5, 1.0)
# The ridge of the regression. A feature has little influence if its variance in the neighbourhood, relative to its
# squared range in the image, is below this.
RIDGE = 1e-3
# A pixel has half the weight if its variance is this many times the median of its neighbourhood.
OUTLIER = 1000.0
# Light is clamped to FAR, in units of its 99th percentile, and in the estimate of negligible noise (``_floor``) to
# FLOOR. Otherwise one pixel of 1e30 would exceed the range of single precision, and blur all others.
FAR, FLOOR = 1e6, 1e3
_TILE = 48  # side of a tile in pixels: its sums stay in the processor's cache


def nfor(image: np.ndarray, variance: np.ndarray, features: list[np.ndarray]) -> np.ndarray:
    """The denoised image, (H, W, 3) float32.

    ``image``     (H, W, 3), finite
    ``variance``  (H, W, 3), the variance of its pixels, NaN where it is unknown
    ``features``  a list of (H, W, C)

    It needs memory for about 100 floats per pixel.
    """
    # Variances are not averaged over neighbours: that is safer in other methods, but here it blurs (docs/lab/log).
    variance = np.where(np.isfinite(variance), np.maximum(variance, 0), 0).astype(np.float32)
    power = _power(image)
    image = np.clip(np.ldexp(image, -power), -FAR, FAR)
    variance = np.minimum(np.ldexp(variance, -2 * power), np.float32(FAR**2))
    design = _design(features, image.shape[:2])
    # Squares of extreme fireflies would be infinite, so patches are compared with light clamped to ``most``.
    most = bound(image)
    seen = image if most == np.inf else np.clip(image, -most, most)
    variance = np.minimum(variance, np.float32(most) ** 2)
    trust = _trust(seen, variance)
    results, errors = [], []
    for bandwidth in BANDWIDTHS:
        result, own = _filtered(image, seen, variance, trust, design, bandwidth)
        results.append(result)
        # Stein: E|F - truth|² = E[|F - I|² - σ² + 2 σ² dF/dI].
        off = np.clip(result, -most, most) - seen
        error = np.mean(off**2 - variance + 2 * variance * own[..., None], axis=-1)
        errors.append(ndimage.uniform_filter(error, 2 * RADIUS + 1))
    better = (errors[1] < errors[0]).astype(np.float32)
    share = ndimage.uniform_filter(better, 2 * PATCH + 1)[..., None]
    return np.ldexp(((1 - share) * results[0] + share * results[1]).astype(np.float32), power)


def _power(image: np.ndarray) -> int:
    """The p such that the 99th percentile of |image| is in [2^p, 2^(p + 1)).

    If the percentile is 0, the median of the values that are not 0 takes its place.
    """
    light = np.abs(image)
    level = np.percentile(light, 99) or np.median(light[light > 0] if light.any() else 1.0)
    return math.floor(math.log2(level))


def estimated_variance(image: np.ndarray) -> np.ndarray:
    """An estimate (H, W, 3) of the variance of an image: its squared distance from its 3 x 3 median.

    The squares are averaged twice over 3 x 3 pixels. Detail that the median removes counts as noise
    (docs/lab/log/2026-W48.md).
    """
    squares = (image.astype(np.float64) - ndimage.median_filter(image, (3, 3, 1), mode="nearest")) ** 2
    for _ in range(2):
        squares = ndimage.uniform_filter(squares, (3, 3, 1), mode="nearest")
    return squares.astype(np.float32)


def _trust(image: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """The weight of each pixel, (H, W, 1) in (0, 1]: small if its variance is far above that of its neighbourhood.

    A spot of light in the dark differs from the dark by little more than its own noise, so the patches around it look
    similar. Without this weight, the spot would be spread over them.
    """
    total = variance.mean(axis=-1)
    usual = OUTLIER * ndimage.median_filter(total, 2 * RADIUS + 1) + _floor(image)
    return (usual / (usual + total))[..., None].astype(np.float32)


def _floor(image: np.ndarray) -> float:
    """A variance that is negligible beside the image."""
    return 1e-6 * float(np.mean(np.clip(image, -FLOOR, FLOOR).astype(np.float64) ** 2)) + 1e-30


def _design(features: list[np.ndarray], size: tuple[int, int]) -> np.ndarray:
    """(H, W, 1 + channels) float32: 1, and the channels of the features that vary, scaled to [-0.5, 0.5].

    The range of a channel is from its 1st to its 99th percentile; values beyond are clipped.
    """
    columns = [np.ones((*size, 1), np.float32)]
    for feature in features:
        for channel in np.moveaxis(feature, -1, 0):
            low, high = np.percentile(channel, (1, 99))
            spread = high - low
            if spread > 1e-6 * max(abs(low), abs(high)):
                columns.append(((np.clip(channel, low, high) - (low + high) / 2) / spread)[..., None])
    return np.concatenate(columns, axis=-1).astype(np.float32)


def _filtered(
    image: np.ndarray, seen: np.ndarray, variance: np.ndarray, trust: np.ndarray, design: np.ndarray, bandwidth: float
) -> tuple[np.ndarray, np.ndarray]:
    """The result F (H, W, 3) with one bandwidth, and the weight (H, W) of each pixel in its own fit, about dF/dI.

    ``image`` is averaged. Patches are compared in ``seen``.
    """
    n = design.shape[-1]
    rows, columns = np.triu_indices(n)
    products = design[..., rows] * design[..., columns]
    targets = (design[..., :, None] * image[..., None, :]).reshape(*image.shape[:2], -1)
    moments = np.concatenate([products, targets], axis=-1).astype(np.float32)
    sums = _gathered(moments * trust, seen, variance, bandwidth)
    gram = np.empty((*image.shape[:2], n, n))
    gram[..., rows, columns] = gram[..., columns, rows] = sums[..., : len(rows)]
    # The ridge is only on the slopes, in proportion to the sum of the weights. It keeps the fit stable if features are
    # constant.
    weight = gram[..., 0, 0].copy()
    index = np.arange(1, n)
    gram[..., index, index] += RIDGE * weight[..., None]
    right = sums[..., len(rows) :].reshape(*image.shape[:2], n, 3)
    fits = np.linalg.solve(gram, right.astype(np.float64)).astype(np.float32)
    # The weight of a pixel in its own fit is the diagonal of the hat matrix.
    leverage = np.einsum("...i,...i", design, np.linalg.solve(gram, design[..., None].astype(np.float64))[..., 0])
    spread = np.concatenate([fits.reshape(*image.shape[:2], -1), np.ones((*image.shape[:2], 1), np.float32)], axis=-1)
    del sums, gram, right
    gathered = _gathered(spread * trust, seen, variance, bandwidth)
    fits = gathered[..., :-1].reshape(*image.shape[:2], n, 3) / gathered[..., -1:, None]
    return np.einsum("...i,...ic->...c", design, fits), np.clip(leverage, 0, 1)


def _gathered(values: np.ndarray, image: np.ndarray, variance: np.ndarray, bandwidth: float) -> np.ndarray:
    """Σ_q w_pq values_q for each pixel p; the weights are symmetric."""
    height, width = image.shape[:2]
    padded = np.pad(values, ((RADIUS, RADIUS), (RADIUS, RADIUS), (0, 0)))
    result = np.zeros_like(values)
    for dy, dx, weights in _weights(image, variance, bandwidth):
        for y in range(0, height, _TILE):
            for x in range(0, width, _TILE):
                here = np.s_[y : min(y + _TILE, height), x : min(x + _TILE, width)]
                rows = slice(here[0].start + RADIUS + dy, here[0].stop + RADIUS + dy)
                columns = slice(here[1].start + RADIUS + dx, here[1].stop + RADIUS + dx)
                result[here] += weights[here][..., None] * padded[rows, columns]
    return result


def _weights(image: np.ndarray, variance: np.ndarray, bandwidth: float) -> Iterator[tuple[int, int, np.ndarray]]:
    """Yields (dy, dx, weights): for each offset, the weights (H, W) of the pixels at it; 0 outside the image."""
    height, width = image.shape[:2]
    floor = _floor(image)
    reach = [range(-min(RADIUS, n - 1), min(RADIUS, n - 1) + 1) for n in (height, width)]
    for dy, dx in product(*reach):
        here = np.s_[max(-dy, 0) : height - max(dy, 0), max(-dx, 0) : width - max(dx, 0)]
        there = np.s_[max(dy, 0) : height - max(-dy, 0), max(dx, 0) : width - max(-dx, 0)]
        both = variance[here] + variance[there]
        distance = ((image[here] - image[there]) ** 2 - both) / (floor + bandwidth**2 * both)
        patch = ndimage.uniform_filter(np.mean(distance, axis=-1), 2 * PATCH + 1)
        weights = np.zeros((height, width), np.float32)
        weights[here] = np.exp(-np.maximum(patch, 0))
        yield dy, dx, weights
