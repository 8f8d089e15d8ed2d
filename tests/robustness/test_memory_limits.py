"""Little memory: tiles shrink, and where nothing can be done one line says so; in long runs it stays what it was."""

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

    def poor(session, feed):
        width = feed["primal"].shape[-1]
        sizes.append(width)
        if width > 300:
            raise run_onnx._OutOfMemory("no")
        return run(session, feed)

    monkeypatch.setattr(network, "_run", poor)
    tiled = network.reconstruct(layers)
    assert np.abs(tiled - whole).max() <= 1e-5 * whole.max()
    assert sizes[0] == 448 and sizes[-1] <= 300
    monkeypatch.setattr(network, "_run", lambda *_: (_ for _ in ()).throw(run_onnx._OutOfMemory("no")))
    with pytest.raises(NgptError, match="no"):
        network.reconstruct(layers)


def test_a_failed_allocation_is_out_of_memory():
    class Session:
        def run(self, *_):
            raise RuntimeError("bfc_arena.cc: Failed to allocate memory for requested buffer of size 3075072")

    with pytest.raises(run_onnx._OutOfMemory, match="out of memory with the smallest tiles"):
        Network(FAST)._run(Session(), {})
