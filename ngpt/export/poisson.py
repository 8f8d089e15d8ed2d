"""The least-squares screened Poisson reconstruction (``ngpt.classical.poisson.l2``) as one ONNX graph.

The cosine transforms are matrix products. The graph makes the matrices from the size of its input, so one file serves
every size. They cost O(H W (H + W)) in place of the O(H W log(H W)) of a fast transform. But matrix products run near
the peak speed of a machine: up to 1920x1080, both ways take the same time on two CPU cores (docs/lab/log).
"""

import math

import onnx

from ngpt.classical.poisson import DEFAULT_ALPHA
from ngpt.errors import WrongUse
from ngpt.export.builder import END, FLOAT, Graph, Value, op
from ngpt.version import __version__

_IMAGE = (1, 3, "height", "width")


def l2_model(alpha: float = DEFAULT_ALPHA) -> onnx.ModelProto:
    """The graph for one ``alpha`` > 0.

    The inputs ``primal``, ``dx`` and ``dy`` are layers of a gradient stack without direct emission: (1, 3, height,
    width) float32, scene-linear RGB, rows from the top, with finite values. The output ``image`` has the same shape and
    units. Metadata: ``ngpt.version``, ``ngpt.method``, ``ngpt.alpha``, ``ngpt.gradient``.
    """
    if not 0 < alpha < float("inf"):
        raise WrongUse(f"alpha {alpha}: must be a positive number; the default is {DEFAULT_ALPHA}")
    graph = Graph("l2")
    primal, dx, dy = (graph.input(name, _IMAGE) for name in ("primal", "dx", "dy"))
    graph.output("image", primal + _correction(primal, dx, dy, alpha), _IMAGE)
    return graph.model({"version": __version__, "method": "l2", "alpha": str(alpha), "gradient": "forward"})


def _correction(primal: Value, dx: Value, dy: Value, alpha: float) -> Value:
    """u = I - P, which solves (α² + ∂ᵀ∂) u = ∂ᵀ(G - ∂P), as in ``ngpt.classical.poisson``."""
    right_hand_side = _divergence(primal, dx, 3) + _divergence(primal, dy, 2)
    basis_y, eigenvalues_y = _basis(op.Shape(primal, start=2, end=3))
    basis_x, eigenvalues_x = _basis(op.Shape(primal, start=3, end=4))
    coefficients = op.MatMul(op.MatMul(basis_y, right_hand_side), op.Transpose(basis_x, perm=[1, 0]))
    eigenvalues = op.Unsqueeze(eigenvalues_y, [1]) + op.Unsqueeze(eigenvalues_x, [0])
    solution = coefficients / (eigenvalues + alpha**2)
    # The mean of a divergence is 0. Its rounding error would be divided by alpha squared, which may be small.
    solution = op.Where(op.LessOrEqual(eigenvalues, 0.0), 0.0, solution)
    return op.MatMul(op.MatMul(op.Transpose(basis_y, perm=[1, 0]), solution), basis_x)


def _divergence(primal: Value, gradient: Value, axis: int) -> Value:
    """∂ᵀ(G - ∂P) along one axis. The last column of dx and the last row of dy hold no difference."""
    slope = op.Slice(primal, [1], [END], [axis]) - op.Slice(primal, [0], [-1], [axis])
    residual = op.Slice(gradient, [0], [-1], [axis]) - slope
    return op.Pad(residual, [1, 0], None, [axis]) - op.Pad(residual, [0, 1], None, [axis])


def _basis(size: Value) -> tuple[Value, Value]:
    """The orthonormal DCT-II of n points, (n, n), and the eigenvalues (n) of ∂ᵀ∂ under Neumann boundaries."""
    count = op.Squeeze(size)
    k, n = op.Cast(op.Range(0, count, 1), to=FLOAT), op.Cast(count, to=FLOAT)
    frequency, place = op.Unsqueeze(k, [1]), op.Unsqueeze(k + 0.5, [0])
    # Products of integers and halves are exact. Whole turns are removed before the division, which would round.
    turn = n * 2.0
    angle = op.Mod(frequency * place, turn, fmod=1) / n * math.pi
    norm = op.Sqrt(op.Where(op.LessOrEqual(frequency, 0.0), 1.0, 2.0) / n)
    # 2 - 2 cos(pi k / n) = 4 sin²(pi k / 2n), which has no cancellation for small k.
    sine = op.Sin(k / turn * math.pi)
    return norm * op.Cos(angle), sine * sine * 4.0
