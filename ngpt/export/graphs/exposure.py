"""``ngpt.network.exposure`` as a graph: the statistics of an image that all of its tiles share."""

from collections.abc import Mapping

from ngpt.export.builder import INT64, Value, channels, op
from ngpt.export.graphs import variances
from ngpt.network.exposure import BLOCK, KEY

# See export/CONTRACT.md.
STATISTICS = ("exposure", "largest depth", "least radiance", "largest radiance", "mean variance")


def statistics(clean: Mapping[str, Value], variance_layers: tuple[Value, ...] | None) -> Value:
    """The (5) values of ``STATISTICS``, from finite layers; 0 for values whose layers are missing.

    ``variance_layers`` are the variances of primal, dx and dy; None for networks whose graph makes no base.
    """
    primal = clean["primal"]
    absent = op.ReduceMin(primal, keepdims=0) * 0.0
    depth = op.ReduceMax(clean["depth"], keepdims=0) if "depth" in clean else absent
    low = op.Min(op.ReduceMin(primal, keepdims=0), 0.0)
    high = op.Max(op.ReduceMax(primal, keepdims=0), 0.0)
    mean = absent if variance_layers is None else variances.robust_mean(*variances.smoothed(primal, *variance_layers))
    numbers = (exposure(primal), depth, low, high, mean)
    return op.Concat(*(op.Reshape(number, [1]) for number in numbers), axis=0)


def exposure(primal: Value) -> Value:
    """The typical radiance divided by ``KEY``, a scalar; 1 for black images (``ngpt.network.features.exposure``)."""
    brightness = op.ReduceMean(op.Max(primal, 0.0), [1], keepdims=1)
    # Blocks at the border hold fewer pixels, so sums are divided by their number.
    here = brightness * 0.0 + 1.0
    missing = op.Mod(-op.Shape(primal, start=2, end=4), [BLOCK, BLOCK])
    padded = op.Pad(op.Concat(brightness, here, axis=1), op.Concat([0, 0], missing, axis=0), 0.0, [2, 3])
    means = op.AveragePool(padded, kernel_shape=[BLOCK, BLOCK], strides=[BLOCK, BLOCK])
    values = op.Reshape(channels(means, 0, 1) / channels(means, 1, 2), [-1])
    count = op.Size(values)
    descending, _ = op.TopK(values, op.Reshape(count, [-1]), outputs=2)
    lit = op.ReduceSum(op.Cast(op.Greater(descending, 0.0), to=INT64), keepdims=0)
    median = op.Gather(descending, op.Min(lit / 2, count - 1), axis=0)
    return op.Where(op.Greater(lit, 0), median / KEY, 1.0)
