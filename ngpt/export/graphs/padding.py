"""After ``ngpt.network.padding``: borders reflected, with the right signs for gradients."""

from dataclasses import dataclass

from ngpt.export.builder import END, FLOAT, Value, op
from ngpt.network.padding import MARGIN


@dataclass
class Side:
    """One side of an image, padded: for each place the pixel that lies there, and its difference to the next.

    ``size``     pixels of the side, a scalar
    ``here``     which pixel lies at each place
    ``nearest``  which difference stands between there and the next place
    ``step``     with which sign: 1, -1, or 0 where the image is one pixel wide
    """

    size: Value
    here: Value
    nearest: Value
    step: Value


class Mirror:
    """The padding of images as large as ``image``, to multiples of ``alignment``."""

    def __init__(self, image: Value, alignment: int):
        self.rows, self.columns = (
            _side(op.Squeeze(op.Shape(image, start=axis, end=axis + 1)), alignment) for axis in (2, 3)
        )

    def pad(self, layer: Value, name: str = "") -> Value:
        """A layer with its borders; its name says whether it holds differences, and whether these have a sign."""
        if not name.startswith(("dx", "dy")):
            return op.Gather(op.Gather(layer, self.rows.here, axis=2), self.columns.here, axis=3)
        signed = not name.endswith(("_se", "_noise"))
        if name.startswith("dx"):
            step = self.columns.step if signed else abs(self.columns.step)
            across = op.Gather(layer, self.columns.nearest, axis=3) * step
            return op.Gather(across, self.rows.here, axis=2)
        step = op.Unsqueeze(self.rows.step, [1])
        down = op.Gather(layer, self.rows.nearest, axis=2) * (step if signed else abs(step))
        return op.Gather(down, self.columns.here, axis=3)

    def crop(self, image: Value) -> Value:
        """What was padded, without the padding."""
        sizes = op.Concat(op.Reshape(self.rows.size, [1]), op.Reshape(self.columns.size, [1]), axis=0)
        return op.Slice(image, [MARGIN] * 2, sizes + [MARGIN] * 2, [2, 3])

    def extended(self, layer: Value, radius: int, name: str = "") -> Value:
        """A layer padded, with ``radius`` more pixels on every side, see ``ngpt.network.padding.extended``."""
        padded = self.pad(layer, name)
        return op.Pad(padded, [radius] * 4, None, [2, 3], mode="edge") if radius else padded


def _side(size: Value, alignment: int) -> Side:
    after = op.Mod(-(size + 2 * MARGIN), alignment) + MARGIN
    # Which pixel lies at -MARGIN, ..., size - 1 + after, and one beyond.
    period = op.Max((size - 1) * 2, 1)
    wave = op.Mod(op.Range(-MARGIN, size + after + 1, 1), period)
    pixels = op.Where(op.Less(wave, size), wave, period - wave)
    here, there = op.Slice(pixels, [0], [-1], [0]), op.Slice(pixels, [1], [END], [0])
    return Side(size, here, op.Min(here, there), op.Cast(there - here, to=FLOAT))
