"""Little memory: the image or one line within limits of address space, and what ``--memory`` promises."""

import json
import resource
import sys
import time

import numpy as np
import pytest
from full_stack import full_stack
from processes import NGPT, complete, half_written, one_error
from reliability import record

import ngpt
from ngpt.methods import METHODS

pytestmark = [pytest.mark.slow, pytest.mark.skipif(sys.platform != "linux", reason="limits and /proc of Linux")]


@pytest.mark.timeout(3600)
def test_limits_of_address_space(tmp_path):
    """``ngpt denoise`` of 400x300 pixels within each of those limits, MiB."""
    limits = [64, 128, 256, 511, *range(512, 1024, 32), 1200, 1600, 2400]
    clock, source = time.monotonic(), tmp_path / "s.exr"
    ngpt.write(source, full_stack(300, 400))
    arguments = [*NGPT, "denoise", source, "-m", "ngpt-fast", "-o"]
    assert complete([*arguments, tmp_path / "whole.exr"]).returncode == 0
    whole = ngpt.read_image(tmp_path / "whole.exr")
    enough = []
    for mebibytes in limits:
        out, size = tmp_path / f"{mebibytes}.exr", mebibytes << 20
        limit = (resource.RLIMIT_AS, (size, size))
        run = complete([*arguments, out], preexec_fn=lambda limit=limit: resource.setrlimit(*limit))
        if run.returncode == 0:
            assert np.abs(ngpt.read_image(out) - whole).max() <= 1e-5 * whole.max()
            enough.append(mebibytes)
        else:
            assert run.returncode in (1, 2) and one_error(run.stderr), (mebibytes, run.returncode, run.stderr)
            assert len(run.stderr.splitlines()) == 1, run.stderr
            assert half_written(tmp_path) == [] and not out.exists()
    assert 1 <= len(enough) < len(limits)
    record(
        "Limits of address space on ngpt denoise, 400x300",
        len(limits),
        {"the same image": len(enough), "one line": len(limits) - len(enough)},
        worst={"least MiB that gave the image": min(enough)},
        seconds=round(time.monotonic() - clock),
    )


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


@pytest.mark.parametrize("sampler", ["primal", "gpt", "bdpt", "ppm", "vcm"])
def test_renders_stay_within_their_memory(renderer, sampler):
    assert measured(RENDER, sampler, 384, "glossy") <= 384


@pytest.mark.skipif(bool(METHODS["ngpt-combine"].missing()), reason=METHODS["ngpt-combine"].missing())
def test_tiles_of_a_network_stay_within_their_memory():
    assert measured(DENOISE, "ngpt-combine", 100) <= 100 + 300 * 400 * BESIDE / 2**20
