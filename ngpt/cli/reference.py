"""``ngpt denoise --ref``: the error of a result, in the pixels that both the result and the reference have."""

from typing import Any, NamedTuple

import numpy as np

from ngpt.io.exr import read_picture
from ngpt.io.primaries import converted, to_rec709
from ngpt.io.reduced import smaller
from ngpt.measure.metrics import compare
from ngpt.stack import GradientStack
from ngpt.windows import Place, overlap


class ReferenceImage(NamedTuple):
    """A reference image, (H, W, 3) in linear Rec. 709, its file, and its place in the picture."""

    path: str
    pixels: np.ndarray
    place: Place

    @classmethod
    def read(cls, path: str, isolated: bool) -> "ReferenceImage":
        return cls(path, *read_picture(path, isolated))

    def errors(self, image: np.ndarray, stack: GradientStack, reduce: int = 1) -> dict[str, Any]:
        """The metrics of the result ``image`` (H, W, 3) of ``stack``, after ``reduce`` x ``reduce`` pixels become one.

        The entry "compared" names the compared pixels, unless these are all pixels of both images. Raises NgptError if
        the two images have no pixel in common.
        """
        image, place = smaller(image, stack.place, reduce)
        both = overlap([stack.path, self.path], [place, self.place])
        light = converted(image, to_rec709(stack.attributes))
        metrics = {"metrics": compare(*both.of([light, self.pixels]))}
        return metrics | ({"compared": str(both.common)} if both.line else {})
