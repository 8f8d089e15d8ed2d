"""The method wcv of ``ngpt.classical.controlvariates`` as a graph.

The channels are the right, lower, left and upper neighbour of a pixel.
"""

import numpy as np

from ngpt.classical.controlvariates import schedule
from ngpt.classical.variances import FLOOR, SHARED
from ngpt.export.builder import Value, channels, op, repeat
from ngpt.export.graphs import variances

IMAGE = ("tiles", 3, "height", "width")
# A variance so large that its weight is 0.
_NEVER = 3e38


def wcv(
    primal: Value, dx: Value, dy: Value, trusted: tuple[Value, Value], variance: tuple[Value, ...], mean: Value
) -> Value:
    """The base (N, 3, H, W), computed from finite layers.

    ``trusted``   (N, 1, H, W) for dx and dy, true where they can be trusted
    ``variance``  of primal, dx and dy, as the renderer writes them
    ``mean``      a scalar, the mean variance of the whole image, by which variances are divided
    """
    smooth, inside = variances.smoothed(primal, *variance)
    noisy = op.Greater(mean, 0.0)
    relative = op.Where(noisy, smooth / op.Where(noisy, mean, 1.0) + FLOOR, 1.0)
    v = channels(relative, 0, 1) / SHARED
    vx, vy = (
        op.Where(op.And(op.Greater(channels(inside, i, i + 1), 0.0), known), channels(relative, i, i + 1), _NEVER)
        for i, known in ((1, trusted[0]), (2, trusted[1]))
    )
    V = op.Concat(vx, vy, _before(vx, 3, _NEVER), _before(vy, 2, _NEVER), axis=1)
    G = op.Concat(dx, dy, -_before(dx, 3, 0.0), -_before(dy, 2, 0.0), axis=1)
    R = G - _slopes(primal)
    factors, steps = np.array(schedule(), np.float32).T.copy()

    def sweep(n: Value, u: Value) -> tuple[Value, bool]:
        own = v * op.Gather(factors, n, axis=0)
        A = own / (own + V)
        E = _slopes(u) - R
        said = op.Reshape(A, [0, 4, 1, -1]) * op.Reshape(E, [0, 4, 3, -1])
        change = op.Reshape(op.ReduceSum(said, [1], keepdims=0), op.Shape(primal))
        step = op.Gather(steps, n, axis=0)
        return u + change * (step / (op.ReduceSum(A, [1], keepdims=1) + 1.0)), True

    return primal + repeat(len(factors), sweep, primal * 0.0, IMAGE)


def _before(x: Value, axis: int, border: float) -> Value:
    """The value of the left (upper) neighbour; ``border`` where there is none."""
    return op.Pad(op.Slice(x, [0], [-1], [axis]), [1, 0], border, [axis])


def _slopes(image: Value) -> Value:
    """(N, 12, H, W): the right, lower, left and upper neighbour minus the pixel, RGB each."""
    weights = np.zeros((12, 3, 3, 3), np.float32)
    for direction, (y, x) in enumerate(((1, 2), (2, 1), (1, 0), (0, 1))):
        for colour in range(3):
            kernel = weights[3 * direction + colour, colour]
            kernel[1, 1], kernel[y, x] = -1, 1
    return op.Conv(image, weights, pads=[1, 1, 1, 1])
