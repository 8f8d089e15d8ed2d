"""Laws of samplers in scenes that are of interest for studies; those of quick scenes are in tests/data_gen/laws."""

import pytest
from data_gen_scenes import fog, hidden_lamp
from registered import slow
from test_energy import have_no_gradients
from test_refused import is_refused
from test_unbiased import LONG, Case, holds

from data_gen.adaptive import Adaptive

CASES = [
    *(Case("gpt-tiles", scene, spp=64) for scene in ("diffuse", "glossy", "lens", "courtyard")),
    Case("gpt-tiles", "courtyard", (1,), {"tile": 2}, **LONG),
    Case("gpt-tiles", "courtyard", (1,), {"tile": 4}, **LONG),
    *(Case("split", scene, **LONG) for scene in ("glossy", "environment", "lens", "everything")),
]


@pytest.mark.parametrize("case", [slow(case, id=f"{case}-long") for case in CASES])
def test_unbiased(renderer, case):
    holds(renderer, case)


REFUSED = [
    ("gpt-tiles", fog, {}, "'gpt-tiles' knows only 'path'"),
    ("gpt-tiles", hidden_lamp, {}, "hides emitters; use --sampler gpt"),
    ("gpt-tiles", "diffuse", {"adaptive": Adaptive()}, "'gpt-tiles' depend on each other and cannot be adaptive"),
    ("split", fog, {}, "'split' knows only 'path'"),
    ("split", hidden_lamp, {}, "hides emitters; use --sampler gpt"),
]


@pytest.mark.parametrize(("sampler", "scene", "options", "message"), REFUSED)
def test_refused(renderer, sampler, scene, options, message):
    is_refused(renderer, sampler, scene, options, message)


@pytest.mark.parametrize("name", ["split", "gpt-tiles"])
def test_paths_of_no_edge_and_of_one_have_no_gradients(renderer, name):
    have_no_gradients(renderer, name)
