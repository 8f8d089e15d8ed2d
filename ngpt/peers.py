"""Denoisers of other people as methods, for comparison: they want the primal and features, no gradients.

Each is imported when it is first called; ``missing()`` says what to install.
"""

from collections.abc import Mapping
from functools import lru_cache
from importlib.util import find_spec
from typing import Any

import numpy as np

from ngpt.errors import NgptError
from ngpt.repair import Repaired

AUXILIARY = ("prefiltered", "clean", "noisy", "none")
REMEDY = "pip install 'ngpt-recon[peers]'"

# The bandwidth of nlm in standard deviations of the noise, and the weights of features against it: the noisier the
# image, the more they count. About the best of 20 choices on four scenes at 4, 16 and 64 spp.
_NLM_BANDWIDTH = 1.7
_NLM_FEATURES = {"albedo": 16.0, "normal": 8.0}


def oidn_missing() -> str:
    return "" if find_spec("mitsuba_oidn") else f"OIDN (mitsuba-oidn) is not installed: {REMEDY}"


def nlm_missing() -> str:
    return "" if find_spec("skimage") else f"scikit-image is not installed: {REMEDY}"


def oidn(data: Repaired, auxiliary: str, quality: str) -> np.ndarray:
    """Intel Open Image Denoise, its filter "RT" for HDR images, with albedo and normal.

    ``auxiliary``  what OIDN is told of the features: "prefiltered" denoises them by its own models first and calls them
                   clean then, which is how its documentation has the best quality made; "clean" calls them clean as
                   they are; "noisy" does not; "none" hides them
    ``quality``    "high", "balanced" or "fast"
    """
    _require(oidn_missing(), "oidn")
    if auxiliary not in AUXILIARY:
        raise NgptError(f"method 'oidn': auxiliary '{auxiliary}': choose one of: {', '.join(AUXILIARY)}")
    import mitsuba_oidn

    qualities = {"high": "High", "balanced": "Balanced", "fast": "Fast"}
    if quality not in qualities:
        raise NgptError(f"method 'oidn': quality '{quality}': choose one of: {', '.join(qualities)}")
    level = getattr(mitsuba_oidn.Quality, qualities[quality])
    features = {}
    if auxiliary == "prefiltered":
        features = prefiltered(data.features)
    elif auxiliary != "none":
        features = _in_range(data.features)
    # With the light sources seen, as a renderer hands it over and OIDN was trained.
    image = np.ascontiguousarray(data.image + data.direct, np.float32)
    options = {"hdr": True, "clean_aux": auxiliary in ("prefiltered", "clean"), "quality": level}
    # A copy: the result is a view of a buffer that OIDN owns.
    return np.array(mitsuba_oidn.denoise(image, **features, **options)) - data.direct


def prefiltered(features: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Albedo and normal (H, W, 3) denoised by OIDN's own models for them; takes longer than the image itself."""
    _require(oidn_missing(), "oidn")
    return {name: _prefiltered(name, layer) for name, layer in _in_range(features).items()}


def _in_range(features: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    layers = {name: np.ascontiguousarray(features[name]) for name in ("albedo", "normal")}
    return layers | {"albedo": np.clip(layers["albedo"], 0, 1)}


def _prefiltered(name: str, layer: np.ndarray) -> np.ndarray:
    """A feature denoised by OIDN's own model for it."""
    if not layer.any():
        return layer
    result = np.zeros_like(layer)
    device, held = _filters()
    key = (name, layer.shape)
    if key not in held:
        if len(held) > 8:
            held.clear()
        held[key] = device.new_filter("RT")
    held[key].set_image(name, layer)
    held[key].set_image("output", result)
    held[key].execute()
    return result


@lru_cache(maxsize=1)
def _filters() -> tuple[Any, dict]:
    """The device, and its filters by feature and size: to make one takes longer than to run it."""
    import mitsuba_oidn

    # On the CPU arrays are used where they lie; results would have to be copied from elsewhere.
    return mitsuba_oidn.Device(mitsuba_oidn.DeviceType.CPU), {}


def nlm(data: Repaired) -> np.ndarray:
    """Joint non-local means of scikit-image: patches compared in log radiance, albedo and normal, radiance averaged.

    [Buades et al. 2005, "A non-local algorithm for image denoising"; features as in Rousselle et al. 2013, "Robust
    denoising using feature and color information".] The patches are 5x5 in a window of 19x19 pixels. Negative
    radiance, which logarithms do not take, counts as none.
    """
    _require(nlm_missing(), "nlm")
    from skimage.restoration import denoise_nl_means

    image = np.maximum(data.image, 0).astype(np.float64)
    scale = float(np.median(image[image > 0])) if (image > 0).any() else 1.0
    encoded = np.log1p(image / scale)
    assert data.noise is not None
    deviations = np.sqrt(np.maximum(np.nan_to_num(data.noise), 0)) / (scale + image)
    sigma = float(deviations.mean(dtype=np.float64))
    # The image itself travels along, too small to count in the distance: its means are of radiance, not of logarithms,
    # which would darken it.
    tiny = 1e-6 / max(float(image.max()), 1e-30)
    bandwidth = max(_NLM_BANDWIDTH * sigma, 1e-6)
    guides = [bandwidth * weight * data.features[name] for name, weight in _NLM_FEATURES.items()]
    stacked = np.concatenate([encoded, *guides, tiny * image], axis=-1)
    height, width = image.shape[:2]
    # scikit-image drops axes of length 1.
    stacked = np.pad(stacked, ((0, int(height == 1)), (0, int(width == 1)), (0, 0)), mode="edge")
    filtered = denoise_nl_means(stacked, patch_size=5, patch_distance=9, h=bandwidth, channel_axis=-1)
    return (filtered[:height, :width, -3:] / tiny).astype(np.float32)


def _require(lack: str, name: str) -> None:
    if lack:
        raise NgptError(f"method '{name}': {lack}")
