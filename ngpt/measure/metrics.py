"""Error of an image against a reference.

x is the image and r the reference, scene-linear (H, W, 3); means run over pixels and channels. Pixels that are not
finite in either are left out and counted, since one of them would hide all others.
"""

import numpy as np

from ngpt.errors import NgptError

# Published relMSE values differ in this constant; ours is that of gradient-domain VCM and photon mapping.
EPSILON = 1e-3

# What tables and reports print beside the numbers: name -> (formula, whether "lower" or "higher" is better).
FORMULAS = {
    "relMSE": ("mean of (x - r)² / (r² + 0.001) over pixels and channels", "lower"),
    "relMSE trimmed": ("relMSE without the worst 0.1 % of the pixels", "lower"),
    "relMSE NGPT": ("mean over pixels of mean_c (x - r)² / (mean_c(r)² + 0.001)", "lower"),
    "SMAPE": ("mean of 2 |x - r| / (|x| + |r|)", "lower"),
    "PSNR": ("-10 log10 mean (x' - r')² in dB, with x' = x / (1 + x)", "higher"),
    "MSE": ("mean of (x - r)²", "lower"),
    "max |x - r|": ("largest |x - r|", "lower"),
    "SSIM": ("structural similarity of x / (1 + x), Gaussian window of sigma 1.5, mean over channels", "higher"),
    "FLIP": ("mean HDR-FLIP, 67 pixels per degree, exposures computed from the reference", "lower"),
    "E-LPIPS": ("E-LPIPS of SqueezeNet on sRGB(x / (1 + mean_c x)), mean of 16 random transforms", "lower"),
}


def relative_squared_error(image: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """(x - r)² / (r² + 1e-3) per pixel and channel."""
    return (image - reference) ** 2 / (reference**2 + EPSILON)


def relmse(image: np.ndarray, reference: np.ndarray) -> float:
    """Mean of (x - r)² / (r² + 1e-3)."""
    return float(relative_squared_error(image, reference).mean())


def relmse_trimmed(image: np.ndarray, reference: np.ndarray, share: float = 0.001) -> float:
    """relMSE without the worst 0.1 % of the pixels (by channel mean), which fireflies would otherwise decide."""
    error = np.sort(relative_squared_error(image, reference).mean(axis=-1), axis=None)
    return float(error[: error.size - int(share * error.size)].mean())


def relmse_channel_mean(image: np.ndarray, reference: np.ndarray) -> float:
    """relMSE as the code of NGPT has it: mean over pixels of mean_c (x - r)² / (mean_c(r)² + 1e-3).

    The squared error's mean over the channels c, relative to the grey of the reference: saturated colours count less.
    """
    error = ((image - reference) ** 2).mean(axis=-1)
    return float((error / (reference.mean(axis=-1) ** 2 + EPSILON)).mean())


def smape(image: np.ndarray, reference: np.ndarray) -> float:
    """Symmetric mean absolute percentage error as a fraction: mean of 2 |x - r| / (|x| + |r|), 0 where both are 0."""
    size = np.abs(image) + np.abs(reference)
    return float(np.divide(2 * np.abs(image - reference), size, out=np.zeros_like(size), where=size > 0).mean())


def reinhard(image: np.ndarray) -> np.ndarray:
    """The tone map of PSNR and SSIM: x / (1 + x) for each channel, in [0, 1), values below 0 taken as 0."""
    positive = np.maximum(image, 0)
    return positive / (1 + positive)


def psnr_reinhard(image: np.ndarray, reference: np.ndarray) -> float:
    """Peak signal-to-noise ratio in dB of x / (1 + x): -10 log10 mean (x' - r')²; infinite for equal images."""
    error = float(np.mean((reinhard(image) - reinhard(reference)) ** 2))
    return float("inf") if error == 0 else -10 * np.log10(error)


def check_size(image: np.ndarray, reference: np.ndarray) -> None:
    """Raises NgptError if the images cannot be compared."""
    if image.shape != reference.shape:
        raise NgptError(
            f"images of different size cannot be compared: {image.shape[1]}x{image.shape[0]} and "
            f"{reference.shape[1]}x{reference.shape[0]}; render or crop them alike"
        )


def exposure_mismatch(image: np.ndarray, reference: np.ndarray) -> float:
    """The stops that the image is brighter than its reference: log2 of the ratio of their mean radiance.

    The worst 0.1 % of the values of either are left out. Reconstruction moves it by a fraction of a stop; more means a
    reference of another exposure, camera or scene. 0 where either is black.
    """
    sums = []
    for values in (image[np.isfinite(image)], reference[np.isfinite(reference)]):
        limit = np.quantile(values, 0.999) if values.size else 0.0
        sums.append(float(np.minimum(values, limit).mean(dtype=np.float64)) if values.size else 0.0)
    return float(np.log2(sums[0] / sums[1])) if min(sums) > 0 else 0.0


def compare(image: np.ndarray, reference: np.ndarray) -> dict[str, float]:
    """The metrics of ``FORMULAS`` that need no package, and ``nonfinite``: how many pixels had to be left out.

    ``ngpt.measure.perceptual`` has the others. Raises NgptError if the images differ in size or have no pixel that is
    finite in both.
    """
    check_size(image, reference)
    finite = (np.isfinite(image) & np.isfinite(reference)).all(axis=-1)
    if not finite.any():
        raise NgptError(f"none of {finite.size} pixels is finite in both images")
    # Double precision: squares of 1e12 are fine there, and means of millions of pixels exact enough.
    x, r = (i[finite][None].astype(np.float64) for i in (image, reference))
    return {
        "relMSE": relmse(x, r),
        "relMSE trimmed": relmse_trimmed(x, r),
        "relMSE NGPT": relmse_channel_mean(x, r),
        "SMAPE": smape(x, r),
        "PSNR": psnr_reinhard(x, r),
        "MSE": float(np.mean((x - r) ** 2)),
        "max |x - r|": float(np.abs(x - r).max()),
        "nonfinite": int(np.sum(~finite)),
    }
