"""The error map of the page, report.html, in Python: what its script must agree with."""

import numpy as np

from ngpt.report.display import ERROR_EPSILON, ERROR_RANGE, auto_exposure, coloured, heat_table


def relative_squared_error(image: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """(H, W): the mean over RGB of (image - reference)^2 / (reference^2 + epsilon), no unit, 0 is equal.

    Both are brought to the automatic exposure of the reference first, so that ERROR_EPSILON means as much in a dim
    scene as in a bright one: relMSE, which takes them as they are, calls every image of a dim scene good.
    """
    image, reference = image.astype(np.float64), reference.astype(np.float64)
    epsilon = ERROR_EPSILON * 4.0 ** -auto_exposure(reference)
    with np.errstate(invalid="ignore", over="ignore"):
        return np.mean((image - reference) ** 2 / (reference**2 + epsilon), axis=2)


def error_map(image: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """The relative squared error of each pixel in the colours of :func:`heat_table`.

    The scale is logarithmic over ERROR_RANGE: black is an error of at most 1 %, the middle 10 %, pale yellow 100 % or
    more (an error here is the root of the relative squared error).
    """
    error = relative_squared_error(image, reference)
    low, high = np.log10(ERROR_RANGE)
    with np.errstate(divide="ignore"):
        place = (np.log10(error) - low) / (high - low)
    return coloured(place, heat_table())
