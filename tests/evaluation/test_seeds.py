"""The arithmetic of ``bench.seeds``: real over claimed noise, and its table."""

import numpy as np
import pytest

from bench.seeds import HEAD, errors, noise, rows, spread
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


def cell(spp, tails, seconds, error, worst=None):
    place = {"scene": "room", "size": "8x8", "spp": spp, "tails": tails, "seeds": 4}
    values = {"light": spread([0.5, 1.0, 1.2]), "deviation": None, "blocks": {"8": {"sum": 1, "median": 2}, "32": {}}}
    return place | values | {"seconds": seconds, "error": errors([error, error, worst or error])}


def test_errors_are_over_those_of_whole_paths_at_the_same_time():
    """Whole paths have an error of 1 / seconds."""
    cells = [cell(4, "paths", 4.0, 1 / 4), cell(16, "paths", 16.0, 1 / 16), cell(4, "shared", 8.0, 1 / 16, 1.0)]
    found = {line[2]: dict(zip(HEAD, line, strict=True)) for line in rows(cells) if line[1] == "4"}
    mean = (1 / 16) ** (2 / 3)
    assert found["shared"]["error at equal time"] == f"{mean * 8:.2f}" and found["paths"]["error at equal time"] == "-"
    assert found["shared"]["worst / median"] == "16.00" and found["shared"]["8x8, median"] == "1, 2"
    assert found["shared"]["least .. most"] == "0.500 .. 1.200" and found["shared"]["light"] == "0.9000"
    assert rows(cells[1:])[-1][-1] == "-"
