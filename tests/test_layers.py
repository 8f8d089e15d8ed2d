"""The measured errors of what `auto` takes, by the layers of a stack: bench/results/layers.json."""

import json
import re
from pathlib import Path

import pytest
from full_stack import hidden_oidn

from bench.layers import CHOICES, GROUPS, NEED_OIDN, SPP, TABLE, by_layers, cases, usable, used
from ngpt.methods import METHODS, choose

DOCS = Path(__file__).parents[1] / "docs"
ROWS = json.loads(TABLE.read_text())["rows"]
ERRORS = {(row["method"], tuple(row["layers"])): row["error"] for row in ROWS}


def test_the_published_table_is_the_one_that_was_measured():
    assert by_layers(ROWS) in (DOCS / "lab" / "RESULTS.md").read_text()


def test_everything_that_auto_takes_was_measured():
    assert set(cases()) <= ERRORS.keys() and all(len(error) == len(SPP) for error in ERRORS.values())


@pytest.mark.parametrize("oidn_there", [True, False])
def test_a_layer_more_never_costs_more_than_5_per_cent(oidn_there):
    """By the table: `auto` is no worse off for what a stack has besides."""
    for _, layers in cases():
        method = choose(layers, usable(oidn_there))
        for less in [tuple(name for name in layers if name not in group) for group in GROUPS]:
            before = choose(less, usable(oidn_there))
            mine, theirs = ERRORS[method, used(method, layers)], ERRORS[before, used(before, less)]
            ratio = [a / b for a, b in zip(mine, theirs, strict=True)]
            assert ratio[0] * ratio[1] * ratio[2] < 1.05**3, (layers, method, less, before, ratio)


def test_those_that_need_oidn_are_known():
    with hidden_oidn():
        lacking = {name for name, entry in METHODS.items() if "OIDN" in entry.missing() and not entry.variant}
    assert lacking == set(NEED_OIDN)


@pytest.mark.parametrize("layers", CHOICES)
def test_the_page_says_what_auto_takes(layers):
    name, held = re.escape(", ".join(layers) or "none"), {"primal", *layers}
    page = (DOCS / "use" / "from-your-renderer.md").read_text()
    line = re.search(rf"^\| {name} \| `([\w-]+)` \|.*\| `([\w-]+)` \|", page, re.M)
    assert METHODS["oidn"].missing() or choose(held) == line[1]
    with hidden_oidn():
        assert choose(held) == line[2]
