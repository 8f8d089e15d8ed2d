"""Metrics of what the eye sees. Each needs an optional package or weights; ``lack`` and ``elpips_lack`` say which.

x is the image and r the reference, scene-linear (H, W, 3), finite; values below 0 count as 0.
"""

import math
from collections.abc import Callable
from functools import lru_cache
from importlib.util import find_spec

import numpy as np

from ngpt.errors import NgptError
from ngpt.measure.images import check_size, reinhard

# Of the random transforms of E-LPIPS; the standard error of the mean is then a few per cent.
_DRAWS = 16


def lack(name: str, module: str, package: str, extra: str = "peers") -> str:
    """Why metric ``name``, which imports ``module`` of ``package``, cannot be computed here; "" if it can."""
    return "" if find_spec(module) else f"{name} needs {package}: pip install 'ngpt-recon[{extra}]'"


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


def flip(image: np.ndarray, reference: np.ndarray) -> tuple[float, np.ndarray]:
    """Mean HDR-FLIP in [0, 1] and its map (H, W) [Andersson et al. 2021, "Visualizing errors in rendered HDR images"].

    The largest over exposures of LDR-FLIP at 67 pixels per degree; ``flip_exposures`` fixes the exposures from the
    reference, so all images of a scene are judged by the same ones.
    """
    check_size(image, reference)
    import flip_evaluator

    start, stop, count = flip_exposures(reference)
    parameters = {"startExposure": start, "stopExposure": stop, "numExposures": count, "tonemapper": "ACES"}
    x, r = (np.ascontiguousarray(np.clip(i, 0, 1e30), np.float32) for i in (image, reference))
    errors, mean, _ = flip_evaluator.evaluate(r, x, "HDR", applyMagma=False, parameters=parameters)
    return float(mean), np.ascontiguousarray(errors).reshape(image.shape[:2])


def flip_exposures(reference: np.ndarray) -> tuple[float, float, int]:
    """(first, last, number) of HDR-FLIP's exposures in stops, from the reference alone.

    Those at which the brightest and the median luminance reach 0.85 under the ACES curve, one a stop [section 4.3].
    """
    luminance = np.maximum(reference, 0).astype(np.float64) @ np.array([0.2126, 0.7152, 0.0722])
    lit = luminance[luminance > 0]
    if not lit.size:
        return 0.0, 0.0, 2
    median = float(np.median(luminance)) or float(np.median(lit))
    # y = (a x² + b x) / (c x² + d x + e) of ACES as FLIP has it, solved for x at y = 0.85.
    a, b, c, d, e = 0.6 * 0.6 * 2.51, 0.6 * 0.03, 0.6 * 0.6 * 2.43, 0.6 * 0.59, 0.14
    p, q, s = a - 0.85 * c, b - 0.85 * d, -0.85 * e
    white = (-q + math.sqrt(q * q - 4 * p * s)) / (2 * p)
    start, stop = math.log2(white / float(lit.max())), math.log2(white / median)
    return start, stop, max(2, math.ceil(stop - start))


def elpips(image: np.ndarray, reference: np.ndarray, backbone: str = "", weights: str = "") -> float:
    """E-LPIPS by SqueezeNet, 0 for equal images; ``backbone`` and ``weights`` are files that docs/train/losses.md
    explains.

    d(x, r) averaged over random transforms [Kettunen et al. 2019, "E-LPIPS"], of sRGB(x / (1 + mean_c x)); the draws
    are the same for all images. Raises NgptError for files that are missing or not what they should be.
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
    # torch takes seconds to come in.
    import torch

    from ngpt.measure.distances.perceptual import PerceptualDistance

    measure = PerceptualDistance("elpips-squeeze", _DRAWS, 8, backbone, weights)

    def distance(image: np.ndarray, reference: np.ndarray) -> float:
        check_size(image, reference)
        x, r = (torch.from_numpy(i.astype(np.float32)).permute(2, 0, 1)[None] for i in (image, reference))
        with torch.inference_mode():
            return float(measure(x, r, torch.Generator().manual_seed(0)))

    return distance
