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
