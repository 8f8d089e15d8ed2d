"""What surrounds a network in its ONNX file: from the renderer's buffers to the network's channels, and back.

    clean -> statistics -> base -> normalised -> padded -> [network] -> cropped -> bounded -> exponential -> exposure

The same steps as in ``ngpt.network`` (features, padding, model) and ``ngpt.classical.controlvariates``, from
which the comments say where they differ; tests hold the two together. All of it is float32.
"""

from string import Template

from ngpt.classical.controlvariates import SWEEPS
from ngpt.classical.variances import FLOOR
from ngpt.network.exposure import KEY
from ngpt.network.features import CHANNELS, IMAGES, RADIANCE, SOURCES, compared
from ngpt.network.model import DARK, HUGE, WINDOW, ModelConfig
from ngpt.network.padding import MARGIN

# The layers a graph may read, in the order of its inputs.
LAYERS = (
    *("primal", "dx", "dy", "albedo", "normal", "depth", "primal_var", "dx_var", "dy_var"),
    *("denoised", "denoised_base"),
)

# What all tiles of an image share, see contract().
STATISTICS = ("exposure", "largest depth", "least radiance", "largest radiance", "mean variance")

FUNCTIONS = f"""
<domain: "ngpt", opset_import: ["": 18]>
Finite (x) => (finite)
{{
    # What is not finite is not 0 less than itself.
    difference = Sub (x, x)
    zero = Constant <value_float: float = 0.0> ()
    finite = Equal (difference, zero)
}}

<domain: "ngpt", opset_import: ["": 18]>
Clean (x) => (clean)
{{
    finite = ngpt.Finite (x)
    zero = Constant <value_float: float = 0.0> ()
    clean = Where (finite, x, zero)
}}

<domain: "ngpt", opset_import: ["": 18]>
Exposure (primal) => (exposure)
{{
    zero = Constant <value_float: float = 0.0> ()
    one = Constant <value_float: float = 1.0> ()
    channel_axis = Constant <value_ints: ints = [1]> ()
    positive = Max (primal, zero)
    brightness = ReduceMean <keepdims: int = 1> (positive, channel_axis)
    # Blocks at the border hold fewer pixels: sums of what is there over how many they are.
    nothing = Mul (brightness, zero)
    here = Add (nothing, one)
    both = Concat <axis: int = 1> (brightness, here)
    size = Shape <start: int = 2, end: int = 4> (primal)
    block = Constant <value_ints: ints = [16, 16]> ()
    less = Neg (size)
    missing = Mod (less, block)
    none = Constant <value_ints: ints = [0, 0]> ()
    pads = Concat <axis: int = 0> (none, missing)
    axes = Constant <value_ints: ints = [2, 3]> ()
    padded = Pad (both, pads, zero, axes)
    means = AveragePool <kernel_shape: ints = [16, 16], strides: ints = [16, 16]> (padded)
    first = Constant <value_ints: ints = [0]> ()
    second = Constant <value_ints: ints = [1]> ()
    end = Constant <value_ints: ints = [2]> ()
    sums = Slice (means, first, second, channel_axis)
    counts = Slice (means, second, end, channel_axis)
    blocks = Div (sums, counts)
    all = Constant <value_ints: ints = [-1]> ()
    values = Reshape (blocks, all)
    count = Size (values)
    count_list = Reshape (count, all)
    sorted, order = TopK <largest: int = 1, sorted: int = 1> (values, count_list)
    is_lit = Greater (sorted, zero)
    lit_integers = Cast <to: int = 7> (is_lit)
    lit = ReduceSum <keepdims: int = 0> (lit_integers)
    two = Constant <value_int: int = 2> ()
    middle = Div (lit, two)
    last_block = Sub (count, two)
    one_integer = Constant <value_int: int = 1> ()
    last = Add (last_block, one_integer)
    index = Min (middle, last)
    median = Gather <axis: int = 0> (sorted, index)
    key = Constant <value_float: float = {KEY}> ()
    level = Div (median, key)
    zero_integer = Constant <value_int: int = 0> ()
    any_lit = Greater (lit, zero_integer)
    exposure = Where (any_lit, level, one)
}}

<domain: "ngpt", opset_import: ["": 18]>
OverColours (variance) => (total, good)
{{
    # Sums over RGB where all three are known; what is not finite or negative is not.
    zero = Constant <value_float: float = 0.0> ()
    finite = ngpt.Finite (variance)
    not_negative = GreaterOrEqual (variance, zero)
    usable = And (finite, not_negative)
    usable_numbers = Cast <to: int = 1> (usable)
    channel_axis = Constant <value_ints: ints = [1]> ()
    good = ReduceMin <keepdims: int = 1> (usable_numbers, channel_axis)
    values = Where (usable, variance, zero)
    sum = ReduceSum <keepdims: int = 1> (values, channel_axis)
    total = Mul (sum, good)
}}

<domain: "ngpt", opset_import: ["": 18]>
Inside (primal) => (inside)
{{
    # (1, 3, height, width): where there is a pixel, a difference to the right, a difference downwards.
    one = Constant <value_float: float = 1.0> ()
    zero = Constant <value_float: float = 0.0> ()
    first = Constant <value_ints: ints = [0]> ()
    second = Constant <value_ints: ints = [1]> ()
    channel_axis = Constant <value_ints: ints = [1]> ()
    channel = Slice (primal, first, second, channel_axis)
    nothing = Mul (channel, zero)
    all = Add (nothing, one)
    begin = Constant <value_ints: ints = [0]> ()
    before_last = Constant <value_ints: ints = [-1]> ()
    column_axis = Constant <value_ints: ints = [3]> ()
    row_axis = Constant <value_ints: ints = [2]> ()
    at_end = Constant <value_ints: ints = [0, 1]> ()
    columns = Slice (all, begin, before_last, column_axis)
    rows = Slice (all, begin, before_last, row_axis)
    right = Pad (columns, at_end, zero, column_axis)
    below = Pad (rows, at_end, zero, row_axis)
    inside = Concat <axis: int = 1> (all, right, below)
}}

<domain: "ngpt", opset_import: ["": 18]>
Smoothed (primal, primal_var, dx_var, dy_var) => (smooth, inside)
{{
    # ngpt.classical.variances: twice the mean over 3x3 values that are known, where there are none the mean of all.
    inside = ngpt.Inside (primal)
    vp, gp = ngpt.OverColours (primal_var)
    vx, gx = ngpt.OverColours (dx_var)
    vy, gy = ngpt.OverColours (dy_var)
    all_values = Concat <axis: int = 1> (vp, vx, vy)
    all_known = Concat <axis: int = 1> (gp, gx, gy)
    known = Mul (all_known, inside)
    values = Mul (all_values, known)
    image_axes = Constant <value_ints: ints = [2, 3]> ()
    sums = ReduceSum <keepdims: int = 1> (values, image_axes)
    counts = ReduceSum <keepdims: int = 1> (known, image_axes)
    one = Constant <value_float: float = 1.0> ()
    at_least_one = Max (counts, one)
    typical = Div (sums, at_least_one)
    v1_wide = AveragePool <kernel_shape: ints = [3, 3], pads: ints = [1, 1, 1, 1], count_include_pad: int = 1> (values)
    # Nothing may pass through the column and the row that do not exist.
    v1 = Mul (v1_wide, inside)
    v2 = AveragePool <kernel_shape: ints = [3, 3], pads: ints = [1, 1, 1, 1], count_include_pad: int = 1> (v1)
    n1_wide = AveragePool <kernel_shape: ints = [3, 3], pads: ints = [1, 1, 1, 1], count_include_pad: int = 1> (known)
    n1 = Mul (n1_wide, inside)
    n2 = AveragePool <kernel_shape: ints = [3, 3], pads: ints = [1, 1, 1, 1], count_include_pad: int = 1> (n1)
    few = Constant <value_float: float = 1e-9> ()
    divisor = Max (n2, few)
    mean = Div (v2, divisor)
    # A count is at least a ninth of a ninth; rounding may leave less.
    least = Constant <value_float: float = 0.001> ()
    any = Greater (n2, least)
    smooth = Where (any, mean, typical)
}}

<domain: "ngpt", opset_import: ["": 18]>
RobustMean (values, inside) => (mean)
{{
    # Until it no longer halves: the mean when no value counts as more than a hundred times the last one.
    zero = Constant <value_float: float = 0.0> ()
    huge = Constant <value_float: float = 3.0e36> ()
    half = Constant <value_float: float = 0.5> ()
    hundred = Constant <value_float: float = 100.0> ()
    there = ReduceSum <keepdims: int = 0> (inside)
    used = Mul (values, inside)
    rounds = Constant <value_int: int = 64> ()
    yes = Constant <value_int: int = 1> ()
    start = Cast <to: int = 9> (yes)
    mean = Loop (rounds, start, huge) <body: graph = step (int64 i, bool go, float last) => (bool again, float clipped)
    {{
        largest = Mul (last, hundred)
        bounded = Min (used, largest)
        sum = ReduceSum <keepdims: int = 0> (bounded)
        clipped = Div (sum, there)
        much_less = Mul (last, half)
        again = Less (clipped, much_less)
    }}>
}}

<domain: "ngpt", opset_import: ["": 18]>
Mirror (size, after) => (pixels)
{{
    # ngpt.network.padding: which pixel lies at -margin, ..., size - 1 + after, and one beyond.
    one = Constant <value_int: int = 1> ()
    two = Constant <value_int: int = 2> ()
    before = Constant <value_int: int = {-MARGIN}> ()
    last = Sub (size, one)
    there_and_back = Mul (last, two)
    period = Max (there_and_back, one)
    inside = Add (size, after)
    end = Add (inside, one)
    places = Range (before, end, one)
    wave = Mod (places, period)
    ahead = Less (wave, size)
    back = Sub (period, wave)
    pixels = Where (ahead, wave, back)
}}

<domain: "ngpt", opset_import: ["": 18]>
Steps (pixels) => (here, nearest, step)
{{
    first = Constant <value_ints: ints = [0]> ()
    second = Constant <value_ints: ints = [1]> ()
    before_last = Constant <value_ints: ints = [-1]> ()
    all = Constant <value_ints: ints = [9223372036854775807]> ()
    here = Slice (pixels, first, before_last, first)
    there = Slice (pixels, second, all, first)
    nearest = Min (here, there)
    difference = Sub (there, here)
    step = Cast <to: int = 1> (difference)
}}

<domain: "ngpt", opset_import: ["": 18]>
SignedLog (x) => (y)
{{
    # As ONNX has no log1p: u = 1 + x, x log(u) / (u - 1), which is exact to rounding [Kahan].
    zero = Constant <value_float: float = 0.0> ()
    one = Constant <value_float: float = 1.0> ()
    size = Abs (x)
    u = Add (one, size)
    excess = Sub (u, one)
    tiny = Equal (excess, zero)
    divisor = Where (tiny, one, excess)
    logarithm = Log (u)
    factor = Div (logarithm, divisor)
    product = Mul (size, factor)
    positive = Where (tiny, size, product)
    sign = Sign (x)
    y = Mul (sign, positive)
}}

<domain: "ngpt", opset_import: ["": 18]>
Encoded (x) => (y)
{{
    # SignedLog for networks, which do not see 6e-8 more or less.
    one = Constant <value_float: float = 1.0> ()
    size = Abs (x)
    more = Add (size, one)
    logarithm = Log (more)
    sign = Sign (x)
    y = Mul (sign, logarithm)
}}

<domain: "ngpt", opset_import: ["": 18]>
SignedExp (y) => (x)
{{
    # As ONNX has no expm1: u = exp y, (u - 1) y / log(u) [Kahan].
    zero = Constant <value_float: float = 0.0> ()
    one = Constant <value_float: float = 1.0> ()
    size = Abs (y)
    u = Exp (size)
    excess = Sub (u, one)
    logarithm = Log (u)
    tiny = Equal (logarithm, zero)
    divisor = Where (tiny, one, logarithm)
    ratio = Div (size, divisor)
    product = Mul (excess, ratio)
    positive = Where (tiny, size, product)
    sign = Sign (y)
    x = Mul (sign, positive)
}}
"""


def neighbours() -> str:
    """Weights (12, 3, 3, 3) of a convolution: what the pixels right, below, left and above are more than a pixel."""
    weights = []
    for y, x in ((1, 2), (2, 1), (1, 0), (0, 1)):
        for output in range(3):
            kernels = [[0] * 9 for _ in range(3)]
            kernels[output][4], kernels[output][3 * y + x] = -1, 1
            weights += [str(float(value)) for kernel in kernels for value in kernel]
    return f"float[12,3,3,3] {{{', '.join(weights)}}}"


CONTROL_VARIATES = f"""
<domain: "ngpt", opset_import: ["": 18]>
ControlVariates (primal, dx, dy, known_x, known_y, primal_var, dx_var, dy_var, mean_variance) => (base)
{{
    # ngpt.classical.controlvariates.wcv. Channels of V, A, E and R: right, below, left, above.
    smooth, inside = ngpt.Smoothed (primal, primal_var, dx_var, dy_var)
    zero = Constant <value_float: float = 0.0> ()
    one = Constant <value_float: float = 1.0> ()
    noisy = Greater (mean_variance, zero)
    divisor = Where (noisy, mean_variance, one)
    ratio = Div (smooth, divisor)
    floor = Constant <value_float: float = {FLOOR}> ()
    raised = Add (ratio, floor)
    relative = Where (noisy, raised, one)
    i0 = Constant <value_ints: ints = [0]> ()
    i1 = Constant <value_ints: ints = [1]> ()
    i2 = Constant <value_ints: ints = [2]> ()
    i3 = Constant <value_ints: ints = [3]> ()
    minus_one = Constant <value_ints: ints = [-1]> ()
    v = Slice (relative, i0, i1, i1)
    vx_all = Slice (relative, i1, i2, i1)
    vy_all = Slice (relative, i2, i3, i1)
    inside_x = Slice (inside, i1, i2, i1)
    inside_y = Slice (inside, i2, i3, i1)
    trusted_x = Mul (inside_x, known_x)
    trusted_y = Mul (inside_y, known_y)
    is_x = Greater (trusted_x, zero)
    is_y = Greater (trusted_y, zero)
    # A variance so large that its weight is 0.
    never = Constant <value_float: float = 3.0e38> ()
    vx = Where (is_x, vx_all, never)
    vy = Where (is_y, vy_all, never)
    before = Constant <value_ints: ints = [1, 0]> ()
    vx_cut = Slice (vx, i0, minus_one, i3)
    vy_cut = Slice (vy, i0, minus_one, i2)
    vl = Pad (vx_cut, before, never, i3)
    va = Pad (vy_cut, before, never, i2)
    V = Concat <axis: int = 1> (vx, vy, vl, va)
    dx_cut = Slice (dx, i0, minus_one, i3)
    dy_cut = Slice (dy, i0, minus_one, i2)
    dl = Pad (dx_cut, before, zero, i3)
    da = Pad (dy_cut, before, zero, i2)
    minus_dl = Neg (dl)
    minus_da = Neg (da)
    G = Concat <axis: int = 1> (dx, dy, minus_dl, minus_da)
    D = Constant <value: tensor = {neighbours()}> ()
    slopes = Conv <pads: ints = [1, 1, 1, 1]> (primal, D)
    R = Sub (G, slopes)
    image_shape = Shape (primal)
    by_direction = Constant <value_ints: ints = [0, 4, 3, -1]> ()
    one_channel = Constant <value_ints: ints = [0, 4, 1, -1]> ()
    u0 = Mul (primal, zero)
    quarter = Constant <value_float: float = 1.01> ()
    four = Constant <value_float: float = 4.0> ()
    half = Constant <value_float: float = 0.5> ()
    sweeps = Constant <value_int: int = {SWEEPS}> ()
    yes = Constant <value_int: int = 1> ()
    start = Cast <to: int = 9> (yes)
    correction, decay_end, power_end = Loop (sweeps, start, u0, one, one) <body: graph = sweep
        (int64 n, bool go, float[tiles,3,height,width] u, float decay, float power)
        => (bool again, float[tiles,3,height,width] next, float factor, float less)
    {{
        four_powers = Mul (four, power)
        shrink = Add (quarter, four_powers)
        factor = Div (decay, shrink)
        less = Mul (power, half)
        own = Mul (v, factor)
        both = Add (own, V)
        A = Div (own, both)
        differences = Conv <pads: ints = [1, 1, 1, 1]> (u, D)
        E = Sub (differences, R)
        E4 = Reshape (E, by_direction)
        A4 = Reshape (A, one_channel)
        said = Mul (A4, E4)
        total = ReduceSum <keepdims: int = 0> (said, i1)
        change = Reshape (total, image_shape)
        weights = ReduceSum <keepdims: int = 1> (A, i1)
        weight = Add (weights, one)
        step = Div (change, weight)
        next = Add (u, step)
        again = Identity (go)
    }}>
    base = Add (primal, correction)
}}
"""


def layers(config: ModelConfig) -> tuple[str, ...]:
    """The inputs of the graph of such a model."""
    return tuple(name for name in LAYERS if name in (*config.needs, *config.layers))


def signature(names: tuple[str, ...]) -> str:
    channels = {name: CHANNELS.get(name, 3) for name in names}
    return ", ".join(f"float[tiles,{channels[name]},height,width] {name}" for name in names)


def statistics(config: ModelConfig) -> str:
    """Nodes that make ``own_statistics`` (5) of cleaned layers: what ``STATISTICS`` lists, 0 for what is absent."""
    names = layers(config)
    depth = "ReduceMax <keepdims: int = 0> (depth_clean)" if "depth" in names else "Identity (none)"
    variance = "Identity (none)"
    smoothed = ""
    if config.base == "wcv":
        smoothed = "smooth_all, inside_all = ngpt.Smoothed (primal_clean, primal_var, dx_var, dy_var)"
        variance = "ngpt.RobustMean (smooth_all, inside_all)"
    return f"""
        none = Constant <value_float: float = 0.0> ()
        own_exposure = ngpt.Exposure (primal_clean)
        own_depth = {depth}
        least = ReduceMin <keepdims: int = 0> (primal_clean)
        most = ReduceMax <keepdims: int = 0> (primal_clean)
        own_low = Min (least, none)
        own_high = Max (most, none)
        {smoothed}
        own_variance = {variance}
        as_list = Constant <value_ints: ints = [1]> ()
        s0 = Reshape (own_exposure, as_list)
        s1 = Reshape (own_depth, as_list)
        s2 = Reshape (own_low, as_list)
        s3 = Reshape (own_high, as_list)
        s4 = Reshape (own_variance, as_list)
        own_statistics = Concat <axis: int = 0> (s0, s1, s2, s3, s4)
    """


def cleaned(names: tuple[str, ...]) -> str:
    """Nodes ``NAME_clean``: the layers with 0 for what is not finite; variances are cleaned where they are used."""
    return "\n".join(f"{name}_clean = ngpt.Clean ({name})" for name in names if not name.endswith("_var"))


def alone(config: ModelConfig) -> str:
    """The graph that computes the statistics of a whole image, for those who cut it into tiles."""
    used = ("primal", "depth") + (("primal_var", "dx_var", "dy_var") if config.base == "wcv" else ())
    names = tuple(name for name in layers(config) if name in used)
    body = "\n".join([cleaned(names), statistics(config), "statistics = Identity (own_statistics)"])
    return f"statistics_of ({signature(names)}) => (float[5] statistics)\n{{{body}}}"


def before(config: ModelConfig) -> str:
    """The graph from the buffers to the network's ``channels``, and to what ``after`` needs."""
    names = layers(config)
    base_input = ", float[tiles,3,base_height,base_width] base" if config.base else ""
    base_default = ", float[1,3,0,0] base = {}" if config.base else ""
    lines = [cleaned(names), _SCALE.substitute(own=statistics(config))]
    scaled = [name for name in names if name in RADIANCE]
    completed = [_computed(name, compared(config.inputs)) for name in config.inputs if name in SOURCES]
    lines += [f"{name}_scaled = Div ({name}_clean, exposure)" for name in scaled]
    if config.base:
        lines += [_BASE]
    lines += [f"start_{name} = Identity ({name}_scaled)" for name in config.start]
    lines += [*completed, *(_encode(name) for name in config.inputs)]
    lines += [_PADS, *(_pad(name) for name in config.inputs)]
    if config.quiet:
        lines += [_SHARE.substitute(quiet=float(config.quiet)), "quiet_base = Identity (base_scaled)"]
    padded = ", ".join(f"{name}_padded" for name in config.inputs)
    outputs = (
        "float[tiles,channel_count,rows,columns] channels, float exposure, float low, float high, int64 height_now, "
    )
    outputs += "int64 width_now"
    outputs += passed(config)
    count = sum(CHANNELS[name] for name in config.inputs)
    lines += [f"channels = Concat <axis: int = 1> ({padded})"]
    body = "\n".join(lines)
    return (
        f"before ({signature(names)}, float[5] statistics{base_input}) => "
        f"({outputs.replace('channel_count', str(count))})\n"
        f"<float[5] statistics = {{0, 0, 0, 0, 0}}{base_default}>\n{{{body}}}"
    )


_SCALE = Template("""
    i0 = Constant <value_ints: ints = [0]> ()
    i1 = Constant <value_ints: ints = [1]> ()
    i2 = Constant <value_ints: ints = [2]> ()
    i3 = Constant <value_ints: ints = [3]> ()
    i4 = Constant <value_ints: ints = [4]> ()
    i5 = Constant <value_ints: ints = [5]> ()
    zero = Constant <value_float: float = 0.0> ()
    one = Constant <value_float: float = 1.0> ()
    given_exposure = Slice (statistics, i0, i1)
    given_number = ReduceMax <keepdims: int = 0> (given_exposure)
    is_given = Greater (given_number, zero)
    used = If (is_given) <
        then_branch: graph = given () => (float[5] given_statistics) { given_statistics = Identity (statistics) },
        else_branch: graph = own () => (float[5] own_statistics) { $own }
    >
    exposure_list = Slice (used, i0, i1)
    depth_list = Slice (used, i1, i2)
    low_list = Slice (used, i2, i3)
    high_list = Slice (used, i3, i4)
    variance_list = Slice (used, i4, i5)
    exposure = ReduceMax <keepdims: int = 0> (exposure_list)
    depth_scale = ReduceMax <keepdims: int = 0> (depth_list)
    mean_variance = ReduceMax <keepdims: int = 0> (variance_list)
    low_radiance = ReduceMax <keepdims: int = 0> (low_list)
    high_radiance = ReduceMax <keepdims: int = 0> (high_list)
    low_scaled = Div (low_radiance, exposure)
    high_scaled = Div (high_radiance, exposure)
    low = ngpt.SignedLog (low_scaled)
    high = ngpt.SignedLog (high_scaled)
""")

_BASE = """
    finite_x = ngpt.Finite (dx)
    finite_y = ngpt.Finite (dy)
    finite_x_number = Cast <to: int = 1> (finite_x)
    finite_y_number = Cast <to: int = 1> (finite_y)
    known_x = ReduceMin <keepdims: int = 1> (finite_x_number, i1)
    known_y = ReduceMin <keepdims: int = 1> (finite_y_number, i1)
    base_size = Size (base)
    nothing = Constant <value_int: int = 0> ()
    is_absent = Equal (base_size, nothing)
    base_scaled = If (is_absent) <
        then_branch: graph = make () => (float[tiles,3,height,width] made) {
            made = ngpt.ControlVariates
                (primal_scaled, dx_scaled, dy_scaled, known_x, known_y, primal_var, dx_var, dy_var, mean_variance)
        },
        else_branch: graph = take () => (float[tiles,3,height,width] taken) { taken = Div (base, exposure) }
    >
"""

_PADS = f"""
    height_list = Shape <start: int = 2, end: int = 3> (primal)
    width_list = Shape <start: int = 3, end: int = 4> (primal)
    height_now = Squeeze (height_list)
    width_now = Squeeze (width_list)
    margins = Constant <value_int: int = {2 * MARGIN}> ()
    margin = Constant <value_int: int = {MARGIN}> ()
    alignment = Constant <value_int: int = $ALIGNMENT> ()
    tall = Add (height_now, margins)
    wide = Add (width_now, margins)
    less_tall = Neg (tall)
    less_wide = Neg (wide)
    more_rows = Mod (less_tall, alignment)
    more_columns = Mod (less_wide, alignment)
    after_rows = Add (margin, more_rows)
    after_columns = Add (margin, more_columns)
    rows = ngpt.Mirror (height_now, after_rows)
    columns = ngpt.Mirror (width_now, after_columns)
    rows_here, rows_nearest, row_step_flat = ngpt.Steps (rows)
    columns_here, columns_nearest, column_step = ngpt.Steps (columns)
    row_step = Unsqueeze (row_step_flat, i1)
    row_distance = Abs (row_step)
    column_distance = Abs (column_step)
"""


_SHARE = Template(f"""
    huge = Constant <value_float: float = {HUGE}> ()
    quiet_clean = ngpt.Clean (primal_var)
    quiet_positive = Max (quiet_clean, zero)
    quiet_root = Sqrt (quiet_positive)
    quiet_scaled = Div (quiet_root, exposure)
    quiet_noise = Min (quiet_scaled, huge)
    quiet_square = Mul (quiet_noise, quiet_noise)
    quiet_variances = ReduceMean <keepdims: int = 1> (quiet_square, i1)
    quiet_size = Abs (base_scaled)
    quiet_light = Min (quiet_size, huge)
    quiet_lights = ReduceMean <keepdims: int = 1> (quiet_light, i1)
    quiet_both = Concat <axis: int = 1> (quiet_variances, quiet_lights)
    quiet_tall = Gather <axis: int = 2> (quiet_both, rows_here)
    quiet_padded = Gather <axis: int = 3> (quiet_tall, columns_here)
    quiet_means = AveragePool <kernel_shape: ints = [{WINDOW}, {WINDOW}],
        pads: ints = [{", ".join(4 * [str(WINDOW // 2)])}], count_include_pad: int = 0> (quiet_padded)
    quiet_variance = Slice (quiet_means, i0, i1, i1)
    quiet_mean = Slice (quiet_means, i1, i2, i1)
    quiet_error = Sqrt (quiet_variance)
    dark = Constant <value_float: float = {DARK}> ()
    quiet_raised = Add (quiet_mean, dark)
    quiet_limit = Constant <value_float: float = $quiet> ()
    quiet_least = Mul (quiet_raised, quiet_limit)
    quiet_ratio = Div (quiet_error, quiet_least)
    quiet_share = Min (quiet_ratio, one)
    quiet_known = Greater (quiet_variance, zero)
    share = Where (quiet_known, quiet_share, one)
""")


def _computed(name: str, other: str) -> str:
    """Nodes that make ``NAME_computed`` of scaled layers, as ``ngpt.network.features.completed`` does.

    ``other`` is the image it is relative to.
    """
    source = SOURCES[name][0]
    if name.endswith("_change"):
        return f"""
    {name}_log = ngpt.SignedLog ({source}_scaled)
    {name}_log_other = ngpt.SignedLog ({other}_scaled)
    {name}_computed = Sub ({name}_log, {name}_log_other)"""
    if name.endswith("_noise"):
        return f"""
    {name}_clean = ngpt.Clean ({source.replace("_se", "_var")})
    {name}_positive = Max ({name}_clean, zero)
    {name}_root = Sqrt ({name}_positive)
    {name}_scaled = Div ({name}_root, exposure)
    {name}_mean = ReduceMean <keepdims: int = 1> ({name}_scaled, i1)
    {name}_size = Abs ({other}_scaled)
    {name}_brightness = ReduceMean <keepdims: int = 1> ({name}_size, i1)
    {name}_divisor = Add ({name}_brightness, one)
    {name}_computed = Div ({name}_mean, {name}_divisor)"""
    image, axis = SOURCES[name][1], "i3" if name.startswith("dx") else "i2"
    return f"""
    {name}_last = Constant <value_ints: ints = [-1]> ()
    {name}_beyond = Constant <value_ints: ints = [1000000000]> ()
    {name}_edge = Slice ({image}_scaled, {name}_last, {name}_beyond, {axis})
    {name}_rest = Slice ({image}_scaled, i1, {name}_beyond, {axis})
    {name}_next = Concat <axis: int = {axis[1]}> ({name}_rest, {name}_edge)
    {name}_difference = Sub ({name}_next, {image}_scaled)
    {name}_contradiction = Sub ({source}_scaled, {name}_difference)
    {name}_size = Abs ({other}_scaled)
    {name}_divisor = Add ({name}_size, one)
    {name}_computed = Div ({name}_contradiction, {name}_divisor)"""


def _encode(name: str) -> str:
    """Nodes that make ``NAME_encoded``, as ``ngpt.network.features`` tells."""
    if name in IMAGES:
        return f"""
    {name}_positive = Max ({name}_scaled, zero)
    {name}_more = Add ({name}_positive, one)
    {name}_encoded = Log ({name}_more)"""
    if name in ("dx", "dy"):
        return f"{name}_encoded = ngpt.Encoded ({name}_scaled)"
    if name == "depth":
        return """
    tiny_depth = Constant <value_float: float = 1e-10> ()
    depth_divisor = Add (depth_scale, tiny_depth)
    depth_encoded = Div (depth_clean, depth_divisor)"""
    if name.endswith("_noise"):
        return f"""
    {name}_hundred = Constant <value_float: float = 100.0> ()
    {name}_large = Mul ({name}_computed, {name}_hundred)
    {name}_more = Add ({name}_large, one)
    {name}_encoded = Log ({name}_more)"""
    if name in SOURCES:
        return f"""
    {name}_twenty = Constant <value_float: float = 20.0> ()
    {name}_large = Mul ({name}_computed, {name}_twenty)
    {name}_encoded = ngpt.SignedLog ({name}_large)"""
    if name.endswith("_se"):
        layer = name.replace("_se", "_var")
        return f"""
    {name}_clean = ngpt.Clean ({layer})
    {name}_positive = Max ({name}_clean, zero)
    {name}_root = Sqrt ({name}_positive)
    {name}_scaled = Div ({name}_root, exposure)
    {name}_mean = ReduceMean <keepdims: int = 1> ({name}_scaled, i1)
    {name}_more = Add ({name}_mean, one)
    {name}_encoded = Log ({name}_more)"""
    return f"{name}_encoded = Identity ({name}_clean)"


def _pad(name: str) -> str:
    """Nodes that make ``NAME_padded``. Signs survive the logarithm, so padding may come after it."""
    if name.startswith("dx"):
        step = "column_distance" if name.endswith(("_se", "_noise")) else "column_step"
        return f"""
    {name}_wide = Gather <axis: int = 3> ({name}_encoded, columns_nearest)
    {name}_signed = Mul ({name}_wide, {step})
    {name}_padded = Gather <axis: int = 2> ({name}_signed, rows_here)"""
    if name.startswith("dy"):
        step = "row_distance" if name.endswith(("_se", "_noise")) else "row_step"
        return f"""
    {name}_tall = Gather <axis: int = 2> ({name}_encoded, rows_nearest)
    {name}_signed = Mul ({name}_tall, {step})
    {name}_padded = Gather <axis: int = 3> ({name}_signed, columns_here)"""
    return f"""
    {name}_tall = Gather <axis: int = 2> ({name}_encoded, rows_here)
    {name}_padded = Gather <axis: int = 3> ({name}_tall, columns_here)"""


def passed(config: ModelConfig) -> str:
    """What ``before`` passes on to ``after``: what the network starts from, and what it goes over to, and where."""
    images = [f"start_{name}" for name in config.start] + (["quiet_base"] if config.quiet else [])
    share = ", float[tiles,1,rows,columns] share" if config.quiet else ""
    return "".join(f", float[tiles,3,height,width] {name}" for name in images) + share


def _corrected(config: ModelConfig) -> str:
    """Nodes that make ``logarithm`` of the network's output, ``cropped``, and of the images it starts from."""
    if not config.start:
        return "logarithm = Identity (cropped)"
    if len(config.start) == 1:
        return f"""
    log_start = ngpt.SignedLog (start_{config.start[0]})
    logarithm = Add (cropped, log_start)"""
    lines = [
        "colours = Constant <value_ints: ints = [3]> ()",
        f"all = Constant <value_ints: ints = [{config.outputs}]> ()",
        "first = Constant <value_ints: ints = [0]> ()",
        "channel_axis = Constant <value_ints: ints = [1]> ()",
        "correction = Slice (cropped, first, colours, channel_axis)",
        "logits = Slice (cropped, colours, all, channel_axis)",
        "weights = Softmax <axis: int = 1> (logits)",
    ]
    for i, name in enumerate(config.start):
        lines += [
            f"begin_{i} = Constant <value_ints: ints = [{i}]> ()",
            f"end_{i} = Constant <value_ints: ints = [{i + 1}]> ()",
            f"weight_{i} = Slice (weights, begin_{i}, end_{i}, channel_axis)",
            f"part_{i} = Mul (weight_{i}, start_{name})",
        ]
    parts = ", ".join(f"part_{i}" for i in range(len(config.start)))
    lines += [
        f"mean = Sum ({parts})",
        "log_start = ngpt.SignedLog (mean)",
        "logarithm = Add (correction, log_start)",
    ]
    return "\n    ".join(lines)


def _converging(config: ModelConfig) -> str:
    """Nodes that make ``converging`` of ``logarithm``: what goes over to the base as noise vanishes."""
    if not config.quiet:
        return "converging = Identity (logarithm)"
    return """share_here = Slice (share, margins, ends, axes)
    log_base = ngpt.SignedLog (quiet_base)
    beyond_base = Sub (logarithm, log_base)
    shared = Mul (beyond_base, share_here)
    converging = Add (log_base, shared)"""


def after(config: ModelConfig) -> str:
    """The graph from the network's output, and what ``before`` passes on, to the image."""
    return f"""after (float[tiles,{config.outputs},rows,columns] prediction, float exposure, float low, float high,
    int64 height_now, int64 width_now{passed(config)}) => (float[tiles,3,height,width] image)
{{
    as_list = Constant <value_ints: ints = [1]> ()
    margins = Constant <value_ints: ints = [{MARGIN}, {MARGIN}]> ()
    height_list = Reshape (height_now, as_list)
    width_list = Reshape (width_now, as_list)
    sizes = Concat <axis: int = 0> (height_list, width_list)
    ends = Add (margins, sizes)
    axes = Constant <value_ints: ints = [2, 3]> ()
    cropped = Slice (prediction, margins, ends, axes)
    {_corrected(config)}
    {_converging(config)}
    bounded_below = Max (converging, low)
    bounded = Min (bounded_below, high)
    radiance = ngpt.SignedExp (bounded)
    image = Mul (radiance, exposure)
}}"""
