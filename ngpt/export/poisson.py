"""The least-squares screened Poisson reconstruction (``ngpt.classical.poisson.l2``) as one ONNX graph.

The cosine transforms are matrix products with matrices made inside the graph from the size of its input, so one file
serves every size. That costs O(H W (H + W)) instead of the O(H W log(H W)) of a fast transform, but matrix products run
so near the peak of a machine that up to 1920x1080 the two are equally fast on two CPU cores (docs/LOG.md).
"""

from string import Template

import onnx

from ngpt.classical.poisson import DEFAULT_ALPHA
from ngpt.errors import NgptError
from ngpt.export.text import finish, parse
from ngpt.version import __version__

# Steps and names as in ngpt.classical.poisson: the correction u = I - P solves (α² + ∂ᵀ∂) u = ∂ᵀ(G - ∂P). `Basis` is
# the orthonormal DCT-II of n points, (n, n), and `eigenvalues` are of the one-dimensional ∂ᵀ∂ under Neumann boundaries.
_GRAPH = Template("""
l2 (float[1,3,height,width] primal, float[1,3,height,width] dx, float[1,3,height,width] dy)
    => (float[1,3,height,width] image)
{
    rows = Constant <value_int: int = 2> ()
    columns = Constant <value_int: int = 3> ()
    right_hand_x = ngpt.Divergence (primal, dx, columns)
    right_hand_y = ngpt.Divergence (primal, dy, rows)
    right_hand_side = Add (right_hand_x, right_hand_y)

    height = Shape <start: int = 2, end: int = 3> (primal)
    width = Shape <start: int = 3, end: int = 4> (primal)
    basis_y, eigenvalues_y = ngpt.Basis (height)
    basis_x, eigenvalues_x = ngpt.Basis (width)
    basis_y_transposed = Transpose <perm: ints = [1, 0]> (basis_y)
    basis_x_transposed = Transpose <perm: ints = [1, 0]> (basis_x)

    half = MatMul (basis_y, right_hand_side)
    coefficients = MatMul (half, basis_x_transposed)
    last_axis = Constant <value_ints: ints = [1]> ()
    first_axis = Constant <value_ints: ints = [0]> ()
    eigenvalues_as_column = Unsqueeze (eigenvalues_y, last_axis)
    eigenvalues_as_row = Unsqueeze (eigenvalues_x, first_axis)
    eigenvalues = Add (eigenvalues_as_column, eigenvalues_as_row)
    alpha_squared = Constant <value_float: float = $alpha_squared> ()
    divisor = Add (eigenvalues, alpha_squared)
    solution = Div (coefficients, divisor)
    # A divergence has no mean; what rounding leaves of it would be divided by no more than alpha squared.
    zero = Constant <value_float: float = 0.0> ()
    is_mean = LessOrEqual (eigenvalues, zero)
    solution_without_mean = Where (is_mean, zero, solution)
    half_back = MatMul (basis_y_transposed, solution_without_mean)
    correction = MatMul (half_back, basis_x)
    image = Add (primal, correction)
}

<domain: "ngpt", opset_import: ["": 18]>
Divergence (primal, gradient, axis) => (divergence)
{
    zero = Constant <value_ints: ints = [0]> ()
    one = Constant <value_ints: ints = [1]> ()
    minus_one = Constant <value_ints: ints = [-1]> ()
    all = Constant <value_ints: ints = [9223372036854775807]> ()
    axes = Reshape (axis, one)
    ahead = Slice (primal, one, all, axes)
    behind = Slice (primal, zero, minus_one, axes)
    slope = Sub (ahead, behind)
    # The last column of dx and the last row of dy stand for no difference.
    wanted = Slice (gradient, zero, minus_one, axes)
    residual = Sub (wanted, slope)
    before = Constant <value_ints: ints = [1, 0]> ()
    after = Constant <value_ints: ints = [0, 1]> ()
    at_end = Pad (residual, before, , axes)
    at_start = Pad (residual, after, , axes)
    divergence = Sub (at_end, at_start)
}

<domain: "ngpt", opset_import: ["": 18]>
Basis (size) => (basis, eigenvalues)
{
    count = Squeeze (size)
    zero = Constant <value_int: int = 0> ()
    one = Constant <value_int: int = 1> ()
    integers = Range (zero, count, one)
    k = Cast <to: int = 1> (integers)
    n = Cast <to: int = 1> (count)
    pi = Constant <value_float: float = 3.14159265358979> ()
    two = Constant <value_float: float = 2.0> ()
    zero_float = Constant <value_float: float = 0.0> ()
    half = Constant <value_float: float = 0.5> ()
    position = Add (k, half)
    last_axis = Constant <value_ints: ints = [1]> ()
    first_axis = Constant <value_ints: ints = [0]> ()
    frequency = Unsqueeze (k, last_axis)
    place = Unsqueeze (position, first_axis)
    # Products of integers and halves are exact; reduced by whole turns before the division, large images keep digits.
    product = Mul (frequency, place)
    turn = Mul (two, n)
    reduced = Mod <fmod: int = 1> (product, turn)
    turns = Div (reduced, n)
    angle = Mul (pi, turns)
    wave = Cos (angle)
    is_first = LessOrEqual (frequency, zero_float)
    one_float = Constant <value_float: float = 1.0> ()
    weight = Where (is_first, one_float, two)
    square = Div (weight, n)
    norm = Sqrt (square)
    basis = Mul (norm, wave)
    # 2 - 2 cos(pi k / n) as 4 sin²(pi k / 2n), which does not cancel for small k.
    share = Div (k, turn)
    half_angle = Mul (pi, share)
    sine = Sin (half_angle)
    sine_squared = Mul (sine, sine)
    four = Constant <value_float: float = 4.0> ()
    eigenvalues = Mul (four, sine_squared)
}
""")


def l2_model(alpha: float = DEFAULT_ALPHA) -> onnx.ModelProto:
    """The graph for one ``alpha`` > 0.

    Inputs ``primal``, ``dx``, ``dy``: (1, 3, height, width) float32, scene-linear RGB, rows from the top, as the layers
    of a gradient stack, ``primal`` without direct emission. Output ``image``: the same shape and units. All values must
    be finite. Metadata: ``ngpt.version``, ``ngpt.method``, ``ngpt.alpha``, ``ngpt.gradient``.
    """
    if not 0 < alpha < float("inf"):
        raise NgptError(f"alpha {alpha}: must be a positive number; the default is {DEFAULT_ALPHA}")
    model = parse(_GRAPH.substitute(alpha_squared=f"{alpha**2:.9e}"))
    return finish(model, {"version": __version__, "method": "l2", "alpha": str(alpha), "gradient": "forward"})
