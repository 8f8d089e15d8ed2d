"""What SECURITY.md promises: nothing is kept in a user's home, and nothing sent, by the libraries that we load."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

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


def left_in_home(home: Path, code: str, **environment: str) -> list[str]:
    """The files in a fresh home after a program has ended."""
    known = {name: value for name, value in os.environ.items() if name != "ORT_DISABLE_TELEMETRY"}
    known |= {"HOME": str(home), "USERPROFILE": str(home), "XDG_CACHE_HOME": str(home / ".cache")}
    subprocess.run([sys.executable, "-c", code], env=known | environment, check=True, timeout=300)
    return sorted(str(file.relative_to(home)) for file in home.rglob("*") if file.is_file())


def test_denoising_leaves_nothing_in_a_home(tmp_path):
    assert left_in_home(tmp_path, DENOISE) == []


def test_the_library_alone_would_leave_something(tmp_path):
    """Else the test above could not fail."""
    if left_in_home(tmp_path / "off", LOAD, ORT_DISABLE_TELEMETRY="1"):
        pytest.fail("ORT_DISABLE_TELEMETRY=1 does not turn this version's telemetry off")
    if not left_in_home(tmp_path / "on", LOAD):
        pytest.skip("this build of ONNX Runtime sends no telemetry")
