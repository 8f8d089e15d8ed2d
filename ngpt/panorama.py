"""Images of 360 degrees: their left and right borders are adjacent, so methods get images that continue on both sides.

The header marks such an image by OpenEXR's ``envmap`` for latitude and longitude, or by our ``ngpt:wrap``.
"""

import numpy as np

from ngpt.stack import GradientStack
from ngpt.subpixels import subpixels

WRAP = "ngpt:wrap"  # a header attribute, 1: the image wraps
# Columns that are added on each side. OIDN reads pixels up to this distance, and classical methods hardly farther ones.
MARGIN = 96


def wraps(stack: GradientStack) -> bool:
    """Whether the first column continues the last one, as in a panorama that is whole from left to right."""
    said = stack.attributes.get("envmap", "")
    whole = (stack.place.data.left, stack.width) == (stack.place.display.left, stack.place.display.width)
    return whole and (stack.attributes.get(WRAP) == 1 or getattr(said, "name", said) == "ENVMAP_LATLONG")


def wrapping(stack: GradientStack) -> GradientStack:
    """The stack with the mark of an image that wraps, whatever its header says."""
    return GradientStack(stack.layers, stack.attributes | {WRAP: 1}, stack.source, stack.path, stack.place, stack.fine)


def continued(stack: GradientStack) -> GradientStack:
    """The stack (H, W) as one that does not wrap, (H, W + 2 MARGIN), with the image's other side beside each border.

    Differences between the last column and the first are not known, and count as lost.
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
