"""ONNX files of elsewhere: other types are converted or refused by name, and texts in them are printed escaped."""

import numpy as np
import pytest
from full_stack import full_stack

import ngpt
from ngpt.cli import main
from ngpt.errors import NgptError
from ngpt.network.run_onnx import Network

onnx = pytest.importorskip("onnx")

KNOWN = {"ngpt.inputs": "primal", "ngpt.alignment": "1", "ngpt.base": "", "ngpt.overlap": "0"}
KNOWN |= {"ngpt.bytes per pixel": "64", "ngpt.method": "theirs"}
SEQUENCE = "seq(float[n,3,h,w])"
# Number in ONNX of a type of elements
NUMBERS = {"float": 1, "uint8": 2, "int32": 6, "float16": 10, "double": 11}


def network(path, kind="float", made="float", **metadata):
    """A file whose image is twice the primal, of an input of one type and an output of another."""
    given = f"float[n,3,h,w] primal, {kind} more" if kind == SEQUENCE else f"{kind}[n,3,h,w] primal"
    result = f"{made}[n,3,h,w]" if made in NUMBERS else made
    last = f"Cast<to={NUMBERS[made]}>(twice)" if made in NUMBERS else "SequenceConstruct(twice)"
    model = onnx.parser.parse_model(f"""<ir_version: 9, opset_import: ["": 17]>
        theirs ({given}, float[5] statistics) => ({result} image) {{
            single = Cast<to=1>(primal)  twice = Add(single, single)  image = {last}
        }}""")
    onnx.helper.set_model_props(model, KNOWN | metadata)
    onnx.save(model, path)
    return path


@pytest.mark.parametrize("kind", ["float", "float16", "double"])
def test_other_floats_are_converted(tmp_path, kind):
    path, stack = network(tmp_path / "a.onnx", kind, kind), full_stack(12, 16)
    image = Network(path).reconstruct({"primal": stack["primal"]})
    assert image.dtype == np.float32 and np.allclose(image, 2 * stack["primal"], rtol=2e-3)
    assert main(["info", str(path)]) == 0
    ngpt.write(tmp_path / "s.exr", stack)
    line = ["denoise", str(tmp_path / "s.exr"), "-m", "ngpt", "--weights", str(path), "-o", str(tmp_path / "o.exr")]
    assert main(line) == 0


@pytest.mark.parametrize("place", ["kind", "made"])
@pytest.mark.parametrize("kind", ["uint8", "int32", SEQUENCE])
def test_whole_numbers_and_sequences_are_refused_by_name(tmp_path, kind, place, capsys):
    path = network(tmp_path / "a.onnx", **{place: kind})
    with pytest.raises(NgptError, match=r"a.onnx: its (input|output) '(primal|image|more)' is (tensor|seq)\(.*one of"):
        Network(path)
    ngpt.write(tmp_path / "s.exr", full_stack(12, 16))
    capsys.readouterr()
    for line in (["info", str(path)], ["denoise", str(tmp_path / "s.exr"), "-m", "ngpt", "--weights", str(path)]):
        assert main(line) == 1
        errors = capsys.readouterr().err
        assert errors.count("\n") == 1 and "export it anew" in errors


EVIL = "x\x1b]0;title\x07\x1b[2J\rgood\u202eneddih"


def test_control_sequences_of_files_are_printed_escaped(tmp_path, capsys):
    network(tmp_path / "a.onnx", **{"ngpt.method": EVIL, "ngpt.precision": EVIL, "ngpt.version": EVIL})
    stack = full_stack(12, 16)
    stack.attributes |= {"owner": EVIL, f"name{EVIL}": "a"}
    stack = ngpt.io.exr.with_channels(stack, {f"{EVIL}.Y": stack["depth"][..., 0]})
    ngpt.write(tmp_path / "s.exr", stack)
    (tmp_path / f"{EVIL}.exr").write_bytes((tmp_path / "s.exr").read_bytes())
    (tmp_path / f"{EVIL}2.exr").write_bytes(b"damaged")
    shown, page = [], str(tmp_path / "page.html")
    for status, line in (
        (0, ["info", "a.onnx"]),
        (0, ["info", "s.exr"]),
        (0, ["denoise", f"{EVIL}.exr", "-m", "l2"]),
        (0, ["report", f"{EVIL}.exr", "--ref", str(tmp_path / "s.exr"), "-o", page]),
        (1, ["info", f"{EVIL}2.exr"]),
    ):
        assert main([line[0], str(tmp_path / line[1]), *line[2:]]) == status
        shown.append("".join(capsys.readouterr()))
    for text in shown:
        assert "\\x1b]0;title\\x07" in text and "\\u202e" in text
        assert all(letter == "\n" or letter.isprintable() for letter in text), ascii(text)
