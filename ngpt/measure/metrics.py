"""Errors of an image relative to a reference, and the registry of all metrics.

x is the image, scene-linear (H, W, 3). The reference is one image r, or two independent halves a and b: renders of the
same scene with different seeds. Means are over pixels and channels. Pixels that are not finite in one of the images are
left out and counted, because otherwise one of them would make the whole mean NaN.

A reference has noise. With one image r = t + n, where t is the truth, the mean of (x - r)² is the mean of (x - t)² plus
the mean of n². With two halves, the square becomes the product (x - a)(x - b). The noise of a and b is independent and
has mean zero, so the expectation of the product is (x - t)², whatever the noise. The product in a pixel, and even a
mean, may be negative if the image is closer to the truth than the reference. Denominators use the mean m = (a + b) / 2.
The noise of m is not corrected for: if m has the relative variance v, and the image the relative bias β, this noise
adds about 6 v² + 4 v β to relMSE.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from ngpt.errors import NgptError
from ngpt.measure import flip, perceptual
from ngpt.measure.images import check_size, middle, reinhard
from ngpt.system.parts import Registry

# Publications use different constants for relMSE; this one is from gradient-domain VCM and photon mapping.
EPSILON = 1e-3


def squared_error(image: np.ndarray, *halves: np.ndarray) -> np.ndarray:
    """(x - r)², or (x - a)(x - b) with two halves, per pixel and channel."""
    return (image - halves[0]) * (image - halves[-1])


def relative_squared_error(image: np.ndarray, *halves: np.ndarray) -> np.ndarray:
    """(x - r)² / (r² + 1e-3), or (x - a)(x - b) / (m² + 1e-3) with two halves, per pixel and channel."""
    return squared_error(image, *halves) / (middle(halves) ** 2 + EPSILON)


def relmse(image: np.ndarray, *halves: np.ndarray) -> float:
    """Mean of (x - r)² / (r² + 1e-3), or of (x - a)(x - b) / (m² + 1e-3)."""
    return float(relative_squared_error(image, *halves).mean())


def relmse_trimmed(image: np.ndarray, *halves: np.ndarray, share: float = 0.001) -> float:
    """relMSE without the worst 0.1 % of the pixels, so that fireflies do not dominate.

    The worst pixels have the largest (x - r)² / (r² + 1e-3), averaged over channels. With two halves, r is m here.
    """
    errors, sizes = (relative_squared_error(image, *r) for r in (halves, (middle(halves),)))
    return trimmed_mean(errors, sizes, share)


def trimmed_mean(values: np.ndarray, sizes: np.ndarray, share: float) -> float:
    """The mean of ``values`` (H, W, 3), without the ``share`` of pixels with the largest ``sizes`` (H, W, 3)."""
    order = np.argsort(sizes.mean(axis=-1), axis=None)
    return float(values.mean(axis=-1).ravel()[order[: order.size - int(share * order.size)]].mean())


def relmse_channel_mean(image: np.ndarray, *halves: np.ndarray) -> float:
    """relMSE as NGPT's code computes it: mean over pixels of mean_c (x - r)² / (mean_c(r)² + 1e-3).

    The squared error is averaged over the channels c and divided by the squared grey of the reference, so saturated
    colours count less.
    """
    error = squared_error(image, *halves).mean(axis=-1)
    return float((error / (middle(halves).mean(axis=-1) ** 2 + EPSILON)).mean())


def mse(image: np.ndarray, *halves: np.ndarray) -> float:
    """Mean of (x - r)², or of (x - a)(x - b)."""
    return float(squared_error(image, *halves).mean())


def psnr_reinhard(image: np.ndarray, *halves: np.ndarray) -> float:
    """Peak signal-to-noise ratio in dB: -10 log10 of the MSE of x' = x / (1 + x); infinite if the MSE is not positive.

    Noise changes the mean of a tone-mapped half, in proportion to its variance and to the second derivative of the
    curve. Two halves do not remove this small bias.
    """
    error = mse(reinhard(image), *map(reinhard, halves))
    return float("inf") if error <= 0 else float(-10 * np.log10(error))


def smape(image: np.ndarray, reference: np.ndarray) -> float:
    """Symmetric mean absolute percentage error as a fraction: mean of 2 |x - r| / (|x| + |r|), 0 where both are 0."""
    size = np.abs(image) + np.abs(reference)
    return float(np.divide(2 * np.abs(image - reference), size, out=np.zeros_like(size), where=size > 0).mean())


def largest(image: np.ndarray, reference: np.ndarray) -> float:
    """The largest |x - r|."""
    return float(np.abs(image - reference).max())


@dataclass(frozen=True)
class Metric:
    """One metric, as tables, reports and ``ngpt diff`` use it.

    ``formula``   the text that is printed beside the numbers
    ``better``    "lower" or "higher"
    ``function``  (x, r, **options) -> float; a ``squared`` metric also takes (x, a, b)
    ``squared``   the metric is a mean of squares (x - r)², so that two halves remove the noise of the reference
    ``whole``     the metric reads neighbourhoods: it gets whole images, with 0 in place of values that are not finite;
                  other metrics get only the finite pixels
    ``missing``   (**options) -> why it cannot be computed here, "" if it can; None if it needs only NumPy
    """

    formula: str
    better: str
    function: Callable[..., float]
    squared: bool = False
    whole: bool = False
    missing: Callable[..., str] | None = None


_OURS = {
    "relMSE": Metric("mean of (x - r)² / (r² + 0.001) over pixels and channels", "lower", relmse, squared=True),
    "relMSE trimmed": Metric("relMSE without the worst 0.1 % of the pixels", "lower", relmse_trimmed, squared=True),
    "relMSE NGPT": Metric(
        "mean over pixels of mean_c (x - r)² / (mean_c(r)² + 0.001)", "lower", relmse_channel_mean, squared=True
    ),
    "SMAPE": Metric("mean of 2 |x - r| / (|x| + |r|)", "lower", smape),
    "PSNR": Metric("-10 log10 mean (x' - r')² in dB, with x' = x / (1 + x)", "higher", psnr_reinhard, squared=True),
    "MSE": Metric("mean of (x - r)²", "lower", mse, squared=True),
    "max |x - r|": Metric("largest |x - r|", "lower", largest),
    "SSIM": Metric(
        "structural similarity of x / (1 + x), Gaussian window of sigma 1.5, mean over channels",
        "higher",
        lambda image, reference: perceptual.ssim(image, reference)[0],
        whole=True,
        missing=partial(perceptual.lack, "SSIM", "skimage", "scikit-image"),
    ),
    "FLIP": Metric(
        "mean HDR-FLIP, 67 pixels per degree, exposures computed from the reference",
        "lower",
        lambda image, reference: flip.flip(image, reference)[0],
        whole=True,
        missing=partial(perceptual.lack, "FLIP", "flip_evaluator", "flip-evaluator"),
    ),
    "E-LPIPS": Metric(
        "E-LPIPS of SqueezeNet on sRGB(x / (1 + mean_c x)), mean of 16 random transforms",
        "lower",
        perceptual.elpips,
        whole=True,
        missing=perceptual.elpips_lack,
    ),
}
# Other packages register metrics by entry points.
METRICS = Registry("ngpt.metrics", "metric", Metric, _OURS)


def scores(
    names: Iterable[str], image: np.ndarray, *halves: np.ndarray, options: dict[str, dict[str, Any]] | None = None
) -> dict[str, float]:
    """Metrics of ``METRICS`` by name, in double precision; ``options`` holds arguments of their functions, by metric.

    Squared metrics get all ``halves`` (one image or two), the others their mean. Raises NgptError if the images differ
    in size or have no pixel that is finite in all of them.
    """
    for half in halves:
        check_size(image, half)
    finite = _finite(image, *halves)
    if not finite.any():
        raise NgptError(f"none of {finite.size} pixels is finite in {'both' if len(halves) == 1 else 'all'} images")
    # In double precision, squares of 1e12 are finite, and means of millions of pixels are accurate.
    x, *parts = (i[finite][None].astype(np.float64) for i in (image, *halves))
    values = {}
    for name in names:
        metric, more = METRICS[name], (options or {}).get(name, {})
        if metric.squared:
            values[name] = metric.function(x, *parts, **more)
        elif metric.whole:
            filled = (np.nan_to_num(i, nan=0.0, posinf=0.0, neginf=0.0) for i in (image, middle(halves)))
            values[name] = metric.function(*filled, **more)
        else:
            values[name] = metric.function(x, middle(tuple(parts)), **more)
    return values


def compare(image: np.ndarray, reference: np.ndarray) -> dict[str, float]:
    """The metrics that need no package, and ``nonfinite``: the number of pixels left out.

    Raises NgptError if the images differ in size or have no pixel that is finite in both.
    """
    values = scores((name for name, metric in METRICS.items() if metric.missing is None), image, reference)
    return {**values, "nonfinite": int(np.sum(~_finite(image, reference)))}


def _finite(*images: np.ndarray) -> np.ndarray:
    """(H, W): pixels that are finite in all of them."""
    return np.logical_and.reduce([np.isfinite(image).all(axis=-1) for image in images])


def exposure_mismatch(image: np.ndarray, reference: np.ndarray) -> float:
    """How many stops the image is brighter than its reference: log2 of the ratio of their mean radiance.

    Values are clamped to the 99.9 % quantile of their image. A reconstruction changes the ratio by a fraction of a
    stop. A larger value means that the reference has another exposure, camera or scene. 0 if an image is black.
    """
    sums = []
    for values in (image[np.isfinite(image)], reference[np.isfinite(reference)]):
        limit = np.quantile(values, 0.999) if values.size else 0.0
        sums.append(float(np.minimum(values, limit).mean(dtype=np.float64)) if values.size else 0.0)
    return float(np.log2(sums[0] / sums[1])) if min(sums) > 0 else 0.0
