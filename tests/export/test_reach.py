"""How far tiles overlap: by what makes a difference, which is measured, and never by more than a network can see."""

import torch
from networks import plain

from ngpt.export import reach as module
from ngpt.export.reach import reach
from ngpt.network.model import Reconstructor


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
