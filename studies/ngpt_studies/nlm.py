"""Joint non-local means of scikit-image as a method. The first call imports scikit-image."""

from importlib.util import find_spec

import numpy as np

from ngpt.errors import NgptError
from ngpt.methods import Method
from ngpt.repair import Repaired
from ngpt.system.install import install_command

# The bandwidth in standard deviations of the noise, and the weights of features in units of the bandwidth: the noisier
# the image, the more they count. These are about the best of 20 choices on four scenes at 4, 16 and 64 spp.
_NLM_BANDWIDTH = 1.7
_NLM_FEATURES = {"albedo": 16.0, "normal": 8.0}


def missing() -> str:
    return "" if find_spec("skimage") else f"scikit-image is not installed: {install_command('peers')}"


def nlm(data: Repaired) -> np.ndarray:
    """The image denoised by joint non-local means, (H, W, 3) float32.

    Patches are compared in log radiance, albedo and normal; radiance is averaged. The patches are 5x5 in a window of
    19x19 pixels. The logarithm of negative radiance is minus the logarithm of its absolute value. [Buades et al. 2005,
    "A non-local algorithm for image denoising"; features as in Rousselle et al. 2013, "Robust denoising using feature
    and color information"]
    """
    if missing():
        raise NgptError(f"method 'nlm': {missing()}")
    from skimage.restoration import denoise_nl_means

    image = data.image.astype(np.float64)
    size = np.abs(image)
    scale = float(np.median(size[size > 0])) if size.any() else 1.0
    encoded = np.copysign(np.log1p(size / scale), image)
    assert data.noise is not None
    deviations = np.sqrt(np.maximum(np.nan_to_num(data.noise), 0)) / (scale + size)
    sigma = float(deviations.mean(dtype=np.float64))
    # Radiance is averaged in further channels, which are too small to count in the distance. Averages of logarithms
    # would darken the image.
    tiny = 1e-6 / max(float(size.max()), 1e-30)
    bandwidth = max(_NLM_BANDWIDTH * sigma, 1e-6)
    guides = [bandwidth * weight * data.features[name] for name, weight in _NLM_FEATURES.items()]
    stacked = np.concatenate([encoded, *guides, tiny * image], axis=-1)
    height, width = image.shape[:2]
    # scikit-image drops axes of length 1.
    stacked = np.pad(stacked, ((0, int(height == 1)), (0, int(width == 1)), (0, 0)), mode="edge")
    filtered = denoise_nl_means(stacked, patch_size=5, patch_distance=9, h=bandwidth, channel_axis=-1)
    return (filtered[:height, :width, -3:] / tiny).astype(np.float32)


METHOD = Method(
    "joint non-local means of scikit-image", ("primal", "albedo", "normal", "primal_var"), nlm, {}, "study", missing
)
