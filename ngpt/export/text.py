"""ONNX models from their textual form, which is what the graphs around the networks are written in."""

from collections.abc import Mapping

import onnx
import onnx.inliner
import onnx.parser

from ngpt.version import __version__

OPSET = 18
IR_VERSION = 9


def parse(graph: str, functions: str = "") -> onnx.ModelProto:
    """The model of a graph, and of functions in the domain ``ngpt``, in ONNX's textual syntax.

    Lines that start with # are comments. Functions are inlined: not every runtime knows functions in a model.
    """
    header = f'<ir_version: {IR_VERSION}, opset_import: ["": {OPSET}, "ngpt": 1]>'
    lines = [line for line in f"{header}\n{graph}\n{functions}".splitlines() if not line.lstrip().startswith("#")]
    model = onnx.inliner.inline_local_functions(onnx.parser.parse_model("\n".join(lines)))
    del model.opset_import[1:]
    _drop_unused(model.graph, set())
    return model


def _drop_unused(graph: onnx.GraphProto, used_inside: set[str]) -> set[str]:
    """Removes nodes whose results nothing reads; returns what the rest reads from outside of the graph."""
    read = used_inside | {output.name for output in graph.output}
    for node in reversed(list(graph.node)):
        if not read & set(node.output):
            graph.node.remove(node)
            continue
        read |= set(node.input)
        for attribute in node.attribute:
            if attribute.HasField("g"):
                read |= _drop_unused(attribute.g, set())
    return read


def finish(model: onnx.ModelProto, metadata: Mapping[str, str]) -> onnx.ModelProto:
    """Checks the model and writes into it who made it, and ``metadata`` with names ``ngpt.*``."""
    model.producer_name, model.producer_version = "ngpt", __version__
    onnx.helper.set_model_props(model, {f"ngpt.{key}": value for key, value in metadata.items()})
    onnx.checker.check_model(model, full_check=True)
    return model
