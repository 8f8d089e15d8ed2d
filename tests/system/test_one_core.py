"""A machine of one core: Dr.Jit has a single thread there, with which some scenes of many meshes load for ever."""

import os
import subprocess
import sys

import pytest

pytest.importorskip("mitsuba")

ALONE = """
import os
os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
from data_gen.backend import use_variant
use_variant()
import drjit as dr
print(dr.thread_count())
"""


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="this system lets no process choose its cores")
def test_there_are_two_threads_on_one_core():
    done = subprocess.run([sys.executable, "-c", ALONE], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) >= 2


LIMITED = """
import os, sys
from ngpt.cli import main
assert main(["render", sys.argv[1], "--size", "16x12", "--spp", "2", "--threads", "1", "-o", sys.argv[2], "-q"]) == 0
import drjit as dr
from ngpt.system.limits import processors
print(dr.thread_count(), processors())
"""


def test_a_limit_of_threads_holds_for_a_render_and_its_image(renderer, tmp_path):
    """Though a scene is loaded by two: with one, some never are."""
    done = subprocess.run(
        [sys.executable, "-c", LIMITED, "glossy", str(tmp_path / "it.png")], capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["1", "1"]
