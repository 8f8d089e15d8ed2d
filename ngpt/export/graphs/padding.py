"""``ngpt.network.padding`` as a graph: reflected borders, with the right signs for gradients."""

from dataclasses import dataclass

from ngpt.export.builder import END, FLOAT, Value, op
from ngpt.network.padding import MARGIN


@dataclass
class PaddedAxis:
    """An axis of a padded image: for each position, its pixel, and its difference to the next position.

    ``axis``     the axis in (N, C, H, W)
    ``size``     the number of pixels along the axis, a scalar
    ``here``     the index of the pixel that is copied to each position
    ``nearest``  the index of the difference between each position and the next
    ``step``     the sign of this difference: 1, -1, or 0 where the image is one pixel wide
    """

    axis: int
    size: Value
    here: Value
    nearest: Value
    step: Value

    def borders(self, values: Value, more: int) -> tuple[Value, Value]:
        """The entries of ``values`` before the image; and those for its last ``more`` pixels and after the image."""
        last = op.Reshape(self.size + (MARGIN - more), [1])
        return op.Slice(values, [0], [MARGIN], [0]), op.Slice(values, last, [END], [0])


class Mirror:
    """Pads images of the size of ``image`` to multiples of ``alignment``."""

    def __init__(self, image: Value, alignment: int):
        self.rows, self.columns = (
            _side(axis, op.Squeeze(op.Shape(image, start=axis, end=axis + 1)), alignment) for axis in (2, 3)
        )

    def pad(self, layer: Value, name: str = "") -> Value:
        """A padded layer. Its name determines whether it holds differences, and whether these have a sign."""
        signed = not name.endswith(("_se", "_noise"))
        for side, along in ((self.rows, "dy"), (self.columns, "dx")):
            layer = _differences(layer, side, signed) if name.startswith(along) else _pixels(layer, side)
        return layer

    def crop(self, image: Value) -> Value:
        """A padded image without its padding."""
        sizes = op.Concat(op.Reshape(self.rows.size, [1]), op.Reshape(self.columns.size, [1]), axis=0)
        return op.Slice(image, [MARGIN] * 2, sizes + [MARGIN] * 2, [2, 3])

    def extended(self, layer: Value, radius: int, name: str = "") -> Value:
        """A layer padded, with ``radius`` more pixels on every side, see ``ngpt.network.padding.extended``."""
        padded = self.pad(layer, name)
        return op.Pad(padded, [radius] * 4, None, [2, 3], mode="edge") if radius else padded


def _pixels(layer: Value, side: PaddedAxis) -> Value:
    """The layer, padded along one axis. Its own pixels are copied as a block, which is faster than gathering them."""
    before, after = (op.Gather(layer, places, axis=side.axis) for places in side.borders(side.here, 0))
    return op.Concat(before, layer, after, axis=side.axis)


def _differences(layer: Value, side: PaddedAxis, signed: bool) -> Value:
    """``_pixels`` for differences along that axis. The border replaces the last one, which leads out of the image."""
    steps = [
        op.Reshape(step if signed else abs(step), [-1, 1] if side.axis == 2 else [-1])
        for step in side.borders(side.step, 1)
    ]
    before, after = (
        op.Gather(layer, places, axis=side.axis) * step
        for places, step in zip(side.borders(side.nearest, 1), steps, strict=True)
    )
    return op.Concat(before, op.Slice(layer, [0], [-1], [side.axis]), after, axis=side.axis)


def _side(axis: int, size: Value, alignment: int) -> PaddedAxis:
    after = op.Mod(-(size + 2 * MARGIN), alignment) + MARGIN
    # The index of the pixel at each of the positions -MARGIN .. size + after.
    period = op.Max((size - 1) * 2, 1)
    wave = op.Mod(op.Range(-MARGIN, size + after + 1, 1), period)
    pixels = op.Where(op.Less(wave, size), wave, period - wave)
    here, there = op.Slice(pixels, [0], [-1], [0]), op.Slice(pixels, [1], [END], [0])
    return PaddedAxis(axis, size, here, op.Min(here, there), op.Cast(there - here, to=FLOAT))
