"""Builds ONNX graphs from Python expressions: each call of an operator, and each +, -, * and / of values, adds a node.

    graph = Graph("double")
    x = graph.input("x", ("n", 3))
    graph.output("y", op.Max(x, 0.0) * 2.0, ("n", 3))
    model = graph.model({"method": "double"})

``op.NAME`` is ONNX's operator of that name, with its inputs in order and its attributes by name. Inputs that are floats
become constants of float32, ints and lists of ints become constants of int64, and arrays become constants of their own
type.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import onnx
import onnx.compose
from onnx import helper, numpy_helper

from ngpt.version import __version__

OPSET = 18
IR_VERSION = 9
FLOAT, INT64, BOOL = onnx.TensorProto.FLOAT, onnx.TensorProto.INT64, onnx.TensorProto.BOOL
# The end of a slice that goes to the end of its axis.
END = 2**63 - 1

Shape = Sequence[int | str]


class Value:
    """A tensor in a graph: an input, or the result of a node."""

    # Makes NumPy arrays leave operators to this class.
    __array_ufunc__ = None

    def __init__(self, graph: "Graph", name: str):
        self.graph, self.name = graph, name

    def __add__(self, other: Any) -> "Value":
        return op.Add(self, other)

    def __sub__(self, other: Any) -> "Value":
        return op.Sub(self, other)

    def __mul__(self, other: Any) -> "Value":
        return op.Mul(self, other)

    def __truediv__(self, other: Any) -> "Value":
        return op.Div(self, other)

    def __neg__(self) -> "Value":
        return op.Neg(self)

    def __abs__(self) -> "Value":
        return op.Abs(self)


class Operators:
    """The operators of ONNX by name. ``outputs`` is the number of values that a call returns, by default 1."""

    def __getattr__(self, kind: str) -> Callable[..., Any]:
        if not kind[:1].isupper():
            raise AttributeError(kind)
        return partial(self._call, kind)

    def _call(self, kind: str, *inputs: Any, outputs: int = 1, **attributes: Any) -> Any:
        graph = next(value.graph for value in inputs if isinstance(value, Value))
        return graph.node(kind, inputs, outputs, attributes)


op = Operators()


class Graph:
    """A graph that grows by one node with each operator that is applied to its values."""

    def __init__(self, name: str):
        self.name = name
        self._inputs: list[onnx.ValueInfoProto] = []
        self._outputs: list[onnx.ValueInfoProto] = []
        self._initializers: dict[str, onnx.TensorProto] = {}
        self._constants: dict[tuple, Value] = {}
        # The nodes of the graph, and of each nested body that is being made.
        self._bodies: list[list[onnx.NodeProto]] = [[]]
        self._names = 0

    def input(self, name: str, shape: Shape, default: np.ndarray | None = None) -> Value:
        """A float32 input. An input with a ``default`` may be left out when the model is run."""
        self._inputs.append(helper.make_tensor_value_info(name, FLOAT, shape))
        if default is not None:
            self._initializers[name] = numpy_helper.from_array(default.astype(np.float32), name)
        return Value(self, name)

    def output(self, name: str, value: Value, shape: Shape) -> None:
        """Makes a float32 value an output."""
        self._bodies[-1].append(helper.make_node("Identity", [value.name], [name], name=f"node of {name}"))
        self._outputs.append(helper.make_tensor_value_info(name, FLOAT, shape))

    def node(self, kind: str, inputs: Sequence[Any], outputs: int, attributes: Mapping[str, Any]) -> Any:
        """The value, or tuple of values, that a new node makes of ``inputs``; None leaves an optional input out."""
        names = ["" if value is None else self._value(value).name for value in inputs]
        results = tuple(self._new(kind) for _ in range(outputs))
        # Nodes need names, because an optimizer of ONNX Runtime 1.21 derives names of new nodes from them, and refuses
        # duplicates.
        outputs_of = [result.name for result in results]
        self._bodies[-1].append(helper.make_node(kind, names, outputs_of, f"node of {outputs_of[0]}", **attributes))
        return results[0] if outputs == 1 else results

    def include(self, model: onnx.ModelProto, prefix: str, value: Value) -> Value:
        """Adds a model with one input, which gets ``value``, and returns its output. ``prefix`` precedes its names."""
        versions = {imported.domain: imported.version for imported in model.opset_import}
        assert versions == {"": OPSET} and not model.functions, f"of other operators: {versions}"
        graph = onnx.compose.add_prefix(model, prefix).graph
        for node in graph.node:
            node.input[:] = [value.name if name == graph.input[0].name else name for name in node.input]
        self._bodies[-1] += graph.node
        self._initializers |= {tensor.name: tensor for tensor in graph.initializer}
        return Value(self, graph.output[0].name)

    def body(self, make: Callable[..., Sequence[Value]], inputs: Mapping[str, tuple], shapes: Sequence[tuple]) -> Any:
        """A graph inside the graph, which may read all values that were made before.

        ``make`` is called with the inputs of the inner graph, and returns its outputs. ``inputs`` has the (type, shape)
        of each input, and ``shapes`` that of each output.
        """
        given = [self._new(name) for name in inputs]
        self._bodies.append([])
        results = [op.Identity(value) for value in make(*given)]
        nodes = self._bodies.pop()
        described = zip(results, shapes, strict=True)
        return helper.make_graph(
            nodes,
            self._new("body").name,
            [helper.make_tensor_value_info(v.name, *kind) for v, kind in zip(given, inputs.values(), strict=True)],
            [helper.make_tensor_value_info(value.name, *kind) for value, kind in described],
        )

    def model(self, metadata: Mapping[str, str]) -> onnx.ModelProto:
        """The checked model, with ``metadata`` under names ``ngpt.*``, without unused nodes and constants."""
        (nodes,) = self._bodies
        graph = helper.make_graph(nodes, self.name, self._inputs, self._outputs)
        read = _drop_unused(graph)
        given = {value.name for value in self._inputs}
        graph.initializer.extend(t for name, t in self._initializers.items() if name in read | given)
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION)
        model.producer_name, model.producer_version = "ngpt", __version__
        helper.set_model_props(model, {f"ngpt.{key}": value for key, value in metadata.items()})
        onnx.checker.check_model(model, full_check=True)
        return model

    def _new(self, kind: str) -> Value:
        self._names += 1
        return Value(self, f"{kind}_{self._names}")

    def _value(self, value: Any) -> Value:
        """The value itself, or the constant of a number or array. Equal constants are stored once."""
        if isinstance(value, Value):
            return value
        array = np.asarray(value, np.float32 if isinstance(value, float) else None)
        key = array.dtype, array.shape, array.tobytes()
        if key not in self._constants:
            self._constants[key] = self._new("constant")
            name = self._constants[key].name
            self._initializers[name] = numpy_helper.from_array(array, name)
        return self._constants[key]


def channels(x: Value, first: int, last: int) -> Value:
    """Channels first .. last - 1 of (N, C, H, W)."""
    return op.Slice(x, [first], [last], [1])


def choose(condition: Value, then: Callable[[], Value], otherwise: Callable[[], Value], shape: Shape) -> Value:
    """The float32 result of ``then`` if the scalar ``condition`` is true, else the result of ``otherwise``."""
    branches = [condition.graph.body(lambda make=make: [make()], {}, [(FLOAT, shape)]) for make in (then, otherwise)]
    return op.If(condition, then_branch=branches[0], else_branch=branches[1])


def repeat(most: int, step: Callable[[Value, Value], tuple[Value, Value | bool]], state: Value, shape: Shape) -> Value:
    """The float32 ``state`` after at most ``most`` steps.

    ``step`` takes the number of the step, from 0, and the state; it returns the next state, and whether to go on.
    """
    graph = state.graph

    def body(number: Value, _: Value, state: Value) -> list[Value]:
        following, again = step(number, state)
        return [graph._value(again), following]

    inputs = {"number": (INT64, ()), "go": (BOOL, ()), "state": (FLOAT, shape)}
    return op.Loop(most, True, state, body=graph.body(body, inputs, [(BOOL, ()), (FLOAT, shape)]))


def _drop_unused(graph: onnx.GraphProto) -> set[str]:
    """Removes nodes whose results are not read; returns all names that the remaining nodes read."""
    read = {output.name for output in graph.output}
    kept = []
    for node in reversed(graph.node):
        if read & set(node.output):
            kept.append(node)
            read |= set(node.input)
            for attribute in node.attribute:
                if attribute.HasField("g"):
                    read |= _drop_unused(attribute.g)
    del graph.node[:]
    graph.node.extend(reversed(kept))
    return read
