"""HDR-FLIP, computed by its authors' package: the difference that a viewer sees when flipping between two images."""

import ctypes
import math
from pathlib import Path

import numpy as np

from ngpt.measure.images import check_size
from ngpt.system.forks import in_children


def flip(image: np.ndarray, reference: np.ndarray) -> tuple[float, np.ndarray]:
    """Mean HDR-FLIP in [0, 1] and its map (H, W) [Andersson et al. 2021, "Visualizing errors in rendered HDR images"].

    In each pixel it is the largest LDR-FLIP over several exposures, at 67 pixels per degree. The exposures depend only
    on the reference (``flip_exposures``), so they are the same for all images of a scene.
    """
    check_size(image, reference)
    import flip_evaluator

    in_children(_one_thread)
    start, stop, count = flip_exposures(reference)
    parameters = {"startExposure": start, "stopExposure": stop, "numExposures": count, "tonemapper": "ACES"}
    x, r = (np.ascontiguousarray(np.clip(i, 0, 1e30), np.float32) for i in (image, reference))
    errors, mean, _ = flip_evaluator.evaluate(r, x, "HDR", applyMagma=False, parameters=parameters)
    return float(mean), np.ascontiguousarray(errors).reshape(image.shape[:2])


def flip_exposures(reference: np.ndarray) -> tuple[float, float, int]:
    """(first, last, number) of HDR-FLIP's exposures in stops, which depend only on the reference.

    At the first exposure, the ACES curve maps the brightest luminance to 0.85. At the last exposure, it maps the median
    luminance to 0.85. There is one exposure for each stop between them [section 4.3].
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


def _one_thread() -> None:
    """Sets the package's OpenMP to one thread: a forked child would wait forever for the threads of its parent."""
    import flip_evaluator

    for library in Path(f"{Path(flip_evaluator.__file__).parent}.libs").glob("libgomp*"):
        ctypes.CDLL(str(library)).omp_set_num_threads(1)
