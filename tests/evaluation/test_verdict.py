"""The rule by which ``bench.panel`` says that a number is worse, on numbers that nobody rendered."""

import numpy as np
import pytest

from bench import verdict
from ngpt.errors import NgptError

SCENES = ("room", "fog", "glass", "sky", *(f"scene{i}" for i in range(12)))
SPP, PIPELINES = (4, 16, 64), ("auto+auto", "primal+oidn")


def panel(seeds: int, noise: float, salt: int = 0) -> list[dict]:
    """Cells whose values fall with the samples, each seed's off by ``noise`` (of the logarithm)."""
    rng = np.random.default_rng(salt)
    return [
        {"scene": scene, "spp": spp, "pipeline": pipeline}
        | {
            value: {str(seed): float(size / spp * np.exp(rng.normal(0, noise))) for seed in range(1, 1 + seeds)}
            for value, size in (("error", 0.5), ("FLIP", 0.3))
        }
        for scene in SCENES
        for spp in SPP
        for pipeline in PIPELINES
    ]


def worsened(cells: list[dict], value: str, factor: float, **where: object) -> list[dict]:
    """Copies, with the value of those cells ``where`` names times ``factor``."""
    return [
        cell | {value: {seed: number * factor for seed, number in cell[value].items()}}
        if where.items() <= cell.items()
        else cell
        for cell in cells
    ]


def worse(cells: list[dict], before: list[dict]) -> set[tuple]:
    return {(each.value, *each.key) for each in verdict.compare(cells, before) if each.worse}


@pytest.mark.parametrize("noise", [0.02, 0.1, 0.3])
def test_noise_passes(noise):
    # Of other samples, one seed against three: 20 panels of 268 ratios, of which chance would fail one in 740.
    failed = [worse(panel(1, noise, 1000 + i), panel(3, noise, i)) for i in range(20)]
    assert sum(map(len, failed)) <= 20 * 268 / 740


@pytest.mark.parametrize(("value", "above", "below"), [("error", 1.15, 1.08), ("FLIP", 1.08, 1.04)])
def test_a_cell_fails_above_the_limit(value, above, below):
    before = panel(3, 0.001)
    assert not worse(worsened(before, value, below), before)
    spoilt = worsened(before, value, above, scene="glass", spp=4, pipeline="primal+oidn")
    assert worse(spoilt, before) == {(value, "glass", "4", "primal+oidn")}


def test_what_noise_hides_in_a_cell_fails_in_the_means():
    before = panel(3, 0.15)
    found = worse(worsened(before, "error", 1.2, pipeline="auto+auto"), before)
    assert {("error", verdict.MEAN, str(spp), "auto+auto") for spp in SPP} <= found
    assert all(verdict.MEAN in place for place in found)


def test_seeds_that_agree_by_chance_do_not_make_a_cell_quiet():
    before = panel(3, 0.1)
    place = {"scene": "sky", "spp": 16, "pipeline": "auto+auto"}
    agreed = [
        cell | {"error": dict.fromkeys(cell["error"], 0.03)} if place.items() <= cell.items() else cell
        for cell in before
    ]
    assert verdict.spreads(agreed, "error")["sky", "16", "auto+auto"] > 0.05
    assert not worse(worsened(agreed, "error", 1.15, **place), agreed)


def test_numbers_that_cannot_be_compared_are_refused():
    before = panel(3, 0.05)
    with pytest.raises(NgptError, match=r"1 cells, such as fog, 16, auto[+]auto, are not in the numbers in git"):
        removed = [c for c in before if (c["scene"], c["spp"], c["pipeline"]) != ("fog", 16, "auto+auto")]
        verdict.compare(before, removed)
    with pytest.raises(NgptError, match="are not in this run"):
        verdict.compare([cell for cell in before if cell["pipeline"] != "auto+auto"], before)
    with pytest.raises(NgptError, match="2 seeds in the numbers in git do not tell its noise"):
        verdict.compare(before, panel(2, 0.05))
    # Scenes that were not measured are not missed.
    assert verdict.compare([cell for cell in before if cell["scene"] == "fog"], before)


def test_further_seeds_join_their_cells():
    before = panel(3, 0.05)
    first, others = (
        [cell | {v: {seed: cell[v][seed] for seed in seeds} for v in verdict.LIMITS} for cell in before]
        for seeds in ("1", "23")
    )
    fog = [cell["scene"] == "fog" for cell in before]
    expected = [whole if further else one for whole, one, further in zip(before, first, fog, strict=True)]
    assert verdict.joined(first, [cell for cell, further in zip(others, fog, strict=True) if further]) == expected
