"""Perceptual metrics, which need optional packages or weights (``lack``, ``elpips_lack``).

x is the image and r the reference, scene-linear (H, W, 3), finite; values below 0 count as 0.
"""

from collections.abc import Callable
from functools import lru_cache
from importlib.util import find_spec

import numpy as np

from ngpt.errors import NgptError
from ngpt.measure.images import check_size, reinhard
from ngpt.system.forks import in_children
from ngpt.system.install import install_command

# The number of random transforms of E-LPIPS, with which the standard error of the mean is a few per cent.
_DRAWS = 16


def lack(name: str, module: str, package: str, extra: str = "peers") -> str:
    """Why the metric ``name``, which needs ``module`` of ``package``, cannot be computed here; "" if it can."""
    return "" if find_spec(module) else f"{name} needs {package}: {install_command(extra)}"


def ssim(image: np.ndarray, reference: np.ndarray) -> tuple[float, np.ndarray]:
    """Structural similarity of x' = x / (1 + x), in [-1, 1], 1 for equal images, and its map (H, W) [Wang et al. 2004].

    mean of (2 μx μr + C1)(2 σxr + C2) / ((μx² + μr² + C1)(σx² + σr² + C2)) over pixels and channels, moments under a
    Gaussian of σ = 1.5 pixels, C1 = 0.01², C2 = 0.03². The mean leaves out 5 pixels at each border. Raises NgptError
    for images under 11 pixels.
    """
    check_size(image, reference)
    if min(image.shape[:2]) < 11:
        raise NgptError(f"SSIM: the image is {image.shape[1]}x{image.shape[0]}; its window takes 11x11 pixels")
    from skimage.metrics import structural_similarity

    x, r = (reinhard(np.asarray(i, np.float64)) for i in (image, reference))
    options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    mean, similarity = structural_similarity(x, r, data_range=1.0, channel_axis=-1, full=True, **options)
    return float(mean), similarity.mean(axis=-1)


def elpips(image: np.ndarray, reference: np.ndarray, backbone: str = "", weights: str = "") -> float:
    """E-LPIPS by SqueezeNet, 0 for equal images.

    It is the distance d(x, r) of sRGB(x / (1 + mean_c x)), averaged over random transforms [Kettunen et al. 2019,
    "E-LPIPS"]. All images get the same transforms. docs/train/losses.md explains the files ``backbone`` and
    ``weights``. Raises NgptError for files that are missing or have the wrong contents.
    """
    return _elpips(backbone, weights)(image, reference)


def elpips_lack(backbone: str = "", weights: str = "") -> str:
    """Why E-LPIPS cannot be computed here, "" if it can."""
    if without := lack("E-LPIPS", "torch", "torch", "train"):
        return without
    try:
        _elpips(backbone, weights)
    except NgptError as error:
        return str(error)
    return ""


@lru_cache(maxsize=1)
def _elpips(backbone: str, weights: str) -> Callable[[np.ndarray, np.ndarray], float]:
    # Importing torch takes seconds.
    import torch

    from ngpt.measure.distances.perceptual import PerceptualDistance
    from ngpt.network.run_torch import one_thread

    in_children(one_thread)
    measure = PerceptualDistance("elpips-squeeze", _DRAWS, 8, backbone, weights)

    def distance(image: np.ndarray, reference: np.ndarray) -> float:
        check_size(image, reference)
        x, r = (torch.from_numpy(i.astype(np.float32)).permute(2, 0, 1)[None] for i in (image, reference))
        with torch.inference_mode():
            return float(measure(x, r, torch.Generator().manual_seed(0)))

    return distance
