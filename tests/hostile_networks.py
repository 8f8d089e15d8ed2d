"""Networks that lie: small graphs with the metadata of ours, each wrong in one way, written for the hosts' tests."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

METADATA = {
    "ngpt.inputs": "primal",
    "ngpt.alignment": "4",
    "ngpt.overlap": "2",
    "ngpt.overlap with base": "2",
    "ngpt.bytes per pixel": "4096",
}
IMAGE = [1, 3, "height", "width"]


def network(
    path: Path,
    make: Callable | None = None,
    *,
    kind: str = "FLOAT",
    shape: list | None = None,
    given: list | None = None,
    more: list | None = None,
    output: str = "image",
    made: Any = None,
    metadata: dict | None = None,
) -> Path:
    """Writes a network that gives `primal` back, and beside it the one of its statistics.

    ``make``      (helper) -> nodes from "same", which is `primal`, to ``output``; default: as it is
    ``kind``      element type of the output, with a Cast to it unless ``make`` is given
    ``shape``     that the output is said to have
    ``given``     the shape of `primal`
    ``more``      further inputs
    ``made``      what the output is said to be
    ``metadata``  replaced or, where None, taken out
    """
    from onnx import TensorProto, helper

    kind = getattr(TensorProto, kind)
    zeros = helper.make_tensor("statistics", TensorProto.FLOAT, [5], [0.0] * 5)
    # The statistics must be read, else ONNX Runtime has no such input.
    nodes = [
        helper.make_node("ReduceSum", ["statistics"], ["sum"], keepdims=0),
        helper.make_node("Sub", ["sum", "sum"], ["nought"]),
        helper.make_node("Add", ["primal", "nought"], ["same"]),
    ]
    nodes += make(helper) if make else [helper.make_node("Cast", ["same"], [output], to=kind)]
    inputs = [helper.make_tensor_value_info("primal", TensorProto.FLOAT, given or IMAGE)]
    inputs += [helper.make_tensor_value_info("statistics", TensorProto.FLOAT, [5]), *(more or [])]
    made = made or helper.make_tensor_value_info(output, kind, shape or IMAGE)
    known = {key: value for key, value in (METADATA | (metadata or {})).items() if value is not None}
    save(helper.make_graph(nodes, "graph", inputs, [made], [zeros]), path, known)
    statistics(path)
    return path


def statistics(path: Path, kind: str = "FLOAT", count: int = 5, name: str = "statistics") -> None:
    """Writes the network of the statistics beside ``path``: ``count`` times the mean."""
    from onnx import TensorProto, helper

    ones = helper.make_tensor("ones", TensorProto.FLOAT, [count], [1.0] * count)
    nodes = [
        helper.make_node("ReduceMean", ["primal"], ["mean"], keepdims=0),
        helper.make_node("Mul", ["mean", "ones"], ["numbers"]),
        helper.make_node("Cast", ["numbers"], [name], to=getattr(TensorProto, kind)),
    ]
    made = helper.make_tensor_value_info(name, getattr(TensorProto, kind), [count])
    image = helper.make_tensor_value_info("primal", TensorProto.FLOAT, IMAGE)
    save(helper.make_graph(nodes, "graph", [image], [made], [ones]), path.with_suffix(".statistics.onnx"), {})


def save(graph, path: Path, metadata: dict) -> None:
    from onnx import helper

    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=8)
    helper.set_model_props(model, metadata)
    path.write_bytes(model.SerializeToString())


def reshaped(*shape: int) -> Callable:
    """Nodes that give the first elements another shape than the graph says; sizes are those of runs of 8x8 pixels."""
    return _with_shape("Reshape", shape)


def _with_shape(kind: str, shape: tuple[int, ...]) -> Callable:
    def make(helper):
        constant = helper.make_tensor("to", 7, [len(shape)], list(shape))
        nodes = [helper.make_node("Constant", [], ["shape"], value=constant)]
        return [*nodes, helper.make_node(kind, ["same", "shape"], ["image"])]

    return make


def hostile(folder: Path) -> dict[str, Path]:
    """Name -> file; all of them are refused when they are opened, or when they run on 8x8 pixels."""
    from onnx import TensorProto, helper

    files: dict[str, Path] = {}

    def add(name: str, *arguments, **options) -> None:
        files[name] = network(folder / f"{name}.onnx", *arguments, **options)

    value, sequence = helper.make_tensor_value_info, helper.make_tensor_sequence_value_info
    add("sequence in", more=[sequence("list", TensorProto.FLOAT, None)])
    add("sequence of integers in", more=[sequence("list", TensorProto.INT64, None)])
    add("float16 in", more=[value("half", TensorProto.FLOAT16, IMAGE)])
    add("text in", more=[value("text", TensorProto.STRING, [1])])
    add("layer that is not in the metadata", more=[value("other", TensorProto.FLOAT, IMAGE)])
    add("transposed", reshaped(1, 8, 8, 3))
    add("flat", reshaped(192), shape=IMAGE)
    add("expanded", _with_shape("Expand", (2, 3, 8, 8)))
    add("very large", _with_shape("Expand", (2**40, 3, 8, 8)))
    add("no image", output="picture")
    for name, given in {
        "four channels": [1, 4, "height", "width"],
        "no channels": [1, 0, "height", "width"],
        "any channels": [1, "channels", "height", "width"],
        "no rank": [3],
        "small images only": [1, 3, 4, 4],
    }.items():
        add(name, given=given)
    for layers in ("primal, primal", "primal, statistics", "primal, albino"):
        add(layers, metadata={"ngpt.inputs": layers})
    add("no metadata", metadata=dict.fromkeys(METADATA))
    for kind in ("UINT8", "FLOAT16", "DOUBLE", "INT64", "BOOL", "STRING", "BFLOAT16"):
        add(f"{kind} out", kind=kind)
    made = sequence("image", TensorProto.FLOAT, None)
    add("sequence out", lambda helper: [helper.make_node("SequenceConstruct", ["same"], ["image"])], made=made)
    for key in METADATA:
        for i, text in enumerate(("nan", "-1", "", "1e400", "inf", "0x10", "9" * 400, "\x1b]0;x\x07", "é" * 300)):
            add(f"{key} {i}", metadata={key: text})
    whole = network(folder / "whole.onnx").read_bytes()
    contents = {"empty": b"", "text": b"not a network", "cut": whole[:-9], "head": whole[:100], "zeros": bytes(999)}
    for name, content in contents.items():
        files[name] = folder / f"{name}.onnx"
        files[name].write_bytes(content)
    (folder / "folder.onnx").mkdir()
    further = {"statistics": folder / "whole.statistics.onnx", "endless": Path("/dev/zero")}
    return files | further | {name: folder / f"{name}.onnx" for name in ("folder", "none")}
