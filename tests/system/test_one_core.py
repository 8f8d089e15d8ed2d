"""A machine of one core: Dr.Jit has a single thread there, with which some scenes of many meshes load for ever."""

import os
import sys

import pytest
from processes import complete

ALONE = """
import os
os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
from data_gen.backend import use_variant
use_variant()
import drjit as dr
print(dr.thread_count())
"""
LIMITED = """
import sys
from ngpt.cli import main
assert main(["render", "glossy", "--size", "16x12", "--spp", "2", "--threads", "1", "-o", sys.argv[1], "-q"]) == 0
import drjit as dr
from ngpt.system.limits import processors
print(dr.thread_count(), processors())
"""


def said(code, *arguments):
    done = complete([sys.executable, "-c", code, *arguments])
    assert done.returncode == 0, done.stderr
    return [int(word) for word in done.stdout.split()]


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="this system lets no process choose its cores")
def test_there_are_two_threads_on_one_core(renderer):
    assert said(ALONE)[0] >= 2


def test_a_limit_of_threads_holds_for_a_render_and_its_image(renderer, tmp_path):
    """Though a scene is loaded by two: with one, some never are."""
    assert said(LIMITED, tmp_path / "it.png") == [1, 1]
