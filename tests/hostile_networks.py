"""Networks that lie: small graphs with the metadata of ours, each wrong in one way, written for the hosts' tests."""

from collections.abc import Callable
from pathlib import Path

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
    metadata: dict | None = None,
) -> Path:
    """Writes a network that gives `primal` back, and beside it the one of its statistics.

    ``make``      (helper) -> nodes from "same", which is `primal`, to ``output``; default: as it is
    ``kind``      element type of the output, with a Cast to it unless ``make`` is given
    ``shape``     that the output is said to have
    ``given``     the shape of `primal`
    ``more``      further inputs
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
    made = helper.make_tensor_value_info(output, kind, shape or IMAGE)
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


def sequence_input(helper, kind: str = "FLOAT"):
    from onnx import TensorProto

    return helper.make_tensor_sequence_value_info("list", getattr(TensorProto, kind), None)


def reshaped(*shape: int) -> Callable:
    """Nodes that give the first elements another shape than the graph says; sizes are those of runs of 8x8 pixels."""

    def make(helper):
        constant = helper.make_tensor("to", 7, [len(shape)], list(shape))
        return [
            helper.make_node("Constant", [], ["shape"], value=constant),
            helper.make_node("Reshape", ["same", "shape"], ["image"]),
        ]

    return make


def expanded(size: int) -> Callable:
    def make(helper):
        constant = helper.make_tensor("to", 7, [4], [size, 3, 8, 8])
        return [
            helper.make_node("Constant", [], ["shape"], value=constant),
            helper.make_node("Expand", ["same", "shape"], ["image"]),
        ]

    return make


def hostile(folder: Path) -> dict[str, Path]:
    """Name -> file; all of them are refused when they are opened, or when they run on 8x8 pixels."""
    from onnx import helper

    def at(name: str) -> Path:
        return folder / f"{name}.onnx"

    files = {
        "sequence in": network(at("sequence in"), more=[sequence_input(helper)]),
        "sequence of integers in": network(at("sequence of integers in"), more=[sequence_input(helper, "INT64")]),
        "float16 in": network(at("float16 in"), more=[helper.make_tensor_value_info("half", 10, IMAGE)]),
        "text in": network(at("text in"), more=[helper.make_tensor_value_info("text", 8, [1])]),
        "transposed": network(at("transposed"), reshaped(1, 8, 8, 3)),
        "flat": network(at("flat"), reshaped(192), shape=IMAGE),
        "expanded": network(at("expanded"), expanded(2)),
        "very large": network(at("very large"), expanded(2**40)),
        "no image": network(at("no image"), output="picture"),
        "four channels in": network(at("four channels in"), given=[1, 4, "height", "width"]),
        "no channels": network(at("no channels"), given=[1, 0, "height", "width"]),
        "any channels": network(at("any channels"), given=[1, "channels", "height", "width"]),
        "no rank": network(at("no rank"), given=[3]),
        "small images only": network(at("small images only"), given=[1, 3, 4, 4]),
        "twice": network(at("twice"), metadata={"ngpt.inputs": "primal, primal"}),
        "statistics as a layer": network(at("statistics as a layer"), metadata={"ngpt.inputs": "primal, statistics"}),
        "no metadata": network(at("no metadata"), metadata=dict.fromkeys(METADATA)),
    }
    for kind in ("UINT8", "FLOAT16", "DOUBLE", "INT64", "BOOL", "STRING", "BFLOAT16"):
        files[f"{kind} out"] = network(at(f"{kind} out"), kind=kind)
    files["sequence out"] = network(at("sequence out"))
    model_of_sequence(files["sequence out"])
    for key in METADATA:
        for i, value in enumerate(("nan", "-1", "", "1e400", "inf", "0x10", "9" * 400, "\x1b]0;x\x07", "é" * 300)):
            files[f"{key} {i}"] = network(at(f"{key} {i}"), metadata={key: value})
    whole = network(at("whole")).read_bytes()
    for name, content in {"empty": b"", "text": b"not a network", "cut": whole[:-9], "zeros": bytes(999)}.items():
        at(name).write_bytes(content)
        files[name] = at(name)
    (folder / "folder.onnx").mkdir()
    return files | {"folder": folder / "folder.onnx", "endless": Path("/dev/zero"), "none": at("none")}


def model_of_sequence(path: Path) -> None:
    """Its image is a sequence of one tensor."""
    from onnx import TensorProto, helper

    zeros = helper.make_tensor("statistics", TensorProto.FLOAT, [5], [0.0] * 5)
    nodes = [
        helper.make_node("ReduceSum", ["statistics"], ["sum"], keepdims=0),
        helper.make_node("Add", ["primal", "sum"], ["same"]),
        helper.make_node("SequenceConstruct", ["same"], ["image"]),
    ]
    inputs = [helper.make_tensor_value_info("primal", TensorProto.FLOAT, IMAGE)]
    inputs += [helper.make_tensor_value_info("statistics", TensorProto.FLOAT, [5])]
    made = helper.make_tensor_sequence_value_info("image", TensorProto.FLOAT, None)
    save(helper.make_graph(nodes, "graph", inputs, [made], [zeros]), path, METADATA)
