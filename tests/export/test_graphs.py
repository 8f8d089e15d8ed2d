"""Each graph beside the function it repeats, by itself: where the whole differs, this says which part does."""

import numpy as np
import pytest

pytest.importorskip("onnx")
torch = pytest.importorskip("torch")

# ruff: noqa: E402
import onnx
import onnxruntime
from full_stack import full_layers
from onnx.reference import ReferenceEvaluator
from onnx.reference.op_run import OpRun

from ngpt.classical import controlvariates as numpy_controlvariates
from ngpt.classical.leastsquares import robust_mean
from ngpt.denoisers import caustic as numpy_caustic
from ngpt.export.builder import FLOAT, Graph, choose, op, repeat
from ngpt.export.graphs import caustic, controlvariates, exposure, features, padding, transfer, variances
from ngpt.export.graphs.model import _OperatorsOfHeads
from ngpt.export.graphs.repair import clean, repaired
from ngpt.network import features as torch_features
from ngpt.network import padding as torch_padding
from ngpt.network import transfer as torch_transfer
from ngpt.network.heads import Direct, Kernels, Mixture, Pyramid, Residual
from ngpt.network.poisson import GRADIENTS, Poisson
from ngpt.network.shipped import WEIGHTS
from ngpt.repair import repair as numpy_repair
from ngpt.stack import GradientStack


def planes(layer):
    return np.ascontiguousarray(layer.transpose(2, 0, 1)[None], np.float32)


def evaluate(function, *arrays):
    """What a graph of values makes of arrays, in ONNX Runtime."""
    graph = Graph("test")
    values = [graph.input(f"x{i}", [f"d{i}_{axis}" for axis in range(a.ndim)]) for i, a in enumerate(arrays)]
    result = function(*values)
    results = result if isinstance(result, tuple) else (result,)
    # An output must have a shape, which tests need not know before.
    for i, value in enumerate(results):
        graph.output(f"values{i}", op.Reshape(value, [-1]), (f"count{i}",))
        graph.output(f"shape{i}", op.Cast(op.Shape(value), to=FLOAT), (f"axes{i}",))
    session = onnxruntime.InferenceSession(graph.model({}).SerializeToString(), providers=["CPUExecutionProvider"])
    made = session.run(None, {f"x{i}": np.asarray(a, np.float32) for i, a in enumerate(arrays)})
    shaped = tuple(values.reshape(shape.astype(int)) for values, shape in zip(made[::2], made[1::2], strict=True))
    return shaped if isinstance(result, tuple) else shaped[0]


@pytest.mark.parametrize("name", ["signed_log", "signed_exp"])
def test_transfer_is_exact_to_rounding(name):
    x = np.float32([0, 1e-38, 1e-12, 1e-4, 0.3, 1, 20, 80] if name == "signed_exp" else [0, 1e-38, 1e-9, 0.3, 1, 1e12])
    x = np.concatenate([-x, x])
    expected = getattr(torch_transfer, name)(torch.from_numpy(x)).numpy()
    assert np.allclose(evaluate(getattr(transfer, name), x), expected, rtol=1e-6, atol=0)


def test_clean_keeps_what_is_finite():
    x = np.float32([np.nan, np.inf, -np.inf, -0.0, 3e38, -2])
    assert np.array_equal(evaluate(clean, x), np.float32([0, 0, 0, 0, 3e38, -2]))


def damaged(height, width):
    """Layers with a lamp and with values that are not finite, alone and in holes."""
    layers, rng = full_layers(height, width), np.random.default_rng(height)
    layers["direct"] = np.zeros_like(layers["primal"])
    layers["direct"][:2, : width // 2] = 30
    layers["primal"] += layers["direct"]
    for layer in layers.values():
        layer[rng.random(layer.shape) < 0.03] = rng.choice(np.float32([np.nan, np.inf, -np.inf]))
    layers["primal"][height // 4 : -2, width // 3 : -1] = np.nan
    layers["primal"][0, 0] = layers["direct"][0, 0] = 1  # so that there is something to repair from
    return layers


def lit(layers, variance=True):
    """The layers with rare bright light that gradients do not hold."""
    rng, shape = np.random.default_rng(5), layers["primal"].shape
    light = np.where(rng.random((*shape[:2], 1)) > 0.9, rng.gamma(0.3, 20, shape), 0).astype(np.float32)
    noise = np.where(light > 4, light**2, 0.1).astype(np.float32)
    noise[rng.random(shape) < (0.1 if variance else 2)] = -1
    return layers | {"primal": layers["primal"] + light, "caustic": light, "caustic_var": noise}


@pytest.mark.parametrize("gradients", [True, False])
@pytest.mark.parametrize("size", [(1, 1), (1, 9), (24, 31), (90, 75)])
def test_repair_is_that_of_numpy(size, gradients):
    layers = lit(damaged(*size))
    if min(size) > 1:
        layers["caustic"][size[0] // 3, size[1] // 5] = np.nan
    data = numpy_repair(GradientStack.from_arrays(**layers), gradients)
    expected = {"primal": data.image, "dx": data.dx, "dy": data.dy, **data.features, **data.known_variances()}
    if data.caustic is not None:
        expected |= {"caustic": data.caustic, "caustic_var": data.caustic_var}

    def graph(*values):
        ours = repaired(dict(zip(layers, values, strict=True)), gradients)
        return (ours.direct, *(ours.layers[name] for name in expected))

    direct, *others = evaluate(graph, *(planes(layer) for layer in layers.values()))
    assert np.array_equal(direct, planes(data.direct))
    for (name, theirs), ours in zip(expected.items(), others, strict=True):
        theirs = planes(theirs)
        if name.startswith("d") and name != "depth":  # the last column and row, where there are no differences
            last = np.s_[..., :-1] if name.startswith("dx") else np.s_[..., :-1, :]
            ours, theirs = ours[last], theirs[last]
        if name.endswith("_var"):  # what is not known is so in any colour
            ours, theirs = (np.where((np.isfinite(v) & (v >= 0)).all(1, keepdims=True), v, -1) for v in (ours, theirs))
        assert np.allclose(ours, theirs, rtol=1e-5, atol=1e-6), name


@pytest.mark.parametrize("size", [(1, 1), (1, 40), (37, 2), (37, 70)])
@pytest.mark.parametrize("variance", [True, False])
@pytest.mark.parametrize("scale", [0.0, 1e-12, 1.0, 1e12])
def test_light_that_gradients_do_not_hold_is_spread_as_by_numpy(size, variance, scale):
    layers = lit(full_layers(*size), variance)
    layers |= {name: 0.3 * layers[name] for name in ("albedo", "normal")}
    layers |= {name: layers[name] * np.float32(scale) for name in ("primal", "caustic")}
    layers["caustic_var"] *= np.float32(scale) * np.float32(scale)
    data = numpy_repair(GradientStack.from_arrays(**layers))
    expected = data.image * 0 if data.caustic is None else numpy_caustic.denoised(data)
    names = ("caustic", "caustic_var", "albedo", "normal", "depth")

    def graph(*values):
        given = dict(zip(names, values, strict=True))
        return caustic.spread(given, op.ReduceMax(given["depth"], keepdims=0))

    ours = evaluate(graph, *(planes(layers[name]) for name in names))
    assert np.abs(ours - planes(expected)).max() <= 1e-6 * np.abs(expected).max()


@pytest.mark.parametrize("size", [(1, 1), (2, 3), (7, 6), (8, 10)])
def test_half_the_size_and_back_as_by_numpy(size):
    image = np.random.default_rng(0).random((*size, 3), np.float32)
    half, whole = evaluate(lambda x: (caustic.halved(x), caustic.doubled(caustic.halved(x))), planes(image))
    assert half.shape == whole.shape == planes(image).shape
    expected = numpy_caustic.halved(image)
    assert np.allclose(half[..., ::2, ::2], planes(expected), rtol=1e-6)
    assert np.allclose(whole, planes(numpy_caustic.doubled(expected)[: size[0], : size[1]]), rtol=1e-5)


@pytest.mark.parametrize("values", [[0.0], [1, 2, 3], [1] * 500 + [1e12], [1e30, 1e30, 0], [0] * 300 + [5]])
def test_the_robust_mean(values):
    values = np.float32(values)[None, None, None]
    ours = evaluate(lambda x: variances.robust_mean(x, x * 0.0 + 1.0), values)
    assert ours == pytest.approx(robust_mean(values), rel=1e-5)


class ReduceSum(OpRun):
    """As runtimes for browsers sum: one number after another, in 32 bits."""

    def _run(self, x, axes=None, keepdims=1, noop_with_empty_axes=0):
        axes = tuple(range(x.ndim)) if axes is None else tuple(int(axis) % x.ndim for axis in axes)
        kept = [axis for axis in range(x.ndim) if axis not in axes]
        rows = x.transpose(*kept, *axes).reshape([x.shape[axis] for axis in kept] + [-1])
        last = np.add.accumulate(rows, axis=-1, dtype=x.dtype)[..., -1]
        return (last.reshape([1 if axis in axes else n for axis, n in enumerate(x.shape)]) if keepdims else last,)


def test_means_of_an_image_survive_a_runtime_that_adds_one_number_after_another():
    # Two million times 0.1, added at once, are 1.5 % too little: each is rounded to what the sum can hold.
    values = np.full((1, 1, 1000, 2000), 0.1, np.float32)
    graph = Graph("test")
    x = graph.input("x", ["n", "c", "h", "w"])
    graph.output("mean", op.Reshape(variances.robust_mean(x, x * 0.0 + 1.0), [-1]), ("one",))
    (mean,) = ReferenceEvaluator(graph.model({}), new_ops=[ReduceSum]).run(None, {"x": values})
    assert np.allclose(mean, 0.1, rtol=1e-4)


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (9, 1), (24, 31)])
def test_control_variates_are_those_of_numpy(size):
    layers = full_layers(*size)
    names = ("primal", "dx", "dy", "primal_var", "dx_var", "dy_var")
    layers["primal_var"][0, 0] = np.nan
    layers["dx_var"][size[0] // 2, 0] = -1

    def graph(*values):
        given = dict(zip(names, values, strict=True))
        noise = tuple(given[name] for name in names[3:])
        everywhere = op.GreaterOrEqual(op.ReduceMin(given["primal"], [1], keepdims=1), -1e30)
        trusted = everywhere, everywhere
        mean = variances.robust_mean(*variances.smoothed(given["primal"], *noise))
        return controlvariates.wcv(given["primal"], given["dx"], given["dy"], trusted, noise, mean)

    ours = evaluate(graph, *(planes(layers[name]) for name in names))
    assert np.allclose(ours, planes(numpy_controlvariates.wcv(*(layers[name] for name in names))), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (12, 5)])
@pytest.mark.parametrize("name", ["primal", "dx", "dy", "dx_se", "dy_noise", "dx_base"])
def test_padding_and_what_it_is_cropped_to(size, name):
    rng = np.random.default_rng(0)
    layer = rng.normal(size=(1, 3, *size)).astype(np.float32)
    pads = torch_padding.pads(*size, 4)
    expected = torch_padding.pad({name: torch.from_numpy(layer)}, pads)[name]

    def graph(x):
        mirror = padding.Mirror(x, 4)
        padded = mirror.pad(x, name)
        return padded, mirror.crop(padded), mirror.extended(x, 0), mirror.extended(x, 3)

    padded, cropped, *images = evaluate(graph, layer)
    assert np.array_equal(padded, expected)
    assert np.array_equal(cropped, torch_padding.crop(expected, pads))
    image = torch_padding.pad({"primal": torch.from_numpy(layer)}, pads)["primal"]
    for radius, ours in zip((0, 3), images, strict=True):
        assert np.array_equal(ours, torch_padding.extended(image, radius))


@pytest.mark.parametrize("beside", ["base", "denoised"])
def test_every_input_of_a_network_is_encoded_as_in_torch(beside):
    given = {name: planes(layer) for name, layer in full_layers(10, 13).items()}
    given |= {name: given["primal"] * k for name, k in (("denoised", 0.9), ("denoised_base", 1.1), ("base", 0.8))}
    # Split light has no graph: networks that read it are not exported.
    graphed = (name for name in torch_features.CHANNELS if name.removesuffix("_se") not in torch_features.PARTS)
    inputs = tuple(name for name in graphed if beside == "base" or name != "base")
    assert torch_features.compared(inputs) == beside
    layers = {name: torch.from_numpy(layer) for name, layer in given.items() if not name.endswith("_var")}
    layers |= {f"{n}_se": torch.from_numpy(np.sqrt(given[f"{n}_var"])) for n in ("primal", "dx", "dy")}
    scaled, scale = torch_features.normalised(layers)
    completed = torch_features.completed(scaled, inputs)

    def graph(*values):
        raw = dict(zip(given, values, strict=True))
        primal_exposure = exposure.exposure(raw["primal"])
        depth = op.ReduceMax(raw["depth"], keepdims=0)
        names = torch_features.sources(inputs)
        ours = features.completed(features.normalised(raw, (*names, "base"), primal_exposure, depth), inputs)
        return (primal_exposure, *(features.encoded(name, ours[name]) for name in inputs))

    ours_scale, *encoded = evaluate(graph, *given.values())
    assert ours_scale == pytest.approx(scale.item(), rel=1e-6)
    for name, ours in zip(inputs, encoded, strict=True):
        theirs = torch_features.encode(completed, (name,)).numpy()
        assert ours.shape == theirs.shape and np.allclose(ours, theirs, rtol=1e-5, atol=2e-6), name


@pytest.mark.parametrize(
    "head",
    [
        Direct(),
        Residual(("base",)),
        Mixture(("primal", "base")),
        Kernels(("primal",), 1),
        Kernels(("primal", "base"), 5),
    ],
    ids=repr,
)
def test_heads_are_the_same_as_graphs(head):
    torch.manual_seed(0)
    prediction, r = 2 * torch.randn(2, head.outputs, 6, 9), head.radius
    images = [10 ** torch.randn(2, 3, 6 + 2 * r, 9 + 2 * r) for _ in head.start]
    expected = head.forward(prediction, images).numpy()
    graph = lambda first, *others: head.graph(_OperatorsOfHeads(), first, list(others))  # noqa: E731
    assert np.allclose(evaluate(graph, prediction, *images), expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(
    "head",
    [
        Poisson(("base",), Residual(("base",)), 1),
        Poisson(("primal",), Kernels(("primal",), 3), 1),
        Poisson(("primal", "base"), Mixture(("primal", "base")), 3),
        Poisson(("primal",), Pyramid(("primal",), 3, 3, True), 2),
        Poisson(("primal", "base"), Pyramid(("primal", "base"), 3, 2, True), 2),
    ],
    ids=lambda head: type(head.inner).__name__,
)
def test_sweeps_are_the_same_as_graphs(head):
    torch.manual_seed(0)
    r, sides = head.radius, (16 + 2 * head.radius, 24 + 2 * head.radius)
    prediction = 2 * torch.randn(2, head.outputs, 16, 24)
    gradients = [torch.randn(2, 3, *sides), torch.randn(2, 3, *sides), *torch.rand(2, 2, 1, *sides)]
    gradients[2][..., r + 3, :] = 0
    images = [0.1 + 3 * torch.rand(2, 3, *sides) for _ in head.inner.reads] + gradients
    assert len(images) == len(head.reads) and head.reads[-4:] == GRADIENTS
    expected = head.forward(prediction, images).numpy()
    graph = lambda first, *others: head.graph(_OperatorsOfHeads(), first, list(others))  # noqa: E731
    assert np.allclose(evaluate(graph, prediction, *images), expected, rtol=1e-4, atol=1e-5)


def test_expressions():
    x, y = np.float32([[1, -2], [3, 4]]), np.float32([[5, 6], [7, 8]])
    assert np.array_equal(evaluate(lambda a, b: -a * b + abs(a) / b - 2.0, x, y), -x * y + np.abs(x) / y - 2)
    assert np.array_equal(evaluate(lambda a: op.Concat(a, np.float32([[9, 9]]), axis=0), x), [[1, -2], [3, 4], [9, 9]])


def test_choices_and_loops_read_what_is_around_them():
    def graph(x):
        total = op.ReduceSum(x, keepdims=0)
        doubled = repeat(9, lambda n, s: (s * 2.0 + total * 0.0, op.Less(s, 10.0)), total, ())
        return doubled, choose(op.Greater(total, 0.0), lambda: x, lambda: x + total, ("n",))

    doubled, chosen = evaluate(graph, np.float32([1, 2]))
    assert doubled == 24 and np.array_equal(chosen, [1, 2])
    assert np.array_equal(evaluate(graph, np.float32([-1, -2]))[1], [-4, -5])


def test_what_no_output_needs_is_left_out_and_equal_constants_are_one():
    graph = Graph("small")
    x = graph.input("x", ("n",))
    unused = (x * 7.0) / 5.0
    graph.output("y", (x + 3.0) * 3.0, ("n",))
    model = graph.model({"method": "small"})
    assert [node.op_type for node in model.graph.node] == ["Add", "Mul", "Identity"] and unused.name
    assert len(model.graph.initializer) == 1
    assert {item.key: item.value for item in model.metadata_props} == {"ngpt.method": "small"}


def test_nodes_have_names_of_their_own():
    """ONNX Runtime 1.21 fuses nodes under the name of one of them, and refuses a model with one name twice."""

    def names(graph):
        for node in graph.node:
            yield node.name
            for attribute in node.attribute:
                if attribute.HasField("g"):
                    yield from names(attribute.g)

    for path in sorted(WEIGHTS.glob("*.onnx")):
        found = list(names(onnx.load(path).graph))
        assert all(found) and len(set(found)) == len(found), path.name
