"""The arithmetic of ``bench.seeds``: real over claimed noise."""

import numpy as np
import pytest

from bench.seeds import noise
from ngpt.shared import shared_variance

SEEDS, SHAPE, CELL = 64, (64, 64, 3), 16


def stacks_of(rng, own=0.3, shared=0.1, claimed=1.0):
    """Noise of the pixels and of cells of 16x16 pixels; ``claimed``: what is claimed of the latter's deviation."""

    def cells(deviation):
        noise = deviation * rng.standard_normal((SHAPE[0] // CELL, SHAPE[1] // CELL, 1))
        return np.kron(noise, np.ones((CELL, CELL, 3)))

    stacks = []
    for _ in range(SEEDS):
        sample = cells(claimed * shared)
        primal = 1 + own * rng.standard_normal(SHAPE) + cells(shared)
        stacks.append({"primal": primal, "primal_var": own**2 + shared_variance(sample), "shared": sample})
    return stacks


def test_noise_that_is_as_claimed_by_half_or_not_at_all(rng):
    """All of it; half the deviation, in blocks larger than a cell; and only the white noise."""
    found = noise(stacks_of(rng))
    assert found["deviation"] == pytest.approx(1, abs=0.15)
    for side in ("8", "32"):
        assert found["blocks"][side]["sum"] == pytest.approx(1, abs=0.12)
        assert found["blocks"][side]["median"] == pytest.approx(1, abs=0.12)
    half = noise(stacks_of(rng, own=0.01, claimed=0.5))
    assert half["deviation"] == pytest.approx(2, rel=0.15) and half["blocks"]["32"]["sum"] == pytest.approx(4, rel=0.15)
    stacks = [{"primal": s["primal"], "primal_var": np.full(SHAPE, 0.3**2)} for s in stacks_of(rng)]
    whole = 0.3**2 / (64 * 64), 0.1**2 / 16
    assert noise(stacks)["deviation"] == pytest.approx((sum(whole) / whole[0]) ** 0.5, rel=0.2)
    silent = noise([{"primal": np.ones(SHAPE), "primal_var": np.zeros(SHAPE)}] * 2)
    assert silent == {"deviation": None, "blocks": {"8": {}, "32": {}}}
