"""Results say what made them, and files of networks and training runs say what they are."""

import json
import shutil
import struct

import numpy as np
import pytest
from full_stack import full_stack

import ngpt
from ngpt.io.results import MADE_BY
from ngpt.network.shipped import WEIGHTS

FAST = WEIGHTS / "ngpt-fast.onnx"


@pytest.fixture
def stack(tmp_path):
    stack = full_stack(20, 24)
    stack.attributes["ngpt:sampler"] = "gpt"
    return ngpt.read(ngpt.write(tmp_path / "s.exr", stack))


@pytest.fixture
def own(tmp_path):
    """A network that computes what ours does, in another file that calls itself by our name."""
    path = tmp_path / "ngpt-fast"
    # One more field of protobuf: 14, the list of metadata, an entry without key and value.
    path.write_bytes(FAST.read_bytes() + b"\x72\x00")
    return path


def attributes(path):
    return ngpt.read(path).attributes


def test_a_result_says_what_made_it_and_no_more(stack, tmp_path):
    first = ngpt.reconstruct(stack, "ngpt-fast", memory=1000)
    again = ngpt.read(ngpt.write(tmp_path / "1.exr", first.image, like=stack, attributes=first.attributes))
    told = again.attributes
    assert told["ngpt:weights"].startswith("ngpt-fast.onnx sha256:") and told["ngpt:options"] == "memory=1000"
    assert told["ngpt:reconstructSeconds"] == pytest.approx(first.seconds) and told["ngpt:version"]
    second = ngpt.reconstruct(again, "l2")
    told = attributes(ngpt.write(tmp_path / "2.exr", second.image, like=again, attributes=second.attributes))
    assert told["ngpt:method"] == "l2" and not {"ngpt:weights", "ngpt:options"} & told.keys()
    # Of an image that came from elsewhere nobody knows.
    told = attributes(ngpt.write(tmp_path / "3.exr", second.image, like=again))
    assert not set(MADE_BY) & told.keys() and told["ngpt:sampler"] == "gpt" and "ngpt:method" in again.attributes


def test_our_network_is_known_wherever_it_lies(stack, tmp_path):
    result = ngpt.reconstruct(stack, weights=str(shutil.copy(FAST, tmp_path / "copy.onnx")))
    assert result.method == "ngpt-fast" and result.weights.file == "copy.onnx"
    assert result.weights.sha256 == ngpt.reconstruct(stack, "ngpt-fast").weights.sha256


@pytest.mark.parametrize("method", ["auto", "ngpt-fast", "ngpt-combine"])
def test_a_network_of_ones_own_never_goes_by_our_name(method, stack, own, command):
    """Whatever its file is called, whatever it says of itself, and whatever method it stands in for."""
    output, errors = command(f"denoise s.exr -o o.exr -m {method} --weights ngpt-fast --json")
    (report,) = json.loads(output)["files"]
    digest = report["weights"]["sha256"]
    assert report["method"] == "own network ngpt-fast" and report["weights"]["file"] == "ngpt-fast"
    assert f": own network ngpt-fast, sha256 {digest[:12]}, " in errors
    told = attributes("o.exr")
    assert told["ngpt:method"] == report["method"] and told["ngpt:weights"] == f"ngpt-fast sha256:{digest[:12]}"
    assert f"ngpt-fast sha256:{digest[:12]}" in command("info o.exr").out


def test_errors_of_a_network_of_ones_own_name_its_file(stack, own):
    with pytest.raises(ngpt.NgptError, match=rf"weights {own} needs? layers dx"):
        ngpt.reconstruct(ngpt.GradientStack.from_arrays(primal=stack["primal"]), weights=str(own))
    with pytest.raises(ngpt.NgptError, match=rf"(?!.*method 'ngpt).*own network {own} sha256:"):
        ngpt.reconstruct(stack.replace(dx=np.full_like(stack["dx"], 3e38)), weights=str(own))


def test_info_on_networks(own, command):
    report = json.loads(command(f"info {WEIGHTS}/ngpt-combine.onnx --json").out)
    assert "ngpt's own, method ngpt-combine" in report["whose"] and len(report["sha256"]) == 64
    assert "denoised" in report["inputs"] and report["needs packages"] == ["ONNX Runtime", "OIDN"]
    assert "dx_var" in report["needs layers"] and "denoised" not in report["needs layers"]
    assert report["base"] == "wcv" and report["alignment"] == 8 and report["training"]["step"] == 900
    assert report["bytes"] == (WEIGHTS / "ngpt-combine.onnx").stat().st_size
    own.rename(own.with_name("x.onnx"))
    output = command("info x.onnx").out
    assert "whose: not a network that comes with ngpt" in output and "itself as: method 'ngpt-fast'" in output


LOG = (
    '{"step": 50, "loss": 4.0, "seconds": 5}\n{"step": 50, "relMSE": 0.1, "relMSE primal": 0.5}\n'
    '{"step": 100, "loss": 2.0, "seconds": 9}\n{"step": 100, "relMSE": 0.2, "relMSE primal": 0.5}\n'
)
HEADER = {"kind": "checkpoint", "step": 90, "seconds": 3600, "settings": {"run": {"steps": 200}}}


def test_info_on_a_training_run(tmp_path, command):
    # The last line is being written.
    for name, log in (("run", LOG + '{"step": 1'), ("new", LOG)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "log.jsonl").write_text(log)
    data = json.dumps({"__metadata__": {"ngpt": json.dumps(HEADER)}}).encode()
    (tmp_path / "run" / "checkpoint.safetensors").write_bytes(struct.pack("<Q", len(data)) + data)
    report = json.loads(command("info run --json").out)
    assert (report["checkpoint at step"], report["logged until step"], report["steps planned"]) == (90, 100, 200)
    assert report["loss"] == {"first": 4.0, "last": 2.0, "mean of 2": 3.0} and report["hours until then"] == 1
    assert report["validations"] == 2 and report["validation"]["best"]["step"] == 50
    assert report["validation"]["last"]["relMSE"] == 0.2
    assert "relMSE 0.1" in command("info new").out


def test_results_that_are_there_count_where_they_are_what_is_asked_for(stack, tmp_path, command):
    line = "denoise s.exr -o out.exr --skip-existing"
    command(f"{line} -m l1")
    made = (tmp_path / "out.exr").read_bytes()
    for same in ("-m l1", "", "-m auto"):
        assert "1 of 1 stacks were skipped" in command(f"{line} {same}").err
    for other, told in (("-m l2", "method l1, not l2"), ("-m l1 --temporal", "temporal none, not asked for")):
        assert f"out.exr: is another result: {told}; " in command(f"{line} {other}", 1).err
    # And the stack may have more samples by now.
    stack.attributes["ngpt:spp"] = 64
    ngpt.write("s.exr", stack, overwrite=True)
    assert "is another result: spp " in command(f"{line} -m l1", 1).err
    assert (tmp_path / "out.exr").read_bytes() == made
    soft = "denoise s.exr -o soft.exr -m l2 --alpha 0.3 --skip-existing"
    command(soft)
    assert "1 of 1 stacks were skipped" in command(soft).err
    assert "options alpha=0.3, not alpha=0.5" in command(f"{soft} --alpha 0.5", 1).err
