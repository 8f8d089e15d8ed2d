"""How far tiles overlap: by what makes a difference, which is measured, and never by more than a network can see."""

import numpy as np
import pytest
import torch
from full_stack import full_layers
from networks import plain

from ngpt.export import reach as module
from ngpt.export.reach import reach
from ngpt.network.model import Reconstructor
from ngpt.network.run_onnx import Network
from ngpt.network.shipped import WEIGHTS

COMBINE = WEIGHTS / "ngpt-combine.onnx"


def test_a_network_that_looks_far_gets_what_it_looks_at(monkeypatch):
    """Its coarsest pixels, 32 wide, are given all the weight."""
    torch.manual_seed(0)
    model = Reconstructor(plain(("primal",), channels=(4,) * 6)).eval()
    monkeypatch.setattr(module, "EXAMPLES", 1)
    weak = reach(model)
    with torch.no_grad():
        for name, parameter in model.named_parameters():
            if name.endswith("bias"):
                parameter.zero_()
            elif parameter.ndim == 4:
                # A sum over all that it sees, at each level.
                parameter.fill_(1 / parameter[0].numel())
    strong = reach(model)
    assert 0 < weak <= strong <= -(-model.radius // model.alignment) * model.alignment
    assert strong > model.radius / 2


@pytest.mark.slow
def test_tiles_do_not_show_where_they_overlap_by_less():
    """With lights a hundredfold as bright, and by a third of that overlap they do."""
    network = Network(COMBINE)
    rng = np.random.default_rng(1)
    layers = full_layers(230, 410)
    layers["primal"] *= np.where(rng.random((230, 410, 1)) < 0.01, np.float32(100), np.float32(1))
    base = layers["primal"] * 0.9
    layers |= {made: base * rng.gamma(4, 0.25, base.shape).astype(np.float32) for made in ("denoised", "denoised_base")}
    layers |= {f"oidn_{made}": layers[made.replace("base", "denoised_base")] for made in ("primal", "base")}
    base = base if network.base else None
    whole = network.reconstruct(layers, base)

    def difference():
        side = 2 * network.overlap + 4 * network.alignment
        memory = -(-(side**2) * network.bytes // 2**20)
        assert len(network.plan(230, 410, memory)[0]) > 4
        tiled = network.reconstruct(layers, base, memory=memory)
        return np.abs(tiled - whole).max() / whole.max()

    assert difference() <= 1e-6
    network.overlap = network.overlap // 3 // network.alignment * network.alignment
    assert difference() > 1e-5
