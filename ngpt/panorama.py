"""Continues panoramas of 360 degrees on both sides for methods, because their left and right borders are neighbours.

The header of a panorama has OpenEXR's ``envmap`` for latitude and longitude, or ``ngpt:wrap``.
"""

from dataclasses import replace

import numpy as np

from ngpt.stack import GradientStack
from ngpt.subpixels import subpixels

WRAP = "ngpt:wrap"  # header attribute: 1 if the image is a panorama
# Columns that are added on each side. OIDN reads pixels up to this distance, and classical methods hardly beyond it.
MARGIN = 96


def wraps(stack: GradientStack) -> bool:
    """Whether the stack is a panorama, complete from left to right, so that its first column follows its last."""
    kind = stack.attributes.get("envmap", "")
    whole = (stack.place.data.left, stack.width) == (stack.place.display.left, stack.place.display.width)
    return whole and (stack.attributes.get(WRAP) == 1 or getattr(kind, "name", kind) == "ENVMAP_LATLONG")


def wrapping(stack: GradientStack) -> GradientStack:
    """The stack, marked as a panorama."""
    return replace(stack, attributes=stack.attributes | {WRAP: 1})


def continued(stack: GradientStack) -> GradientStack:
    """Returns a panorama (H, W) as a plain stack (H, W + 2 MARGIN), where each border is continued by the other side.

    Differences between the last column and the first are not known, and become NaN.
    """
    columns = np.arange(-MARGIN, stack.width + MARGIN) % stack.width
    layers = {name: stack[name][:, columns] for name in stack.names}
    if "dx" in stack:
        layers["dx"][:, columns == stack.width - 1] = np.nan
    attributes = {name: value for name, value in stack.attributes.items() if name not in ("envmap", WRAP)}
    k = subpixels(stack.fine, stack.width)
    wide = (k * columns[:, None] + np.arange(k)).ravel()
    fine = {name: np.ascontiguousarray(layer[:, wide]) for name, layer in stack.fine.items()}
    return GradientStack(layers, attributes, stack.source, stack.path, fine=fine)


def middle(image: np.ndarray) -> np.ndarray:
    """The image (H, W, C) without the columns that ``continued`` added."""
    return image[:, MARGIN:-MARGIN]
