"""The light that no gradient holds, and the light of photons, with less noise: all methods get it from here.

Such light is rare and bright: most pixels hold none of it, and a few hold what their whole neighbourhood should. So it
is spread by a diffusion [Perona and Malik 1990, "Scale-space and edge detection using anisotropic diffusion"] over
distances of 1, 2, 4, ... pixels [Dammertz et al. 2010, "Edge-avoiding à-trous wavelet transform for fast global
illumination filtering"]: ``ngpt.denoisers.diffusion``. What one pixel gives is what another gets: no light is lost.
Pixels exchange less light the more their surfaces differ, and the more they differ themselves beyond their noise
[variances travel along as in Schied et al. 2017, "Spatiotemporal variance-guided filtering"].

Photons are the same case: neighbouring pixels gather the same ones, and OIDN takes their blotches for detail, but the
variance tells them. So method `oidn` leaves them to the diffusion (``ngpt.layers.GATHERED``).

Methods from gradients that call OIDN anyway take its image of this light at half the size, which has less error where
the light has edges; what it takes for noise is given back by one factor for the whole image (docs/lab/log).
"""

from dataclasses import replace

import numpy as np

from ngpt.denoisers.diffusion import diffused
from ngpt.denoisers.oidn import oidn
from ngpt.repair import Repaired

# OIDN's image becomes brighter by at most this factor, to hold the light that there was. A larger one would make
# blotches of the little that OIDN has not taken for outliers.
MOST = 4.0
LOUDEST = 1e30  # variances of light of at most 1 are less, or as good as that
FARTHEST = 1e-6  # depths below this share of the largest one are alike


def denoised(data: Repaired, by_oidn: bool = False) -> np.ndarray:
    """What is added to a reconstruction of ``data.image``: ``data.caustic``, (H, W, 3) float32, with less noise.

    ``by_oidn``  whether OIDN makes it, and not the diffusion; raises NgptError where it is not installed
    """
    assert data.caustic is not None
    if by_oidn:
        height, width = data.caustic.shape[:2]
        return doubled(of_half_size(data))[:height, :width]
    scale = float(np.abs(data.caustic).max())
    light = _planes(data.caustic) / np.float32(scale)
    # Where the variance is not known, the estimate counts as pure noise.
    noise = light**2
    if data.caustic_var is not None:
        variance = _planes(data.caustic_var) / np.float32(scale) / np.float32(scale)
        known = np.isfinite(variance) & (variance >= 0)
        noise = np.where(known, np.minimum(variance, np.float32(LOUDEST)), noise)
    light = diffused(light, noise.mean(axis=0), _surfaces(data.features, light.shape[1:]))
    return np.ascontiguousarray(np.moveaxis(light, 0, -1)) * np.float32(scale)


def of_half_size(data: Repaired) -> np.ndarray:
    """OIDN's image of ``data.caustic``, (⌈H / 2⌉, ⌈W / 2⌉, 3), with as much light, see ``MOST``."""
    assert data.caustic is not None
    small = {name: halved(layer) for name, layer in data.features.items() if name != "depth"}
    given = halved(data.caustic)
    found = oidn(replace(data, image=given, direct=np.zeros_like(given), features=small, empty=None), "noisy", "high")
    # OIDN may go below zero where no light does.
    light = np.maximum(found, min(float(given.min()), 0))
    before, after = given.sum(dtype=np.float64), light.sum(dtype=np.float64)
    if before > 0 and after > 0:
        light *= np.float32(min(before / after, MOST))
    return light


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


def _surfaces(features: dict[str, np.ndarray], size: tuple[int, int]) -> np.ndarray:
    """(N, H, W): albedo, normals and the logarithm of the depth, those there are."""
    planes = [_planes(features[name]) for name in ("albedo", "normal") if name in features]
    if "depth" in features and features["depth"].max() > 0:
        depth = _planes(features["depth"])
        planes.append(np.log(np.maximum(depth, np.float32(FARTHEST) * depth.max())))
    return np.concatenate(planes) if planes else np.zeros((0, *size), np.float32)


def _planes(layer: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(np.moveaxis(layer, -1, 0))
