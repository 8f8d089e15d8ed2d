"""Chooses the number of paths that feed the cache, so that the noise at equal time is least.

The noise of a render has two parts. Each pixel's own noise falls with the number of paths of the image. The noise that
pixels share, because they read the same cells, falls with the number of paths that feed the cache. Let V be the
variance that the own noise would have with one path of the image, and S the variance that the shared noise would have
with one path that feeds the cache. If both kinds of paths cost the same, the variance at equal time is least for

    paths that feed / paths of the image = sqrt(S / V).

V and S are measured over blocks of pixels, because a denoiser removes fine noise and leaves coarse noise. Like errors,
V and S are relative to the light. The ratio is rounded to a power of two, so that it is nearly always the same in all
renders of a scene.
"""

from __future__ import annotations

import math

import numpy as np

from data_gen.film import GradientFilm

# The number of paths that feed the cache for each path of the image: in the first round, and the least and the most in
# later rounds
BEGIN, LEAST, MOST = 1 / 2, 1 / 16, 1.0
# The side of a block in pixels, and the share of the noisiest blocks that is left out
_BLOCK, _TRIM = 16, 0.01
# Noise is divided by the light of its block plus this share of the mean light, so the noise of dark blocks counts less.
_DARK = 0.05


def share(film: GradientFilm, fed: float) -> float | None:
    """How many paths should feed the cache for each path of the image; None if this cannot be measured yet.

    ``film`` holds the samples so far. ``fed`` is the number of paths per pixel that have fed the cache so far.
    """
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
    """The means over the blocks of an image (H, W, C). Blocks at the image's borders may be smaller."""
    for axis in (0, 1):
        begins = np.arange(0, image.shape[axis], _BLOCK)
        counts = np.diff(np.append(begins, image.shape[axis]))
        shape = [1, 1, 1]
        shape[axis] = -1
        image = np.add.reduceat(image, begins, axis=axis) / counts.reshape(shape)
    return image
