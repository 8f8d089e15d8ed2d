"""Error of an image against a reference.

x is the image and r the reference, scene-linear (H, W, 3); means run over pixels and channels. Pixels that are not
finite in either are left out and counted, since one of them would hide all others.
"""

import numpy as np

from ngpt.errors import NgptError

# Published relMSE values differ in this constant; ours is that of gradient-domain VCM and photon mapping.
EPSILON = 1e-3


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


def smape(image: np.ndarray, reference: np.ndarray) -> float:
    """Symmetric mean absolute percentage error as a fraction: mean of 2 |x - r| / (|x| + |r|), 0 where both are 0."""
    size = np.abs(image) + np.abs(reference)
    return float(np.divide(2 * np.abs(image - reference), size, out=np.zeros_like(size), where=size > 0).mean())


def psnr_reinhard(image: np.ndarray, reference: np.ndarray) -> float:
    """Peak signal-to-noise ratio in dB of x / (1 + x), values below 0 taken as 0; infinite for equal images."""
    tone_mapped = [np.maximum(i, 0) / (1 + np.maximum(i, 0)) for i in (image, reference)]
    error = float(np.mean((tone_mapped[0] - tone_mapped[1]) ** 2))
    return float("inf") if error == 0 else -10 * np.log10(error)


def compare(image: np.ndarray, reference: np.ndarray) -> dict[str, float]:
    """Every metric, by name, and ``nonfinite``: how many pixels had to be left out.

    Raises NgptError if the images differ in size or have no pixel that is finite in both.
    """
    if image.shape != reference.shape:
        raise NgptError(
            f"images of different size cannot be compared: {image.shape[1]}x{image.shape[0]} and "
            f"{reference.shape[1]}x{reference.shape[0]}; render or crop them alike"
        )
    finite = (np.isfinite(image) & np.isfinite(reference)).all(axis=-1)
    if not finite.any():
        raise NgptError(f"none of {finite.size} pixels is finite in both images")
    # Double precision: squares of 1e12 are fine there, and means of millions of pixels exact enough.
    x, r = (i[finite][None].astype(np.float64) for i in (image, reference))
    return {
        "relMSE": relmse(x, r),
        "relMSE trimmed": relmse_trimmed(x, r),
        "SMAPE": smape(x, r),
        "PSNR": psnr_reinhard(x, r),
        "MSE": float(np.mean((x - r) ** 2)),
        "max |x - r|": float(np.abs(x - r).max()),
        "nonfinite": int(np.sum(~finite)),
    }
