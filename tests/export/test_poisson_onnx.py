"""The ONNX graph of l2 against ngpt's own solver, in ONNX Runtime."""

from functools import cache

import numpy as np
import pytest

from ngpt.classical.poisson import l2

pytest.importorskip("onnx")
ort = pytest.importorskip("onnxruntime")

# ruff: noqa: E402
from export.__main__ import main
from ngpt.export.poisson import l2_model


@cache
def session(alpha):
    return ort.InferenceSession(l2_model(alpha).SerializeToString(), providers=["CPUExecutionProvider"])


@pytest.mark.parametrize("alpha", [0.02, 0.2, 3.0])
@pytest.mark.parametrize("shape", [(16, 16), (37, 53), (1, 8), (7, 1), (1, 1), (270, 480)])
def test_one_file_for_every_size(rng, alpha, shape):
    layers = rng.random((3, *shape, 3)).astype(np.float32)
    layers[1:, :, -1], layers[1:, -1] = 9.0, 9.0  # unused by contract
    given = {name: layer.transpose(2, 0, 1)[None] for name, layer in zip(("primal", "dx", "dy"), layers, strict=True)}
    image = session(alpha).run(["image"], given)[0][0].transpose(1, 2, 0)
    expected = l2(*layers, alpha)
    # At small alpha random gradients add up to images of several hundred.
    assert np.abs(image - expected).max() < 1e-5 * max(1, np.abs(expected).max())


def test_command(tmp_path, capfd):
    target = tmp_path / "l2.onnx"
    assert main(["-o", str(target)]) == 0
    metadata = ort.InferenceSession(target, providers=["CPUExecutionProvider"]).get_modelmeta().custom_metadata_map
    assert metadata["ngpt.method"] == "l2" and float(metadata["ngpt.alpha"]) == 0.2
    assert main(["-o", str(target)]) == 1
    assert main(["-o", str(tmp_path / "b.onnx"), "--alpha", "-1"]) == 2
    assert "alpha -1.0: must be a positive number" in capfd.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["l2.onnx"]
