"""The number of paths that feed the cache, chosen so that the noise at equal time is least.

The noise of a render has two parts: each pixel's own, which falls with the samples of the image, and what pixels share,
which falls with the paths that feed the cache. With V and S the variances that one path of either kind would give, and
equal costs of both, the least variance for a given time has

    paths that feed / paths of the image = sqrt(S / V).

Both are measured over blocks of pixels, since a denoiser leaves the noise of large structures, and relative to the
light, as errors are judged. The ratio is rounded to a power of two: so that it is the same in all renders of a scene,
nearly always.
"""

from __future__ import annotations

import math

import numpy as np

from data_gen.film import GradientFilm

# Paths that feed the cache, for each path of the image: at first, and at least and at most
BEGIN, LEAST, MOST = 1 / 2, 1 / 16, 1.0
# Side of a block, in pixels, and the share of blocks with the most noise that do not count
_BLOCK, _TRIM = 16, 0.01
# Dark blocks count less: light is relative to its own block plus this share of the mean.
_DARK = 0.05


def share(film: GradientFilm, fed: float) -> float | None:
    """Paths that should feed the cache, for each path of the image, after ``fed`` for each pixel; None: not known."""
    samples = float(film.samples_each.mean())
    if not samples or not fed or "shared" not in film.moments:
        return None
    light, variance = film.known("primal")
    shared, _ = film.known("shared")
    if variance is None or not np.isfinite(variance).any():
        return None
    weight = np.isfinite(light) & np.isfinite(variance)
    light, variance, shared = (_blocks(np.where(weight, each, 0)) for each in (light, variance, shared))
    unit = np.square(np.abs(light) + _DARK * max(float(np.abs(light).mean()), 1e-30))
    own = (variance / _BLOCK**2 / unit).sum(axis=-1).ravel() * samples
    common = (np.square(shared) / unit).sum(axis=-1).ravel() * fed
    few = max(1, round((1 - _TRIM) * own.size))
    own_mean, common_mean = (float(np.sort(each)[:few].mean()) for each in (own, common))
    if not own_mean > 0:
        return None
    wanted = math.sqrt(max(common_mean, 0) / own_mean)
    return float(np.clip(2.0 ** round(math.log2(max(wanted, LEAST))), LEAST, MOST))


def _blocks(image: np.ndarray) -> np.ndarray:
    """Means over blocks of an image (H, W, C); blocks at its borders may be smaller."""
    for axis in (0, 1):
        begins = np.arange(0, image.shape[axis], _BLOCK)
        counts = np.diff(np.append(begins, image.shape[axis]))
        shape = [1, 1, 1]
        shape[axis] = -1
        image = np.add.reduceat(image, begins, axis=axis) / counts.reshape(shape)
    return image
