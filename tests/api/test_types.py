"""The public functions say in types what comes back: what a checker finds of a program that uses them."""

import subprocess
import sys

import pytest

PROGRAM = """
import numpy as np
import ngpt

image = np.zeros((3, 4, 3), np.float32)
stack = ngpt.GradientStack.from_arrays(primal=image)
reveal_type(ngpt.denoise(image, albedo=image))
reveal_type(ngpt.denoise(stack, "l2", alpha=0.3))
reveal_type(ngpt.Denoiser((3, 4), albedo=True)(image, image))
ngpt.denoise(3)
ngpt.denoise(image, albedo="a file")
"""


@pytest.mark.slow
def test_a_checker_knows_what_comes_back(tmp_path):
    """Half a minute without a cache."""
    pytest.importorskip("mypy")
    (tmp_path / "program.py").write_text(PROGRAM)
    command = [sys.executable, "-m", "mypy", "--follow-imports=silent", str(tmp_path / "program.py")]
    told = subprocess.run(command, capture_output=True, text=True, check=False).stdout.splitlines()
    revealed = [line for line in told if "Revealed type" in line]
    assert len(revealed) == 3 and all("ndarray" in line for line in revealed)
    assert len([line for line in told if 'No overload variant of "denoise"' in line]) == 2
