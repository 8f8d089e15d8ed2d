"""Denoises the light that gradients exclude (the layer ``caustic``), and the light of photons, for all methods.

Such light is rare and bright: most pixels have none of it, and a few have the light of their whole neighbourhood. So it
is spread by a diffusion [Perona and Malik 1990, "Scale-space and edge detection using anisotropic diffusion"] over
distances of 1, 2, 4, ... pixels [Dammertz et al. 2010, "Edge-avoiding à-trous wavelet transform for fast global
illumination filtering"]; see ``ngpt.denoisers.diffusion``. A pixel gets exactly the light that another gives, so no
light is lost. Two pixels exchange less light if their surfaces differ, or if their light differs by more than its
noise. The variances are filtered together with the light [Schied et al. 2017, "Spatiotemporal variance-guided
filtering"].

The light of photons is denoised in the same way. Neighbouring pixels gather the same photons, and OIDN takes the
resulting blotches for detail; only the variance shows that they are noise. So method `oidn` leaves this light to the
diffusion (``ngpt.layers.GATHERED``). It is divided by the albedo of the surface at which the photons were gathered, and
multiplied by it again afterwards, so that textures stay sharp.

Methods that read gradients and use OIDN anyway take OIDN's image of this light (``ngpt.network.inputs.Oidn``). OIDN
removes some of the light as noise, which one factor for the whole image restores (docs/lab/log).
"""

from dataclasses import replace

import numpy as np

from ngpt.denoisers.diffusion import diffused
from ngpt.repair import Repaired

# The largest factor that restores the sum of the light in OIDN's image. A larger one would turn the little light that
# OIDN has left into blotches.
MOST = 4.0
# Variances are clamped to this. Light is at most 1 here, so the result is the same.
LOUDEST = 1e30
# Depths below this share of the largest depth count as equal.
FARTHEST = 1e-6
# Added to the albedo before the division, because a glossy surface of albedo 0 reflects light, too.
DARKEST = 0.05


def denoised(data: Repaired) -> np.ndarray:
    """``data.caustic`` with less noise, (H, W, 3) float32, to be added to a reconstruction of ``data.image``."""
    assert data.caustic is not None
    scale = float(np.abs(data.caustic).max())
    light = _planes(data.caustic) / np.float32(scale)
    # Where the variance is unknown, all light counts as noise.
    noise = light**2
    if data.caustic_var is not None:
        variance = _planes(data.caustic_var) / np.float32(scale) / np.float32(scale)
        known = np.isfinite(variance) & (variance >= 0)
        noise = np.where(known, np.minimum(variance, np.float32(LOUDEST)), noise)
    light = diffused(light, noise.mean(axis=0), _surfaces(data.features, light.shape[1:]))
    return np.ascontiguousarray(np.moveaxis(light, 0, -1)) * np.float32(scale)


def of_photons(data: Repaired) -> np.ndarray:
    """``denoised()`` for light of photons: keeps the texture of surfaces sharp."""
    assert data.caustic is not None
    if "albedo" not in data.features:
        return denoised(data)
    texture = np.clip(data.features["albedo"], 0, 1) + np.float32(DARKEST)
    variance = None if data.caustic_var is None else data.caustic_var / texture**2
    light = denoised(replace(data, caustic=data.caustic / texture, caustic_var=variance)) * texture
    return given_back(light, data.caustic)


def given_back(found: np.ndarray, light: np.ndarray) -> np.ndarray:
    """A denoised image ``found`` of ``light``, scaled to the sum of ``light``, see ``MOST``; both are (H, W, 3)."""
    # OIDN may return negative values even if no light is negative.
    found = np.maximum(found, min(float(light.min()), 0))
    before, after = light.sum(dtype=np.float64), found.sum(dtype=np.float64)
    return found * np.float32(min(before / after, MOST)) if before > 0 and after > 0 else found


def _surfaces(features: dict[str, np.ndarray], size: tuple[int, int]) -> np.ndarray:
    """(N, H, W): albedo, normal and the logarithm of the depth, without those that are missing."""
    planes = [_planes(features[name]) for name in ("albedo", "normal") if name in features]
    if "depth" in features and features["depth"].max() > 0:
        depth = _planes(features["depth"])
        planes.append(np.log(np.maximum(depth, np.float32(FARTHEST) * depth.max())))
    return np.concatenate(planes) if planes else np.zeros((0, *size), np.float32)


def _planes(layer: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(np.moveaxis(layer, -1, 0))
