"""``ngpt denoise --ref``: the error of a result, in the pixels that both it and the reference have."""

from typing import Any, NamedTuple

import numpy as np

from ngpt.io.exr import read_picture
from ngpt.io.primaries import converted, to_rec709
from ngpt.measure.metrics import compare
from ngpt.stack import GradientStack
from ngpt.windows import Place, overlap


class Reference(NamedTuple):
    """A reference image, (H, W, 3) in linear Rec. 709, its file, and where it lies."""

    path: str
    pixels: np.ndarray
    place: Place

    @classmethod
    def read(cls, path: str, isolated: bool) -> "Reference":
        return cls(path, *read_picture(path, isolated))

    def errors(self, image: np.ndarray, stack: GradientStack) -> dict[str, Any]:
        """The metrics of an image (H, W, 3) made from ``stack``, and which pixels were compared, unless it was all
        pixels of both.

        Raises NgptError if the two images have no pixel in common.
        """
        both = overlap([stack.path, self.path], [stack.place, self.place])
        light = converted(image, to_rec709(stack.attributes))
        metrics = {"metrics": compare(*both.of([light, self.pixels]))}
        return metrics | ({"compared": str(both.common)} if both.line else {})
