"""ONNX files of elsewhere: other types are converted or refused by name, and texts in them are printed escaped."""

import numpy as np
import pytest
from full_stack import full_stack

import ngpt
from ngpt.cli import main
from ngpt.errors import NgptError
from ngpt.network.run_onnx import Network

onnx = pytest.importorskip("onnx")
from onnx import TensorProto, helper  # noqa: E402

KNOWN = {"ngpt.inputs": "primal", "ngpt.alignment": "1", "ngpt.base": "", "ngpt.overlap": "0"}
KNOWN |= {"ngpt.bytes per pixel": "64", "ngpt.method": "theirs"}
SIZE = ["n", 3, "h", "w"]


def network(path, kind=TensorProto.FLOAT, made=TensorProto.FLOAT, sequence=False, **metadata):
    """A file whose image is twice the primal, of an input of one type and an output of another."""
    nodes = [
        helper.make_node("Cast", ["primal"], ["single"], to=TensorProto.FLOAT),
        helper.make_node("Add", ["single", "single"], ["twice"]),
        helper.make_node("Cast", ["twice"], ["cast" if sequence else "image"], to=made),
    ]
    image = helper.make_tensor_value_info("image", made, SIZE)
    if sequence:
        nodes.append(helper.make_node("SequenceConstruct", ["cast"], ["image"]))
        image = helper.make_tensor_sequence_value_info("image", made, SIZE)
    inputs = [helper.make_tensor_value_info(*given) for given in (("primal", kind, SIZE),)]
    inputs.append(helper.make_tensor_value_info("statistics", TensorProto.FLOAT, None))
    graph = helper.make_graph(nodes, "theirs", inputs, [image])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    helper.set_model_props(model, KNOWN | metadata)
    onnx.save(model, path)
    return path


@pytest.mark.parametrize("kind", [TensorProto.FLOAT, TensorProto.FLOAT16, TensorProto.DOUBLE])
def test_other_floats_are_converted(tmp_path, kind, capsys):
    path, stack = network(tmp_path / "a.onnx", kind, kind), full_stack(12, 16)
    image = Network(path).reconstruct({"primal": stack["primal"]})
    assert image.dtype == np.float32 and np.allclose(image, 2 * stack["primal"], rtol=2e-3)
    assert main(["info", str(path)]) == 0
    ngpt.write(tmp_path / "s.exr", stack)
    line = ["denoise", str(tmp_path / "s.exr"), "-m", "ngpt", "--weights", str(path), "-o", str(tmp_path / "o.exr")]
    assert main(line) == 0


@pytest.mark.parametrize("place", ["input", "output"])
@pytest.mark.parametrize("kind", [TensorProto.UINT8, TensorProto.INT32, "sequence"])
def test_whole_numbers_and_sequences_are_refused_by_name(tmp_path, kind, place, capsys):
    path = tmp_path / "a.onnx"
    if kind != "sequence":
        network(path, **{"kind" if place == "input" else "made": kind})
    else:
        network(path, sequence=True)
        if place == "input":
            model = onnx.load(path)
            value = helper.make_tensor_sequence_value_info("more", TensorProto.FLOAT, SIZE)
            model.graph.input.append(value)
            onnx.save(model, path)
    with pytest.raises(NgptError, match=r"a.onnx: its (input|output) '(primal|image|more)' is (tensor|seq)\(.*one of"):
        Network(path)
    ngpt.write(tmp_path / "s.exr", full_stack(12, 16))
    capsys.readouterr()
    for line in (["info", str(path)], ["denoise", str(tmp_path / "s.exr"), "-m", "ngpt", "--weights", str(path)]):
        assert main(line) == 1
        errors = capsys.readouterr().err
        assert errors.count("\n") == 1 and "export it anew" in errors


def test_a_network_of_frames_without_its_metadata_is_refused_by_name(tmp_path):
    from ngpt.network.describe import FRAMES
    from ngpt.sequence.network import INPUTS
    from ngpt.sequence.network import Network as OfFrames

    path = network(tmp_path / "a.onnx", **{FRAMES: ", ".join(INPUTS), "ngpt.alignment": "much"})
    with pytest.raises(NgptError, match=r"a.onnx: its metadata .* no whole number"):
        OfFrames(path)


EVIL = "x\x1b]0;title\x07\x1b[2J\rgood\u202eneddih"


def test_control_sequences_of_files_are_printed_escaped(tmp_path, capsys):
    path = network(tmp_path / "a.onnx", **{"ngpt.method": EVIL, "ngpt.precision": EVIL, "ngpt.version": EVIL})
    assert main(["info", str(path)]) == 0
    shown = [capsys.readouterr().out]
    stack = full_stack(12, 16)
    stack.attributes |= {"owner": EVIL, f"name{EVIL}": "a"}
    ngpt.write(tmp_path / "s.exr", ngpt.io.exr.with_channels(stack, {f"{EVIL}.Y": stack["depth"][..., 0]}))
    assert main(["info", str(tmp_path / "s.exr")]) == 0
    shown.append(capsys.readouterr().out)
    odd = tmp_path / f"{EVIL}.exr"
    odd.write_bytes((tmp_path / "s.exr").read_bytes())
    assert main(["denoise", str(odd), "-m", "l2"]) == 0
    shown.append(capsys.readouterr().err)
    assert main(["report", str(odd), "--ref", str(tmp_path / "s.exr"), "-o", str(tmp_path / "page.html")]) == 0
    shown.append(capsys.readouterr().out)
    odd.write_bytes(b"damaged")
    assert main(["info", str(odd)]) == 1
    shown.append(capsys.readouterr().err)
    for text in shown:
        assert "\\x1b]0;title\\x07" in text and "\\u202e" in text
        assert all(letter == "\n" or letter.isprintable() for letter in text), ascii(text)
