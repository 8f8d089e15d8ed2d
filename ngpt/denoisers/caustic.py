"""The light that no gradient holds, with less noise: the one place where reconstructions from gradients get it from.

Such light is rare and bright: most pixels hold none of it, and a few hold what their whole neighbourhood should. So it
is spread by a diffusion [Perona and Malik 1990, "Scale-space and edge detection using anisotropic diffusion"] over
distances of 1, 2, 4, ... pixels [Dammertz et al. 2010, "Edge-avoiding à-trous wavelet transform for fast global
illumination filtering"]. What one pixel gives is what another gets: no light is lost, however rare it is. Pixels
exchange less light the more their surfaces differ, and the more they differ themselves beyond their noise [variances
travel along as in Schied et al. 2017, "Spatiotemporal variance-guided filtering"].

Methods that call OIDN anyway take its image of this light, which has less error where the light has edges. Half the
size will do: it takes a quarter of the time, and rare light is less rare there, so that OIDN takes less of it for
noise. What it takes is given back by one factor for the whole image. Neither larger networks nor the whole size are
better, nor the mean with what OIDN's image of all light has beyond its image of the rest (docs/lab/log). All other
methods must not depend on a package.
"""

from dataclasses import replace

import numpy as np

from ngpt.denoisers.oidn import oidn
from ngpt.repair import Repaired

# Distances in pixels, one after the other; the last two even out what the grids of the others leave.
DISTANCES = (1, 2, 4, 8, 16, 32, 1, 2)
# Two pixels that differ by so many standard deviations of their noise, beyond it, exchange 1/e of their light.
SIGNIFICANT = 3.0
# The neighbours of one half plane at distance 1, and their weights in the binomial filter of 3x3 pixels.
_NEIGHBOURS = ((0, 1, 1 / 8), (1, 0, 1 / 8), (1, 1, 1 / 16), (1, -1, 1 / 16))
# OIDN's image becomes brighter by less than this factor, to hold the light that there was. Where it would take more,
# OIDN has taken nearly all of the light for outliers, and nothing is given back.
MOST = 4.0
_FARTHEST = 1e-6  # depths below this share of the largest one are alike


def denoised(data: Repaired, by_oidn: bool = False) -> np.ndarray:
    """What is added to a reconstruction of ``data.image``: ``data.caustic``, (H, W, 3) float32, with less noise.

    ``by_oidn``  whether OIDN makes it, and not the diffusion; raises NgptError where it is not installed
    """
    assert data.caustic is not None
    if by_oidn:
        return _by_oidn(data)
    scale = float(np.abs(data.caustic).max())
    light = _planes(data.caustic) / np.float32(scale)
    # What is not known of a variance is that of an estimate that is all noise.
    noise = light**2
    if data.caustic_var is not None:
        variance = _planes(data.caustic_var) / np.float32(scale) / np.float32(scale)
        noise = np.where(np.isfinite(variance), np.maximum(variance, 0), noise)
    light = diffused(light, noise.mean(axis=0), _surfaces(data.features, light.shape[1:]))
    return np.ascontiguousarray(np.moveaxis(light, 0, -1)) * np.float32(scale)


def _by_oidn(data: Repaired) -> np.ndarray:
    assert data.caustic is not None
    small = {name: halved(layer) for name, layer in data.features.items() if name != "depth"}
    given = halved(data.caustic)
    found = oidn(replace(data, image=given, direct=np.zeros_like(given), features=small), "noisy", "high")
    # OIDN may go below zero; there is no negative light.
    light = np.maximum(found, 0)
    before, after = given.sum(dtype=np.float64), light.sum(dtype=np.float64)
    if 0 < before < MOST * after:
        light *= np.float32(before / after)
    height, width = data.caustic.shape[:2]
    return doubled(light)[:height, :width]


def halved(layer: np.ndarray) -> np.ndarray:
    """The means (⌈H / 2⌉, ⌈W / 2⌉, C) of 2x2 pixels; sides of odd length have their last pixels twice."""
    height, width, channels = layer.shape
    layer = np.pad(layer, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
    return layer.reshape(-(-height // 2), 2, -(-width // 2), 2, channels).mean(axis=(1, 3), dtype=np.float32)


def doubled(image: np.ndarray) -> np.ndarray:
    """Bilinear at twice the size, (2 H, 2 W, C); the mean stays."""
    for axis in (0, 1):
        lines = np.moveaxis(image, axis, 0)
        wide = np.concatenate([lines[:1], lines, lines[-1:]])
        both = np.stack([0.25 * wide[:-2] + 0.75 * lines, 0.75 * lines + 0.25 * wide[2:]], axis=1)
        image = np.moveaxis(both.reshape(-1, *lines.shape[1:]), 0, axis)
    return np.ascontiguousarray(image)


def diffused(light: np.ndarray, variance: np.ndarray, surfaces: np.ndarray) -> np.ndarray:
    """``light`` (C, H, W), spread; its sum stays. ``variance`` (H, W) is its own, ``surfaces`` (N, H, W) of any unit.

    Two pixels whose ``surfaces`` are 1 apart exchange 1/e of what they would otherwise.
    """
    height, width = variance.shape
    floor = np.float32(1e-12 * np.mean(light**2) + 1e-37)
    for distance in DISTANCES:
        change, given, taken = np.zeros_like(light), np.zeros_like(variance), np.zeros_like(variance)
        for down, right, weight in _NEIGHBOURS:
            dy, dx = distance * down, distance * right
            if dy >= height or abs(dx) >= width:
                continue
            here = np.s_[..., : height - dy, max(-dx, 0) : width - max(dx, 0)]
            there = np.s_[..., dy:, max(dx, 0) : width - max(-dx, 0)]
            steps = light[there] - light[here]
            noise = variance[here] + variance[there]
            apart = np.maximum(_square(steps) / len(light) - noise, 0) / (SIGNIFICANT**2 * noise + floor)
            apart += _square(surfaces[there] - surfaces[here])
            share = np.float32(weight) * np.exp(-apart)
            steps *= share
            change[here] += steps
            change[there] -= steps
            given[here] += share
            given[there] += share
            share *= share
            taken[here] += share * variance[there]
            taken[there] += share * variance[here]
        light = light + change
        variance = (1 - given) ** 2 * variance + taken
    return light


def _surfaces(features: dict[str, np.ndarray], size: tuple[int, int]) -> np.ndarray:
    """(N, H, W): albedo, normals and the logarithm of the depth, those there are."""
    planes = [_planes(features[name]) for name in ("albedo", "normal") if name in features]
    if "depth" in features and features["depth"].max() > 0:
        depth = _planes(features["depth"])
        planes.append(np.log(np.maximum(depth, np.float32(_FARTHEST) * depth.max())))
    return np.concatenate(planes) if planes else np.zeros((0, *size), np.float32)


def _square(planes: np.ndarray) -> np.ndarray:
    """The sum of squares over the first axis."""
    return np.einsum("nhw,nhw->hw", planes, planes)


def _planes(layer: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(np.moveaxis(layer, -1, 0))
