"""The table of ``bench.tails`` that compares the default pipeline to the best one."""

from bench.tails import METHODS, SECONDS, default_over_best


def cell(scene: str, sampler: str, spp: int, error: float, **auto: str) -> dict:
    """One that takes ``spp`` processor seconds in all; its methods have errors of 1, 2, ... times ``error``."""
    methods = {
        name: {"seconds": 0.0, "error": rank * error / spp, "steady": 1.0, "FLIP": 1.0, "blocks": None, "energy": 1.0}
        for rank, name in enumerate(METHODS[sampler], 1)
    }
    place = {"scene": scene, "size": "8x8", "sampler": sampler, "tails": "shared", "spp": spp, "seed": 0}
    return place | {"seconds": float(spp), "methods": methods} | auto


def test_the_default_is_over_the_least_error_of_all_pipelines():
    cells = []
    for spp in (4, 64):
        # The default of the room is the third of primal's methods, that of the yard the third of gpt's.
        cells += [cell("room", "primal", spp, 1.0, auto="ngpt-primal"), cell("room", "gpt", spp, 3.0)]
        cells += [cell("yard", "primal", spp, 9.0), cell("yard", "gpt", spp, 1.0, auto="ngpt-combine")]
    rows = {row[0]: row[1:] for row in default_over_best(cells, "shared", {"both": ["room", "yard", "none"]})}
    # oidn, the second of primal's methods, is best in the room; wcv, the first of gpt's, in the yard.
    assert rows["room"] == ["1.50, 1.00"] * len(SECONDS) and rows["yard"] == ["3.00, 1.00"] * len(SECONDS)
    assert rows["both"] == ["2.12, 1.00"] * len(SECONDS)
