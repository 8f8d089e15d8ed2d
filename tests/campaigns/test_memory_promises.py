"""What ``--memory`` promises: the most that a render, or the tiles of a network, have in memory beside all else."""

import json
import sys

import pytest
from processes import complete

# Each in a process of its own: what one frees is not given back to the system, and the next would not be seen to need
# it. Scene, program and kernels are there before the peak is reset.
MEASURE = """
import ctypes, gc, json, sys
def status(name):
    return next(int(line.split()[1]) / 1024 for line in open("/proc/self/status") if line.startswith(name))
def peak(work):
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)
    before = status("VmRSS")
    open("/proc/self/clear_refs", "w").write("5")
    work()
    print(json.dumps(status("VmHWM") - before))
"""

RENDER = """
from data_gen.backend import use_variant
use_variant()
import drjit as dr
from data_gen import passes
from data_gen.render import render_stack
from data_gen.samplers import SAMPLERS
from data_gen.scenes.load import load_scene, set_film_size
# Passes as large as memory allows, not as time does
passes.FIRST_LANES, passes.PASS_SECONDS = 1 << 40, 1e9
name, memory = sys.argv[1], int(sys.argv[2])
batch = SAMPLERS[name].batch
scene = load_scene(sys.argv[3], (16, 16))
render_stack(scene, max(batch, 16), sampler=name)
dr.flush_malloc_cache()
set_film_size(scene, (128, 128))
peak(lambda: render_stack(scene, max(2 * batch, 48), sampler=name, memory=memory))
"""

DENOISE = """
sys.path.insert(0, "tests")
from full_stack import full_stack
from ngpt.methods import reconstruct
stack = full_stack(300, 400)
reconstruct(full_stack(32, 32), sys.argv[1], memory=int(sys.argv[2]))
peak(lambda: reconstruct(stack, sys.argv[1], memory=int(sys.argv[2])))
"""
# Bytes of a pixel beside the tiles: the layers and what is made of them, and OIDN, which has tiles of its own
BESIDE = 260 + 1500


def measured(code, *arguments):
    """MiB at the peak over what there was before."""
    run = complete([sys.executable, "-c", MEASURE + code, *arguments])
    assert run.returncode == 0, run.stderr
    return json.loads(run.stdout.splitlines()[-1])


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize("sampler", ["primal", "gpt", "bdpt", "ppm", "vcm"])
def test_renders_stay_within_their_memory(renderer, sampler):
    assert measured(RENDER, sampler, 384, "glossy") <= 384


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_tiles_of_a_network_stay_within_their_memory():
    from ngpt.methods import METHODS

    if METHODS["ngpt-combine"].missing():
        pytest.skip(METHODS["ngpt-combine"].missing())
    assert measured(DENOISE, "ngpt-combine", 100) <= 100 + 300 * 400 * BESIDE / 2**20
