"""The primaries of a file, from its header, and the conversion to linear Rec. 709, which displays need.

The first of these attributes that is present counts: ``acesImageContainerFlag`` (SMPTE ST 2065-4),
``colorInteropID`` (the names of the Color Interop Forum), ``chromaticities`` and ``oiio:ColorSpace`` (OpenImageIO). By
OpenEXR's rule a file without them has the primaries of Rec. 709:
https://openexr.com/en/latest/TechnicalIntroduction.html
"""

import logging
import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from ngpt.stack import GradientStack

_LOG = logging.getLogger(__name__)

# x, y of red, green, blue and white
REC709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
REC2020 = (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, 0.3127, 0.3290)
P3_D65 = (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, 0.3127, 0.3290)
ADOBE_RGB = (0.64, 0.33, 0.21, 0.71, 0.15, 0.06, 0.3127, 0.3290)
XYZ_D65 = (1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.3127, 0.3290)  # the name for CIE X, Y, Z themselves
ACES_AP0 = (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, 0.32168, 0.33767)
ACES_AP1 = (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, 0.32168, 0.33767)
# Names of linear spaces, reduced to lower-case letters and digits
_NAMES = {
    REC709: "linrec709scene linrec709 linsrgb linearrec709 linearrec709srgb linearsrgb utilitylinearrec709",
    REC2020: "linrec2020scene linrec2020 linearrec2020 utilitylinearrec2020",
    P3_D65: "linp3d65scene linp3d65 linearp3d65 utilitylinearp3d65",
    ADOBE_RGB: "linadobergbscene linadobergb linearadobergb utilitylinearadobergb",
    XYZ_D65: "linciexyzd65scene",
    ACES_AP0: "linap0scene linap0 aces20651 acesaces20651",
    ACES_AP1: "linap1scene linap1 acescg acesacescg",
}
_SPACES = {name: primaries for primaries, names in _NAMES.items() for name in names.split()}
# Names that do not say which primaries are used
_NO_SPACE = ("", "unknown", "data", "raw", "linear", "scenelinear")
# Bradford's matrix from CIE XYZ to cone responses, for the adaptation of one white to another
_BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
BEYOND = 0.01  # with a larger share of pixels outside Rec. 709, an image is denoised in wider primaries
_SAME = 1e-4  # the tolerance of coordinates: standards give four digits


def to_rec709(attributes: Mapping[str, Any]) -> np.ndarray | None:
    """The matrix (3, 3) that converts colours of a file with these header attributes to linear Rec. 709.

    Returns None if the file is in Rec. 709, if its header names no primaries, or (with a warning) if the primaries make
    no sense. If the whites differ, one is adapted to the other by Bradford's method.
    """
    found = _primaries(attributes)
    if found is None:
        return None
    if found is XYZ_D65:
        return np.linalg.inv(_to_xyz(np.array(REC709)))
    try:
        values = np.asarray(found, np.float64).ravel()
        if values.shape != (8,) or not np.isfinite(values).all():
            raise ValueError("these are not eight numbers")
        if np.abs(values - REC709).max() <= _SAME:
            return None
        return _conversion(values)
    except (ValueError, TypeError, np.linalg.LinAlgError) as error:
        _LOG.warning("chromaticities %s are ignored: %s", found, error)
        return None


def _primaries(attributes: Mapping[str, Any]) -> Any:
    """x, y of the primaries and white in a header, not yet checked; None if it has none."""
    if attributes.get("acesImageContainerFlag") == 1:
        return ACES_AP0
    for name in ("colorInteropID", "chromaticities", "oiio:ColorSpace"):
        value = attributes.get(name)
        if name == "chromaticities" and value is not None:
            return value
        plain = re.sub("[^a-z0-9]", "", str(value or "").lower())
        if plain in _SPACES:
            return _SPACES[plain]
        if plain not in _NO_SPACE:
            _LOG.warning("%s '%s' is ignored: ngpt knows no linear space of that name", name, value)
    return None


def inside_rec709(stack: GradientStack) -> np.ndarray | None:
    """``to_rec709`` of a stack if nearly all of its light is within Rec. 709, else None.

    Light outside Rec. 709 would get negative components, which cost OIDN more accuracy than other primaries do
    (docs/use/pictures.md).
    """
    matrix = to_rec709(stack.attributes)
    if matrix is None:
        return None
    inside = np.where((stack["primal"] >= 0).all(axis=-1, keepdims=True), converted(stack["primal"], matrix), 0)
    return matrix if negative_share(inside) <= BEYOND else None


def negative_share(image: np.ndarray) -> float:
    """The share of pixels (H, W, 3) that have a negative component."""
    return float((image < 0).any(axis=-1).mean())


def converted(image: np.ndarray, matrix: np.ndarray | None) -> np.ndarray:
    """Multiplies the colours of an image (H, W, 3) by a matrix, if there is one. Non-finite pixels affect no others."""
    if matrix is None:
        return image
    with np.errstate(over="ignore", invalid="ignore"):
        return np.ascontiguousarray(np.einsum("...c,dc->...d", image, matrix.astype(image.dtype)))


def _conversion(chromaticities: np.ndarray) -> np.ndarray:
    """The matrix (3, 3) from these primaries and white to Rec. 709. Raises ValueError if they make no sense."""
    theirs, ours = _to_xyz(chromaticities), _to_xyz(np.array(REC709))
    white, aim = (_BRADFORD @ matrix.sum(axis=1) for matrix in (theirs, ours))
    if (white <= 0).any():
        raise ValueError("their white is none")
    adapted = np.linalg.solve(_BRADFORD, np.diag(aim / white) @ _BRADFORD)
    matrix = np.linalg.solve(ours, adapted @ theirs)
    if not np.linalg.cond(matrix) < 1e4:
        raise ValueError("they are next to each other")
    return matrix


def _to_xyz(chromaticities: np.ndarray) -> np.ndarray:
    """The matrix (3, 3) to CIE XYZ. Its columns are red, green and blue, scaled so that white has Y = 1."""
    x, y = chromaticities.reshape(4, 2).T
    if (np.abs(y[3]) < 1e-6) or abs(np.linalg.det(np.stack([x, y, 1 - x - y])[:, :3])) < 1e-6:
        raise ValueError("they span no colours")
    columns = np.stack([x, y, 1 - x - y])
    return columns[:, :3] * np.linalg.solve(columns[:, :3], columns[:, 3] / y[3])


# The matrix from Rec. 709 to ACES AP0, in which no visible colour has negative components
TO_WIDE = np.linalg.inv(_conversion(np.array(ACES_AP0)))
