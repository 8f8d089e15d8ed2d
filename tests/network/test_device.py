"""How precisely networks are computed on which device."""

import pytest
import torch

from ngpt.network.device import body_precision


@pytest.mark.parametrize(
    ("capability", "precision", "computed"),
    [
        ("AVX2", "bfloat16", torch.float32),
        ("AVX512", "bfloat16", torch.bfloat16),
        ("DEFAULT", "bfloat16", torch.bfloat16),
        ("AVX512", "float32", torch.float32),
    ],
)
def test_bfloat16_is_left_to_processors_that_have_it(capability, precision, computed, monkeypatch):
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: capability)
    with body_precision("cpu", precision):
        assert torch.nn.Conv2d(1, 1, 1)(torch.zeros(1, 1, 2, 2)).dtype == computed
