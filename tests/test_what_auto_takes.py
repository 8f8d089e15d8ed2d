"""Renderer x layers x OIDN: what `auto` takes of files with each renderer's names, and the error that it leaves.

Two built-in scenes, 16 samples per pixel, 96x64 pixels; errors are geometric means of the trimmed relMSE over both. The
same at 192x108 pixels over four scenes is in docs/use/from-your-renderer.md, by `python -m bench.layers`.
"""

import re
from pathlib import Path

import pytest
from full_stack import hidden_oidn

from bench.layers import CHOICES, NEED_OIDN, RENDERERS, SAMPLER, renderers
from ngpt.denoisers import oidn
from ngpt.methods import METHODS, choose

PAGE = Path(__file__).parents[1] / "docs" / "use" / "from-your-renderer.md"


@pytest.fixture(scope="module")
def rows(renderer, tmp_path_factory):
    from data_gen.render import render_stack
    from data_gen.scenes.load import load_scene

    scenes = [load_scene(name, (96, 64)) for name in ("diffuse", "glossy")]
    truths = [render_stack(scene, 512, seed=1, sampler="primal", unbiased=True)["primal"] for scene in scenes]
    stacks = [render_stack(scene, 16, seed=0, sampler=SAMPLER, unbiased=True) for scene in scenes]
    return renderers(list(zip(stacks, truths, strict=True)), tmp_path_factory.mktemp("files"))


@pytest.mark.slow
def test_nobody_gets_the_input_back(rows):
    assert {row.renderer for row in rows} >= {*RENDERERS, "any, by our names"} and len(RENDERERS) == 8
    assert {row.layers for row in rows} == set(CHOICES)
    for row in rows:
        # `nfor` estimates the noise where nothing tells it.
        most = 0.25 if row.oidn or {"primal_var", "dx"} & set(row.layers) else 0.6
        assert row.method != "primal" and row.error < most * row.before, row


@pytest.mark.slow
@pytest.mark.skipif(bool(oidn.missing()), reason=oidn.missing())
def test_where_oidn_is_there_nothing_is_above_its_own_error_by_more_than_5_per_cent(rows):
    """Gradients with features leave less, with variances and without."""
    by_oidn = [row for row in rows if row.oidn]
    assert by_oidn
    for row in by_oidn:
        assert row.error <= (0.9 if {"dx", "albedo"} <= set(row.layers) else 1.05) * row.by_oidn, row


@pytest.mark.slow
def test_without_oidn_more_layers_beside_gradients_leave_less(rows):
    left = {row.layers: row.error for row in rows if not row.oidn}
    assert all(row.method not in NEED_OIDN for row in rows if not row.oidn)
    gradients, variances, features, everything = (left[layers] for layers in CHOICES[-4:])
    assert everything < features < gradients and everything < variances < gradients


@pytest.mark.parametrize("layers", CHOICES)
def test_the_page_says_what_auto_takes(layers):
    name, held = re.escape(", ".join(layers) or "none"), {"primal", *layers}
    line = re.search(rf"^\| {name} \| `([\w-]+)` \|.*\| `([\w-]+)` \|", PAGE.read_text(), re.M)
    assert METHODS["oidn"].missing() or choose(held) == line[1]
    with hidden_oidn():
        assert choose(held) == line[2]
