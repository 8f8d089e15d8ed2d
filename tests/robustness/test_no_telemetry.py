"""What SECURITY.md promises: nothing is kept in a user's home, and nothing sent, by the libraries that we load."""

import sys

import pytest
from processes import left_in_home

pytest.importorskip("onnxruntime")

DENOISE = """
import numpy as np
import ngpt
from ngpt.stack import GradientStack

image = np.random.default_rng(0).random((16, 24, 3), np.float32)
layers = {name: image for name in ("primal", "dx", "dy", "albedo", "normal")} | {"depth": image[..., :1]}
ngpt.reconstruct(GradientStack(layers), "ngpt-fast")
"""
LOAD = "import onnxruntime"


def test_denoising_leaves_nothing_in_a_home(tmp_path):
    assert left_in_home(tmp_path, sys.executable, "-c", DENOISE) == []


def test_the_library_alone_would_leave_something(tmp_path):
    """Else the test above could not fail."""
    if left_in_home(tmp_path / "off", sys.executable, "-c", LOAD, ORT_DISABLE_TELEMETRY="1"):
        pytest.fail("ORT_DISABLE_TELEMETRY=1 does not turn this version's telemetry off")
    if not left_in_home(tmp_path / "on", sys.executable, "-c", LOAD):
        pytest.skip("this build of ONNX Runtime sends no telemetry")
