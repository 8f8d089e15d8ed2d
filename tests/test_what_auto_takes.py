"""Renderer x layers x OIDN: what `auto` takes of files with each renderer's names, and the error that it leaves.

Two built-in scenes, 16 samples per pixel, 96x64 pixels; errors are geometric means of the trimmed relMSE over both. The
same at 192x108 pixels over four scenes is in docs/use/from-your-renderer.md, by `python -m bench.layers`.
"""

import re
from pathlib import Path

import pytest
from full_stack import hidden_oidn

from bench.layers import CHOICES, RENDERERS, renderers
from ngpt.denoisers import oidn
from ngpt.measure.gains import NEED_OIDN
from ngpt.methods import METHODS, choose

PAGE = Path(__file__).parents[1] / "docs" / "use" / "from-your-renderer.md"


@pytest.fixture(scope="module")
def rows(renderer, tmp_path_factory):
    from data_gen.render import render_stack
    from data_gen.scenes.load import load_scene

    scenes = []
    for name in ("diffuse", "glossy"):
        scene = load_scene(name, (96, 64))
        truth = render_stack(scene, 512, seed=1, sampler="primal")["primal"]
        scenes.append((render_stack(scene, 16, seed=0), truth))
    return renderers(scenes, tmp_path_factory.mktemp("files"))


def test_every_renderer_is_there_with_oidn_and_without(rows):
    assert {row.renderer for row in rows} >= {*RENDERERS, "any, by our names"} and len(RENDERERS) == 8
    assert {row.layers for row in rows} == set(CHOICES)
    assert {row.oidn for row in rows} == ({False} if oidn.missing() else {True, False})


def test_nobody_gets_the_input_back(rows):
    for row in rows:
        # `nfor` estimates the noise where nothing tells it.
        most = 0.25 if row.oidn or {"primal_var", "dx"} & set(row.layers) else 0.6
        assert row.method != "primal" and row.error < most * row.before, row


@pytest.mark.skipif(bool(oidn.missing()), reason=oidn.missing())
def test_where_oidn_is_there_nothing_is_above_its_own_error_by_more_than_5_per_cent(rows):
    for row in rows:
        if row.oidn:
            assert row.error <= 1.05 * row.by_oidn, row


@pytest.mark.skipif(bool(oidn.missing()), reason=oidn.missing())
def test_gradients_and_features_leave_less_than_oidn_with_variances_and_without(rows):
    for row in rows:
        if row.oidn and {"dx", "albedo"} <= set(row.layers):
            assert row.error < 0.9 * row.by_oidn, row


def test_without_oidn_more_layers_beside_gradients_leave_less(rows):
    left = {row.layers: row.error for row in rows if not row.oidn}
    assert all(row.method not in NEED_OIDN for row in rows if not row.oidn)
    gradients, variances, features, everything = (left[layers] for layers in CHOICES[-4:])
    assert everything < features < gradients and everything < variances < gradients


def test_the_page_says_what_auto_takes():
    lines = re.findall(r"^\| ([a-z_, ]+) \| `([\w-]+)` \|.*\| `([\w-]+)` \|", PAGE.read_text(), re.M)
    assert [line[0] for line in lines] == [", ".join(layers) or "none" for layers in CHOICES]
    for layers, with_oidn, without in lines:
        held = {"primal", *(layers.split(", ") if layers != "none" else ())}
        if not METHODS["oidn"].missing():
            assert choose(held) == with_oidn
        with hidden_oidn():
            assert choose(held) == without
