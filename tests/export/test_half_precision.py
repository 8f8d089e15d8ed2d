"""Weights in 16 bits: what they hold, what is refused, and that what reads them computes in 32."""

import json
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("onnxscript")
torch = pytest.importorskip("torch")

# ruff: noqa: E402
from full_stack import full_stack
from networks import plain, untrained

import ngpt
from ngpt.cli import main
from ngpt.export.weights import POINTS
from ngpt.network.safetensors import load_weights, read_tensors, save_weights, write_tensors
from ngpt.sequence.network import INPUTS
from ngpt.training.temporal import WIDTHS, network

CONFIG = plain(("primal", "base", "primal_se", "dx_se"), "wcv", start=("primal", "base"), channels=(4, 4))
STEPS = 1000


def export(weights, output):
    return main(["export", "--weights", str(weights), "-o", str(output)])


@pytest.fixture
def run(tmp_path):
    """The weights of a run, after so many steps of those that its log tells of."""
    save_weights(tmp_path / "weights.safetensors", untrained(CONFIG), {"step": STEPS, "hours": 2})
    entries = [{"step": n, "loss": 1 / n} for n in range(1, 2 * STEPS)] + [{"step": 2 * STEPS, "relMSE": 0.1}]
    (tmp_path / "log.jsonl").write_text("".join(f"{json.dumps(entry)}\n" for entry in entries))
    return tmp_path / "weights.safetensors"


def test_half_the_bytes_the_same_model_and_the_curve_until_its_step(run, tmp_path):
    assert export(run, tmp_path / "half.safetensors") == 0
    tensors, header = read_tensors(tmp_path / "half.safetensors")
    own, told = read_tensors(run)
    assert tensors.keys() == own.keys() and all(tensor.dtype == torch.float16 for tensor in tensors.values())
    assert all(torch.equal(tensors[name], tensor.half()) for name, tensor in own.items())
    curve = header.pop("curve")
    assert header == told
    steps, losses = curve["steps"], curve["losses"]
    assert len(steps) == len(losses) == POINTS and steps[-1] == STEPS and steps == sorted(set(steps))
    # The mean of the losses of steps 1 to 10, then the next.
    assert losses[0] == pytest.approx(np.mean(1 / np.arange(1, 11)), rel=1e-3) and losses[0] > losses[1]


def test_the_mean_of_several_files_counts_a_file_as_often_as_it_is_named(run, tmp_path, capsys):
    other = untrained(CONFIG)
    with torch.no_grad():
        for parameter in other.parameters():
            parameter.mul_(3).add_(0.5)
    save_weights(tmp_path / "tuned.safetensors", other, {"step": 7})
    files = [run, run, tmp_path / "tuned.safetensors"]
    output = tmp_path / "mean.safetensors"
    assert main(["export", "--weights", *map(str, files), "-o", str(output)]) == 0
    tensors, header = read_tensors(output)
    first, tuned = read_tensors(run)[0], read_tensors(files[2])[0]
    for name, tensor in tensors.items():
        np.testing.assert_allclose(tensor, (2 * first[name] + tuned[name]) / 3, rtol=1e-3, atol=1e-6)
    assert [record["step"] for record in header["training"]["mean of"]] == [STEPS, STEPS, 7]
    assert header["training"]["step"] == STEPS and "curve" not in header
    # What reads them computes in 32 bits.
    graph, (model, _) = tmp_path / "mean.onnx", load_weights(output)
    assert model.config == CONFIG and {parameter.dtype for parameter in model.parameters()} == {torch.float32}
    assert export(output, graph) == 0
    ours, by_onnx = (ngpt.denoise(full_stack(20, 26), "ngpt", weights=str(path)) for path in (output, graph))
    assert ours.dtype == np.float32
    np.testing.assert_allclose(by_onnx, ours, rtol=1e-4, atol=1e-5 * ours.max())
    capsys.readouterr()
    assert main(["info", str(graph)]) == 0
    assert "3 files" in capsys.readouterr().out


def test_means_of_networks_that_differ_are_refused(run, tmp_path, capsys):
    wider = plain(("primal", "base", "primal_se", "dx_se"), "wcv", start=("primal", "base"), channels=(4, 8))
    save_weights(tmp_path / "wider.safetensors", untrained(wider), {})
    two = ["export", "--weights", str(run), str(tmp_path / "wider.safetensors"), "-o"]
    assert main([*two, str(tmp_path / "mean.safetensors")]) == 1
    assert "wider.safetensors: its network differs" in capsys.readouterr().err
    header = {"kind": "temporal", "inputs": list(INPUTS), "widths": list(WIDTHS), "training": {}}
    write_tensors(tmp_path / "t.safetensors", network().state_dict(), header)
    blends = ["export", "--weights", *[str(tmp_path / "t.safetensors")] * 2, "-o", str(tmp_path / "mean.safetensors")]
    assert main(blends) == 1 and "holds a temporal, not weights" in capsys.readouterr().err
    assert main([*two, str(tmp_path / "mean.onnx")]) == 2
    assert "is written to a .safetensors file" in capsys.readouterr().err
    assert not list(tmp_path.glob("mean.*"))


@pytest.mark.parametrize(
    ("change", "message"),
    [(lambda v: v[0, 0].fill_(1e6), "beyond 65504"), (lambda v: v[1].mul_(1e-6), "too small for 16 bits")],
)
def test_numbers_that_16_bits_cannot_hold_are_refused(tmp_path, capsys, change, message):
    model = untrained(CONFIG)
    change(next(tensor for tensor in model.state_dict().values() if tensor.ndim > 1))
    save_weights(tmp_path / "w.safetensors", model, {})
    assert export(tmp_path / "w.safetensors", tmp_path / "half.safetensors") == 1
    said = capsys.readouterr().err
    assert message in said and "w.safetensors" in said and not (tmp_path / "half.safetensors").exists()


@pytest.mark.parametrize("path", sorted((Path(__file__).parents[2] / "export" / "weights").glob("*.safetensors")))
def test_the_repository_keeps_weights_in_16_bits(path):
    assert {tensor.dtype for tensor in read_tensors(path)[0].values()} == {torch.float16}
