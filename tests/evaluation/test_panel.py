"""``bench.panel`` from its numbers to its exit status and tables, on numbers that nobody rendered."""

import json
import sys

import numpy as np
import pytest

from bench import panel, verdict

NAMES = ["haze", "glossy", "product"]
# The error of each pipeline at one sample, in units of its seconds
ERRORS = dict(zip(panel.PIPELINES, (2.0, 1.0, 4.0, 3.0, 1.5, 5.0), strict=True))


def cells(name: str, seeds, factors: dict[str, float] | None = None) -> list[dict]:
    """Errors fall as 1/samples; a sample takes a second, by gpt two."""
    found = []
    for spp in panel.SPP:
        for pipeline, error in ERRORS.items():
            error *= (factors or {}).get(pipeline, 1.0)
            noise = {seed: float(np.exp(np.random.default_rng((spp, seed)).normal(0, 0.02))) for seed in seeds}
            values = {"error": error / spp, "FLIP": 0.1 * error, "seconds": spp * (2.0 if "gpt" in pipeline else 1.0)}
            each = {
                value: {str(s): n * (1 if value == "seconds" else noise[s]) for s in seeds}
                for value, n in values.items()
            }
            found.append({"scene": name, "spp": spp, "pipeline": pipeline} | each)
    return found


def test_the_default_is_over_the_least_of_ours():
    of = {verdict.key_of(cell): cell for cell in cells("haze", [1])}
    # gpt+ngpt-combine is the best at equal samples; after equal time it has half of them, and primal+oidn is best.
    assert panel.over_best(of, "haze", 16, "samples") == [(pytest.approx(2 / 1), ""), (pytest.approx(2 / 1), "")]
    assert panel.over_best(of, "haze", 16, "seconds")[0] == (pytest.approx(2 / 1.5, rel=0.1), "")
    shown = panel.text([cell for name in NAMES for cell in cells(name, [1])])
    lines = shown.splitlines()
    assert any(line.startswith("| haze (fog) | 16 | 0.12, 0.198 | 0.062, 0.099") for line in lines)
    # 2 / 5 of the rival at equal seconds, and gpt+ngpt-combine has half of its samples then
    assert "| haze | 16 | 16 | 0.40, 0.40 | 1.00, 2.00 |" in lines
    # At 16 seconds, gpt+ngpt-combine has half of the default's error by sample, and half of its samples.
    assert "| rooms | gpt+ngpt-combine | 1.00, 0.50 | 0.99, 0.50 | ~0.99, ~0.51 |" in lines
    assert lines[-1].startswith("| mean | 2.00, 2.00 | 2.00, 2.00 | 2.00, 2.00 | 1.33")


def test_the_page_has_the_tables_of_the_numbers_in_git():
    cells = json.loads(panel.RESULT.read_text())["cells"]
    assert {cell["scene"] for cell in cells} == set(panel.CASES)
    assert panel.text(cells) in panel.PAGE.read_text()


@pytest.mark.parametrize(("factors", "status"), [({}, 0), ({"auto+auto": 1.3}, 1), ({"primal+oidn": 1.02}, 0)])
def test_a_worsened_number_ends_with_1(factors, status, tmp_path, monkeypatch, capsys):
    asked = []

    def measured(names, cache, seeds):
        asked.append((list(names), list(seeds)))
        yield from (cells(name, seeds, factors if name == "glossy" else None) for name in names)

    monkeypatch.setattr(panel, "measured", measured)
    monkeypatch.setattr(panel, "RESULT", tmp_path / "panel.json")
    monkeypatch.setattr(panel, "PAGE", tmp_path / "page.md")
    (tmp_path / "page.md").write_text("before\n" + "\n".join(panel.MARKS) + "\nafter\n")
    command = ["panel", "--scenes", *NAMES]
    factors, given = {}, factors
    monkeypatch.setattr(sys, "argv", [*command, "--baseline"])
    assert panel.main() == 0 and asked == [(NAMES, [1, 2, 3])]
    assert len(json.loads((tmp_path / "panel.json").read_text())["cells"]) == 3 * 3 * 6
    page = (tmp_path / "page.md").read_text()
    assert page.startswith("before") and page.endswith("after\n") and "| product (product shot) | 64 |" in page
    factors = given
    monkeypatch.setattr(sys, "argv", command)
    assert panel.main() == status
    printed = capsys.readouterr().out
    assert ("worse: glossy, 16, auto+auto: error 1.300 times" in printed) == bool(status)
    # What one seed finds worse is measured with the others: the scenes themselves, or all where a mean is worse.
    assert asked[1] == (NAMES, [1]) and (len(asked) == 3) == bool(status)
