"""What all walks have in common: parameters, Russian roulette, and the sky behind holes."""

import ast
from pathlib import Path
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import pytest

from data_gen.paths.vertex import NULL, SMOOTH
from data_gen.paths.walk import Limits, Sky, brightest, roulette
from ngpt.errors import NgptError


@pytest.mark.parametrize(
    "given", [{}, {"max_depth": 0}, {"max_depth": 7, "rr_depth": 1}, {"max_depth": -1, "hide_emitters": True}]
)
def test_limits_are_those_that_path_reads(renderer, given):
    path, gpt = (mi.load_dict({"type": name, **given}) for name in ("path", "gpt_simple"))
    assert Limits.of(path) == gpt.limits == Limits.of(mi.load_dict({"type": "path", **gpt.limits.parameters()}))


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        ("max_depth", -2),
        ("rr_depth", 0),
        ("rr_depth", -1),
        ("max_depth", 3.0),
        ("max_depth", 1 << 31),
        ("rr_depth", True),
    ],
)
def test_what_path_refuses_is_refused(renderer, name, wrong):
    with pytest.raises(RuntimeError):
        mi.load_dict({"type": "path", name: wrong})
    props = mi.Properties()
    props[name] = wrong
    with pytest.raises(NgptError, match=f"{name} is .*: give an integer"):
        Limits.read(props)


def test_roulette_keeps_the_expectation(renderer):
    u = (dr.arange(mi.Float, 1 << 16) + 0.5) / (1 << 16)
    for throughput, η, most in ((0.25, None, 1), (3.0, None, 0.96), (0.25, 1.5, 1), (1e-3, 1, 1)):
        q = roulette(mi.Float(throughput), True, None if η is None else mi.Float(η))
        assert dr.mean(dr.select(u < q, 1 / q, 0))[0] == pytest.approx(1, rel=1e-2)
        assert 0 < q[0] < most, "paths at a perfect mirror end, too"
        assert roulette(mi.Float(throughput), mi.Bool(False))[0] == 1


def test_correlated_paths_survive_by_the_brightest_that_is_alive(renderer):
    paths = [
        SimpleNamespace(β=mi.Color3f(b, 0.1, 0), alive=mi.Bool(alive)) for b, alive in ((0.3, 1), (0.7, 1), (2, 0))
    ]
    assert brightest(paths)[0] == pytest.approx(0.7)


def test_a_hidden_sky_hides_behind_holes_until_something_scatters(renderer):
    nothing = dr.zeros(mi.SurfaceInteraction3f)
    nothing.t = dr.inf
    hidden = Sky.from_camera(True)
    hole, wall = (hidden.behind(mi.UInt32(kind)) for kind in (NULL, SMOOTH))
    assert [bool(sky.meets(nothing)[0]) for sky in (hidden, hole, wall, Sky.from_camera(False))] == [0, 0, 1, 1]


def test_no_function_of_data_gen_takes_more_than_six_positional_arguments():
    found = set()
    for file in (Path(__file__).parents[2] / "data_gen").rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.FunctionDef):
                given = [arg.arg for arg in (*node.args.posonlyargs, *node.args.args) if arg.arg not in ("self", "cls")]
                found |= {f"{file.name}:{node.name}"} if len(given) > 6 else set()
    assert not found, "make a dataclass of what belongs together, or keywords"
