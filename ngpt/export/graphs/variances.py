"""``ngpt.classical.variances`` as a graph. The channels are primal, dx and dy."""

from ngpt.classical.leastsquares import CLIP
from ngpt.classical.variances import FEW, TYPICAL
from ngpt.export.builder import FLOAT, Value, channels, op, repeat
from ngpt.export.graphs.repair import finite


def smoothed(primal: Value, primal_var: Value, dx_var: Value, dy_var: Value) -> tuple[Value, Value]:
    """Variances (N, 3, H, W), averaged twice over 3x3 values; and the result of ``inside``.

    Only known values are averaged. Where none is known nearby, the result is the mean of all known values of the image.
    For differences, the average is the fourth power of the mean of fourth roots, times ``TYPICAL``; a variance that is
    larger than this average does not change.
    """
    there = inside(primal)
    (vp, gp), (vx, gx), (vy, gy) = (_over_colours(layer) for layer in (primal_var, dx_var, dy_var))
    known = op.Concat(gp, gx, gy, axis=1) * there
    values = op.Concat(vp, vx, vy, axis=1) * known
    sums, counts = (op.ReduceSum(_rows(x), [2], keepdims=1) for x in (values, known))
    typical = sums / op.Max(counts, 1.0)
    averaged = op.Concat(channels(values, 0, 1), op.Sqrt(op.Sqrt(channels(values, 1, 3))), axis=1)
    # Differences have no last column or row, which must not contribute to the second mean.
    v, n = (_box(_box(x) * there) for x in (averaged, known))
    mean = v / op.Max(n, FEW)
    roots = channels(mean, 1, 3)
    robust = op.Max(op.Mul(roots * roots, roots * roots) * float(TYPICAL), channels(values, 1, 3))
    # A count is 0 or at least 1/81 (a ninth of a ninth), apart from rounding.
    return op.Where(op.Greater(n, 1e-3), op.Concat(channels(mean, 0, 1), robust, axis=1), typical), there


def inside(primal: Value) -> Value:
    """(N, 3, H, W): 1 where there is a pixel, a difference to the right, and a difference downwards; else 0."""
    there = channels(primal, 0, 1) * 0.0 + 1.0
    right, below = (op.Pad(op.Slice(there, [0], [-1], [axis]), [0, 1], 0.0, [axis]) for axis in (3, 2))
    return op.Concat(there, right, below, axis=1)


def robust_mean(values: Value, there: Value) -> Value:
    """``ngpt.classical.leastsquares.robust_mean`` of the values where ``there`` is 1 (else 0), a scalar."""
    count, used = op.ReduceSum(_rows(there), keepdims=0), values * there

    def clipped(_: Value, last: Value) -> tuple[Value, Value]:
        mean = op.ReduceSum(_rows(op.Min(used, last * float(CLIP))), keepdims=0) / count
        return mean, op.Less(mean, last * 0.5)

    # In place of infinity, a number that is still finite when it is multiplied by CLIP.
    return repeat(64, clipped, count * 0.0 + 3e36, ())


def _rows(x: Value) -> Value:
    """Sums of rows, as a first step to the sum of an image.

    The runtime in WebAssembly adds one number after another in 32 bits. Without sums of rows, it lost 0.2 % of the sum
    of 640x360 numbers, and more in larger images.
    """
    return op.ReduceSum(x, [3], keepdims=1)


def _over_colours(variance: Value) -> tuple[Value, Value]:
    """Sums over RGB, and 1 where all three values are known (finite and not negative), else 0."""
    usable = op.And(finite(variance), op.GreaterOrEqual(variance, 0.0))
    good = op.ReduceMin(op.Cast(usable, to=FLOAT), [1], keepdims=1)
    return op.ReduceSum(op.Where(usable, variance, 0.0), [1], keepdims=1) * good, good


def _box(x: Value) -> Value:
    """Means over 3x3 values, with 0 beyond the border."""
    return op.AveragePool(x, kernel_shape=[3, 3], pads=[1, 1, 1, 1], count_include_pad=1)
