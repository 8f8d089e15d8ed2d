"""Little memory: tiles shrink, and where nothing can be done one line says so; in long runs it stays what it was."""

import os
from pathlib import Path

import numpy as np
import pytest
from full_stack import full_layers

from ngpt.errors import NgptError
from ngpt.network import run_onnx
from ngpt.network.run_onnx import Network
from ngpt.network.shipped import WEIGHTS

FAST = WEIGHTS / "ngpt-fast.onnx"


def test_tiles_shrink_until_they_fit(monkeypatch):
    """With a machine that has less to give than it seems."""
    network = Network(FAST)
    layers = full_layers(64, 448)
    layers["base"] = layers["primal"]
    whole = network.reconstruct(layers)
    run, sizes = network._run, []

    def poor(session, feed, last):
        width = feed["primal"].shape[-1]
        sizes.append(width)
        if width > 300:
            raise run_onnx._OutOfMemory("no")
        return run(session, feed, last)

    monkeypatch.setattr(network, "_run", poor)
    tiled = network.reconstruct(layers)
    assert np.abs(tiled - whole).max() <= 1e-5 * whole.max()
    assert sizes[0] == 448 and sizes[-1] <= 300
    monkeypatch.setattr(network, "_run", lambda *_: (_ for _ in ()).throw(run_onnx._OutOfMemory("no")))
    with pytest.raises(NgptError, match="no"):
        network.reconstruct(layers)


@pytest.mark.skipif(not Path("/proc/self/statm").is_file(), reason="only Linux says what a process holds")
def test_a_large_image_leaves_no_memory_behind():
    """ONNX Runtime would keep 350 MiB of it until the process ends."""

    def held():
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20

    network = Network(FAST)
    small, large = ({**layers, "base": layers["primal"]} for layers in (full_layers(64, 64), full_layers(384, 512)))
    network.reconstruct(small)
    before = held()
    network.reconstruct(large)
    assert held() - before < 150


def test_a_failed_allocation_is_out_of_memory():
    class Session:
        def run(self, *_):
            raise RuntimeError("bfc_arena.cc: Failed to allocate memory for requested buffer of size 3075072")

    with pytest.raises(run_onnx._OutOfMemory, match="out of memory with the smallest tiles"):
        Network(FAST)._run(Session(), {}, last=True)
