"""The table of W and C: by errors that fall by known powers, its numbers are known."""

import pytest

pytest.importorskip("mitsuba")


def row(sampler, method, at_one, power, seconds, choosing=0.0):
    pilot = {"sampler": sampler, "method": method, "choosing": choosing}
    return {"pilot": pilot, "errors": {str(n): at_one * n**power for n in (16, 64, 256)}, "seconds": seconds}


def test_worth_of_errors_that_are_powers_of_the_samples():
    from bench.worth import worth

    rows = [
        row("gpt", "wcv", 1.0, -1.0, 0.3),
        row("gpt", "l1", 0.1, -1.0, 0.3),  # in no column
        row("gpt", "wcv", 0.1, -1.0, 0.3, choosing=0.1),  # shared out
        row("primal", "oidn", 2.0, -1.0, 0.1),
        # Fewer samples for that error, but more time
        row("bdpt", "oidn", 1.5, -1.0, 0.2),
    ]
    found = worth({"rows": rows})
    assert [(r["sampler"], r["method"], r["spp"]) for r in found] == [("gpt", "wcv", n) for n in (16, 64, 256)]
    for r, mark in zip(found, ("", "", "~"), strict=True):
        assert r["W"] == pytest.approx(2) and r["C"] == pytest.approx(3) and r["mark"] == mark


def test_without_rivals_there_is_no_worth():
    from bench.worth import worth

    assert worth({"rows": [row("gpt", "wcv", 1.0, -1.0, 0.3)]}) == []
