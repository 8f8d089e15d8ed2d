"""Parts of graphs beside the functions that they repeat, where whole networks (test_network_onnx.py) would not tell."""

import numpy as np
import pytest

pytest.importorskip("onnx")
torch = pytest.importorskip("torch")

# ruff: noqa: E402
import onnx
import onnxruntime
from onnx.reference import ReferenceEvaluator
from onnx.reference.op_run import OpRun

from ngpt.classical.leastsquares import robust_mean
from ngpt.export.builder import Graph, op
from ngpt.export.graphs import transfer, variances
from ngpt.export.graphs.model import _OperatorsOfHeads
from ngpt.network import transfer as torch_transfer
from ngpt.network.heads import Direct, Mixture, Pyramid, Residual
from ngpt.network.poisson import GRADIENTS, Poisson
from ngpt.network.shipped import WEIGHTS


def evaluate(function, *arrays):
    """What a graph of values makes of arrays, in ONNX Runtime."""
    graph = Graph("test")
    values = [graph.input(f"x{i}", [f"d{i}_{axis}" for axis in range(a.ndim)]) for i, a in enumerate(arrays)]
    # An output must have a shape, which tests need not know before.
    graph.output("values", op.Reshape(function(*values), [-1]), ("count",))
    session = onnxruntime.InferenceSession(graph.model({}).SerializeToString(), providers=["CPUExecutionProvider"])
    return session.run(None, {f"x{i}": np.asarray(a, np.float32) for i, a in enumerate(arrays)})[0]


@pytest.mark.parametrize("name", ["signed_log", "signed_exp"])
def test_transfer_is_exact_to_rounding(name):
    x = np.float32([0, 1e-38, 1e-12, 1e-4, 0.3, 1, 20, 80] if name == "signed_exp" else [0, 1e-38, 1e-9, 0.3, 1, 1e12])
    x = np.concatenate([-x, x])
    expected = getattr(torch_transfer, name)(torch.from_numpy(x)).numpy()
    assert np.allclose(evaluate(getattr(transfer, name), x), expected, rtol=1e-6, atol=0)


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


HEADS = [
    Direct(),
    Residual(("base",)),
    Mixture(("primal", "base")),
    Poisson(("base",), Residual(("base",)), 1),
    Poisson(("primal", "base"), Mixture(("primal", "base")), 3),
    Poisson(("primal", "base"), Pyramid(("primal", "base"), 3, 3, True), 2),
]


@pytest.mark.parametrize("head", HEADS, ids=repr)
def test_heads_are_the_same_as_graphs(head):
    torch.manual_seed(0)
    sides, sweeps = (16 + 2 * head.radius, 24 + 2 * head.radius), isinstance(head, Poisson)
    prediction = 2 * torch.randn(2, head.outputs, 16, 24)
    if sweeps:
        # Sweeps carry what a bright pixel is rounded by to its dark neighbours, and some processors round exp to 20
        # units of the last place: no pixel is more than some hundred times as bright as the next.
        prediction[:, : head.inner.outputs] /= 4
        gradients = [torch.randn(2, 3, *sides), torch.randn(2, 3, *sides), *torch.rand(2, 2, 1, *sides)]
        gradients[2][..., head.radius + 3, :] = 0
        images = [0.1 + 3 * torch.rand(2, 3, *sides) for _ in head.inner.reads] + gradients
        assert head.reads[-4:] == GRADIENTS
    else:
        images = [10 ** torch.randn(2, 3, *sides) for _ in head.start]
    expected = head.forward(prediction, images).numpy()
    made = evaluate(lambda first, *others: head.graph(_OperatorsOfHeads(), first, list(others)), prediction, *images)
    near = 1e-4 if sweeps else 1e-5
    assert np.allclose(made, expected.ravel(), rtol=near, atol=near)


@pytest.mark.parametrize("path", sorted(WEIGHTS.glob("*.onnx")), ids=lambda path: path.stem)
def test_nodes_have_names_of_their_own(path):
    """ONNX Runtime 1.21 fuses nodes under the name of one of them, and refuses a model with one name twice."""

    def names(graph):
        for node in graph.node:
            yield node.name
            for attribute in node.attribute:
                if attribute.HasField("g"):
                    yield from names(attribute.g)

    found = list(names(onnx.load(path).graph))
    assert all(found) and len(set(found)) == len(found)
