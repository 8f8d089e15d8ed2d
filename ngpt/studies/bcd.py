"""Bayesian collaborative denoising: patches that look alike are samples of one normal distribution, the noise aside.

For the patch x of each pixel, S are the patches near by that differ from it by no more than their noise. With the mean
m and covariance C of S and the covariance N of their noise, each of them becomes

    y = m + Σ (Σ + N)⁻¹ (x - m),     Σ = C - N without negative eigenvalues

and once more with m, Σ of these results. A pixel becomes the mean of all patches over it.

[Boughida and Boubekeur 2017, "Bayesian collaborative denoising for Monte Carlo rendering"; constants of the reference
implementation.] They find S by histograms of samples, which a stack has not: here two patches are alike if the mean of
(x - y)² over its variance is at most ``ALIKE``, 1 of equal ones. Their filter of spikes before is left out.
"""

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.ndimage import uniform_filter

ALIKE = 1.0
PATCH, SEARCH = 1, 6  # radii
SCALES = 3
STEP = 2  # every second patch of every second row begins a search
_CHUNK = 512


def collaborative(image: np.ndarray, variance: np.ndarray, scales: int = SCALES) -> np.ndarray:
    """The denoised image, (H, W, C) float32, of any C: noise of its channels is taken for correlated as it is.

    ``variance`` (H, W, C) is that of its pixels as means; NaN where it is not known, which counts as none.
    """
    variance = np.where(np.isfinite(variance), np.maximum(variance, 0), 0)
    return _at_scales(image.astype(np.float64), variance.astype(np.float64), scales).astype(np.float32)


def _at_scales(image: np.ndarray, variance: np.ndarray, scales: int) -> np.ndarray:
    """Coarse scales are denoised first, and replace the low frequencies of finer ones."""
    fine = _denoised(image, variance)
    if scales == 1 or min(image.shape[:2]) < 4 * (2 * PATCH + 1):
        return fine
    coarse = _at_scales(_halved(image), _halved(variance) / 4, scales - 1)
    return fine + _doubled(coarse - _halved(fine), image.shape)


def _halved(image: np.ndarray) -> np.ndarray:
    height, width = (n + n % 2 for n in image.shape[:2])
    even = np.pad(image, ((0, height - image.shape[0]), (0, width - image.shape[1]), (0, 0)), mode="edge")
    return even.reshape(height // 2, 2, width // 2, 2, -1).mean(axis=(1, 3))


def _doubled(image: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Bilinear, to a size of ``shape``."""
    for axis in (0, 1):
        n = image.shape[axis]
        place = (np.arange(shape[axis]) - 0.5) / 2
        low = np.clip(np.floor(place).astype(int), 0, n - 1)
        high = np.clip(low + 1, 0, n - 1)
        t = np.clip(place - low, 0, 1).reshape((-1, 1, 1) if axis == 0 else (1, -1, 1))
        image = (1 - t) * image.take(low, axis) + t * image.take(high, axis)
    return image


def _denoised(image: np.ndarray, variance: np.ndarray) -> np.ndarray:
    height, width, channels = image.shape
    side = 2 * PATCH + 1
    if min(height, width) < side:
        return image
    # (rows, columns, C, side, side) of all patches, by the corner of each, as vectors
    patches, noise = (
        sliding_window_view(a, (side, side), (0, 1)).reshape(height - side + 1, width - side + 1, -1)
        for a in (image, variance)
    )
    rows, columns, size = patches.shape
    where = np.arange(height * width * channels).reshape(image.shape)
    places = sliding_window_view(where, (side, side), (0, 1)).reshape(rows, columns, size)
    offsets, alike = _alike(image, variance, rows, columns)
    correlation = _correlation(image, variance, side)
    y, x = (a.ravel() for a in np.meshgrid(_every(rows), _every(columns), indexing="ij"))
    total, count = np.zeros(image.size), np.zeros(image.size)
    for i in range(0, len(y), _CHUNK):
        here = y[i : i + _CHUNK], x[i : i + _CHUNK]
        chosen = alike[:, here[0], here[1]].T
        # Those that no patch of the chunk has are left out.
        some = chosen.any(axis=0)
        chosen = chosen[:, some]
        there = [
            np.clip(h[:, None] + o[some], 0, n - 1) for h, o, n in zip(here, offsets.T, (rows, columns), strict=True)
        ]
        result = _estimated(patches[there[0], there[1]], noise[there[0], there[1]], chosen, correlation)
        at = places[there[0], there[1]][chosen].ravel()
        total += np.bincount(at, result[chosen].ravel(), image.size)
        count += np.bincount(at, minlength=image.size)
    return (total / count).reshape(image.shape)


def _every(n: int) -> np.ndarray:
    """Every ``STEP``-th of n numbers, and the last."""
    return np.unique(np.append(np.arange(0, n, STEP), n - 1))


def _alike(image: np.ndarray, variance: np.ndarray, rows: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """Offsets (n, 2), and whether the patch there is like that of each corner: (n, rows, columns)."""
    reach = np.arange(-SEARCH, SEARCH + 1)
    offsets = np.array([(dy, dx) for dy in reach for dx in reach if abs(dy) < rows and abs(dx) < columns])
    alike = np.zeros((len(offsets), rows, columns), bool)
    floor = 1e-12 * np.mean(image**2) + 1e-300
    crop = np.s_[PATCH : PATCH + rows, PATCH : PATCH + columns]
    for i, (dy, dx) in enumerate(offsets):
        moved = [np.roll(a, (-dy, -dx), (0, 1)) for a in (image, variance)]
        distance = np.mean((image - moved[0]) ** 2 / (variance + moved[1] + floor), axis=-1)
        alike[i] = uniform_filter(distance, 2 * PATCH + 1)[crop] <= ALIKE
        # What np.roll brought in from the other side
        alike[i, max(rows - dy, 0) if dy > 0 else rows :] = False
        alike[i, : max(-dy, 0)] = False
        alike[i, :, max(columns - dx, 0) if dx > 0 else columns :] = False
        alike[i, :, : max(-dx, 0)] = False
    alike[np.flatnonzero((offsets == 0).all(axis=1))] = True
    return offsets, alike


def _correlation(image: np.ndarray, variance: np.ndarray, side: int) -> np.ndarray:
    """Of the noise of two values of a patch, (size, size): of two channels of one pixel, 0 of two pixels."""
    beyond = (image - uniform_filter(image, (3, 3, 1))) / np.sqrt(variance + 1e-12 * np.mean(image**2) + 1e-300)
    beyond = np.clip(beyond, -3, 3).reshape(-1, image.shape[-1])
    second = beyond.T @ beyond
    norm = np.sqrt(np.maximum(np.diag(second), 1e-300))
    return np.kron(second / norm / norm[:, None], np.eye(side**2))


def _estimated(x: np.ndarray, variance: np.ndarray, chosen: np.ndarray, correlation: np.ndarray) -> np.ndarray:
    """y for patches x (B, n, D), of which those ``chosen`` (B, n) are alike."""
    n, size = chosen.sum(axis=1), x.shape[-1]
    share = (chosen / n[:, None])[..., None]
    mean = (share * x).sum(axis=1, keepdims=True)
    deviation = np.sqrt((share * variance).sum(axis=1))
    noise = deviation[:, :, None] * deviation[:, None] * correlation
    # Without any noise, what rounding leaves of patches that are all the same could not be inverted.
    noise += max(1e-12 * np.mean(deviation**2), 1e-28 * np.mean(mean**2), 1e-300) * np.eye(size)

    def covariance(values: np.ndarray, mean: np.ndarray) -> np.ndarray:
        apart = np.where(chosen[..., None], values - mean, 0)
        return apart.transpose(0, 2, 1) @ apart / np.maximum(n - 1, 1)[:, None, None]

    def pulled(mean: np.ndarray, spread: np.ndarray) -> np.ndarray:
        gain = np.linalg.solve(spread + noise, spread)  # its transpose: both are symmetric
        return mean + (x - mean) @ gain

    values, vectors = np.linalg.eigh(covariance(x, mean) - noise)
    first = pulled(mean, vectors * np.maximum(values, 0)[:, None] @ vectors.transpose(0, 2, 1))
    again = (share * first).sum(axis=1, keepdims=True)
    second = pulled(again, covariance(first, again))
    # Of too few patches no covariance is known.
    return np.where((n <= size)[:, None, None], mean, second)
