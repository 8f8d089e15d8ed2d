"""What one more layer would buy: the measured errors, and what `ngpt info` says of them."""

import json
from pathlib import Path

import numpy as np
import pytest
from full_stack import full_stack, hidden_oidn

import ngpt
from bench.layers import TABLE, by_layers
from ngpt.cli import main
from ngpt.denoisers import oidn
from ngpt.measure import gains as module
from ngpt.measure.gains import NEED_OIDN, cases, gains, read_errors, used
from ngpt.methods import METHODS, choose

RESULTS = Path(__file__).parents[2] / "docs" / "lab" / "RESULTS.md"
FEATURES, GRADIENTS = ("albedo", "normal", "depth"), ("dx", "dy")
needs_oidn = pytest.mark.skipif(bool(oidn.missing()), reason=oidn.missing())


def test_the_published_table_is_the_one_in_the_package():
    assert by_layers(json.loads(TABLE.read_text())["rows"]) in RESULTS.read_text()


def test_everything_that_auto_takes_was_measured():
    spp, errors = read_errors()
    assert set(cases()) <= errors.keys() and all(len(error) == len(spp) for error in errors.values())


@pytest.mark.parametrize("oidn_there", [True, False])
def test_a_layer_more_never_costs_more_than_5_per_cent(oidn_there):
    """By the table: `auto` is no worse off for what a stack has besides."""
    _, errors = read_errors()
    for _, layers in cases():
        method = choose(layers, module.usable(oidn_there))
        for less in [tuple(name for name in layers if name not in group) for group in module.GROUPS]:
            before = choose(less, module.usable(oidn_there))
            mine, theirs = errors[method, used(method, layers)], errors[before, used(before, less)]
            ratio = [a / b for a, b in zip(mine, theirs, strict=True)]
            assert ratio[0] * ratio[1] * ratio[2] < 1.05**3, (layers, method, less, before, ratio)


def test_those_that_need_oidn_are_known():
    with hidden_oidn():
        lacking = {name for name, entry in METHODS.items() if "OIDN" in entry.missing() and not entry.variant}
    assert lacking == set(NEED_OIDN)


@needs_oidn
def test_features_and_gradients_pay_where_oidn_is_there():
    found = {gain.add: gain for gain in gains(("primal",))}
    assert ("albedo",) in found or ("albedo", "normal") in found
    both = found[(*FEATURES, *GRADIENTS)]
    assert both.method == "ngpt-combine" and all(error < 0.9 for error in both.error.values())
    assert gains(full_stack(4, 4)) == []


def mean(gain) -> float:
    return float(np.exp(np.mean(np.log(list(gain.error.values())))))


def test_without_oidn_its_installation_pays():
    with hidden_oidn():
        found = {gain.add: gain for gain in gains(("primal",))}
        assert found[("OIDN",)].method == "oidn" and max(found[("OIDN",)].error.values()) < 1
        everything = gains(("primal", *FEATURES, *GRADIENTS, "primal_var", "dx_var", "dy_var"))
        assert [gain.add for gain in everything] == [("OIDN",)] and everything[0].method == "ngpt-combine"
        for layers in (("primal",), ("primal", *FEATURES), ("primal", *GRADIENTS)):
            found = gains(layers)
            for gain in found:
                rest = [g for g in found if set(g.add) < set(gain.add)]
                assert all(mean(gain) < mean(g) for g in rest), gain


def test_info_says_it(tmp_path, capsys):
    path = str(ngpt.write(tmp_path / "s.exr", ngpt.GradientStack({"primal": full_stack(6, 5)["primal"]})))
    with hidden_oidn():
        assert main(["info", path, "--json"]) == 0
        report = json.loads(capsys.readouterr().out)
        assert report["auto"] == "nfor" and report["auto with more"]["OIDN"]["auto"] == "oidn"
        assert set(report["auto with more"]["OIDN"]["times the error at"]) == {"4 spp", "16 spp", "64 spp"}
        assert main(["info", path]) == 0
    line = next(line for line in capsys.readouterr().out.splitlines() if line.startswith("  OIDN"))
    assert "auto oidn" in line and "times the error at 4 spp 0." in line
