"""A file that POV-Ray wrote: colour alone, in half. It needs the program `povray`."""

import shutil
import subprocess

import numpy as np
import pytest

import ngpt

pytestmark = pytest.mark.slow

SCENE = """
#version 3.7;
global_settings { assumed_gamma 1 }
camera { location <0, 1.5, -4> look_at <0, 1, 0> }
light_source { <2, 4, -3> rgb 1.2 area_light <2, 0, 0>, <0, 0, 2>, 3, 3 jitter }
plane { y, 0 pigment { checker rgb <0.8, 0.7, 0.5>, rgb 0.2 } }
sphere { <0, 1, 0>, 1 pigment { rgb <0.8, 0.2, 0.1> } finish { reflection 0.2 } }
"""


def test_colour_alone(tmp_path):
    program = shutil.which("povray") or pytest.skip("povray is not installed")
    (tmp_path / "scene.pov").write_text(SCENE)
    command = [program, "+Iscene.pov", "+Oscene.exr", "+FE", "+W96", "+H54", "-D"]
    assert subprocess.run(command, cwd=tmp_path, capture_output=True, timeout=60).returncode == 0
    stack = ngpt.read(tmp_path / "scene.exr")
    assert stack.names == ("primal",) and (stack.width, stack.height) == (96, 54)
    ball = stack["primal"][27, 48]
    assert ball[0] > 2 * ball[1] > 0
    result = ngpt.reconstruct(stack)
    assert result.method != "primal" and np.isfinite(result.image).all()
