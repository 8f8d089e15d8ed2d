"""Denoises the light that gradients do not hold, and the light of photons, for all methods.

Such light is rare and bright: most pixels hold none of it, and a few hold what their whole neighbourhood should. So it
is spread by a diffusion [Perona and Malik 1990, "Scale-space and edge detection using anisotropic diffusion"] over
distances of 1, 2, 4, ... pixels [Dammertz et al. 2010, "Edge-avoiding à-trous wavelet transform for fast global
illumination filtering"]: ``ngpt.denoisers.diffusion``. One pixel gets exactly what another gives: no light is lost.
Pixels exchange less light the more their surfaces differ, and the more they differ themselves beyond their noise
[variances travel along as in Schied et al. 2017, "Spatiotemporal variance-guided filtering"].

Photons are the same case: neighbouring pixels gather the same ones, and OIDN takes their blotches for detail, but the
variance reveals them. So method `oidn` leaves them to the diffusion (``ngpt.layers.GATHERED``). They are divided by the
albedo of the surface that they were gathered at, and multiplied again, so that its texture stays sharp.

Methods from gradients that call OIDN anyway take its image of this light (``ngpt.network.inputs.Oidn``): what OIDN
takes for noise is given back by one factor for the whole image (docs/lab/log).
"""

from dataclasses import replace

import numpy as np

from ngpt.denoisers.diffusion import diffused
from ngpt.repair import Repaired

# OIDN's image becomes brighter by at most this factor, to hold the light that there was. A larger one would make
# blotches of the little that OIDN has not taken for outliers.
MOST = 4.0
LOUDEST = 1e30  # variances of light of at most 1 are less, or as good as that
FARTHEST = 1e-6  # depths below this share of the largest one are alike
DARKEST = 0.05  # is added to the albedo that photons are divided by: gloss reflects light where nothing else does


def denoised(data: Repaired) -> np.ndarray:
    """What is added to a reconstruction of ``data.image``: ``data.caustic``, (H, W, 3) float32, with less noise."""
    assert data.caustic is not None
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


def of_photons(data: Repaired) -> np.ndarray:
    """As ``denoised()``, of light that photons have brought; the texture of the surfaces stays."""
    assert data.caustic is not None
    if "albedo" not in data.features:
        return denoised(data)
    texture = np.clip(data.features["albedo"], 0, 1) + np.float32(DARKEST)
    variance = None if data.caustic_var is None else data.caustic_var / texture**2
    light = denoised(replace(data, caustic=data.caustic / texture, caustic_var=variance)) * texture
    return given_back(light, data.caustic)


def given_back(found: np.ndarray, light: np.ndarray) -> np.ndarray:
    """The denoised ``light``, scaled so that its sum is kept, see ``MOST``; both are (H, W, 3)."""
    # OIDN may go below zero where no light does.
    found = np.maximum(found, min(float(light.min()), 0))
    before, after = light.sum(dtype=np.float64), found.sum(dtype=np.float64)
    return found * np.float32(min(before / after, MOST)) if before > 0 and after > 0 else found


def _surfaces(features: dict[str, np.ndarray], size: tuple[int, int]) -> np.ndarray:
    """(N, H, W): albedo, normals and the logarithm of the depth, those there are."""
    planes = [_planes(features[name]) for name in ("albedo", "normal") if name in features]
    if "depth" in features and features["depth"].max() > 0:
        depth = _planes(features["depth"])
        planes.append(np.log(np.maximum(depth, np.float32(FARTHEST) * depth.max())))
    return np.concatenate(planes) if planes else np.zeros((0, *size), np.float32)


def _planes(layer: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(np.moveaxis(layer, -1, 0))
