"""What all walks have in common: parameters, Russian roulette, and the sky behind holes."""

import ast
from pathlib import Path

import pytest

from ngpt.errors import NgptError

ROOT = Path(__file__).parents[2] / "data_gen"


def source(name: str) -> str:
    return (ROOT / name).read_text()


def trees():
    """The files of data_gen and what is in them."""
    names = sorted(str(file.relative_to(ROOT)) for file in ROOT.rglob("*.py"))
    return [(name, ast.parse(source(name))) for name in names]


@pytest.mark.parametrize(
    "given", [{}, {"max_depth": 0}, {"max_depth": 7, "rr_depth": 1}, {"max_depth": -1, "hide_emitters": True}]
)
def test_limits_are_those_that_path_reads(renderer, given):
    mi = renderer
    from data_gen.paths.walk import Limits

    path, gpt = (mi.load_dict({"type": name, **given}) for name in ("path", "gpt_simple"))
    assert Limits.of(path) == gpt.limits == Limits.of(mi.load_dict({"type": "path", **gpt.limits.parameters()}))


@pytest.mark.parametrize(
    "wrong",
    [
        {"max_depth": -2},
        {"rr_depth": 0},
        {"rr_depth": -1},
        {"max_depth": 3.0},
        {"max_depth": 1 << 31},
        {"rr_depth": True},
    ],
)
def test_what_path_refuses_is_refused(renderer, wrong):
    mi = renderer
    from data_gen.paths.walk import Limits

    with pytest.raises(RuntimeError):
        mi.load_dict({"type": "path", **wrong})
    props = mi.Properties()
    for name, value in wrong.items():
        props[name] = value
    with pytest.raises(NgptError, match=f"{next(iter(wrong))} is .*: give an integer"):
        Limits.read(props)


def test_roulette_keeps_the_expectation(renderer):
    mi = renderer
    import drjit as dr

    from data_gen.paths.walk import roulette

    u = (dr.arange(mi.Float, 1 << 16) + 0.5) / (1 << 16)
    for throughput, η, most in ((0.25, None, 1), (3.0, None, 0.96), (0.25, 1.5, 1), (1e-3, 1, 1)):
        q = roulette(mi.Float(throughput), True, None if η is None else mi.Float(η))
        assert dr.mean(dr.select(u < q, 1 / q, 0))[0] == pytest.approx(1, rel=1e-2)
        assert 0 < q[0] < most, "paths at a perfect mirror end, too"
        assert roulette(mi.Float(throughput), mi.Bool(False))[0] == 1


def test_correlated_paths_survive_by_the_brightest_that_is_alive(renderer):
    mi = renderer
    from types import SimpleNamespace

    from data_gen.paths.walk import brightest

    paths = [
        SimpleNamespace(β=mi.Color3f(b, 0.1, 0), alive=mi.Bool(alive)) for b, alive in ((0.3, 1), (0.7, 1), (2, 0))
    ]
    assert brightest(paths)[0] == pytest.approx(0.7)


def test_a_hidden_sky_hides_behind_holes_until_something_scatters(renderer):
    mi = renderer
    import drjit as dr

    from data_gen.paths.vertex import NULL, SMOOTH
    from data_gen.paths.walk import Sky

    nothing = dr.zeros(mi.SurfaceInteraction3f)
    nothing.t = dr.inf
    hidden = Sky.from_camera(True)
    hole, wall = (hidden.behind(mi.UInt32(kind)) for kind in (NULL, SMOOTH))
    assert [bool(sky.meets(nothing)[0]) for sky in (hidden, hole, wall, Sky.from_camera(False))] == [0, 0, 1, 1]


# ------------------------------ The style of data_gen ------------------------------


def test_no_function_takes_more_than_six_positional_arguments():
    found = set()
    for name, tree in trees():
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef):
                given = [arg.arg for arg in (*node.args.posonlyargs, *node.args.args) if arg.arg not in ("self", "cls")]
                if len(given) > 6:
                    found.add(f"{name}:{node.name}")
    assert not found, "make a dataclass of what belongs together, or keywords"


def test_no_tuple_of_unlike_things_is_spread_into_a_call():
    found = {name for name, tree in trees() for node in ast.walk(tree) if spreads(node)}
    assert not found, "name the arguments"


def spreads(function: ast.AST) -> bool:
    """Whether a function spreads a tuple into a call, as it stands there or by a name."""
    if not isinstance(function, ast.FunctionDef):
        return False
    nodes = list(ast.walk(function))
    tuples = {
        target.id
        for node in nodes
        if isinstance(node, ast.Assign) and isinstance(node.value, ast.Tuple)
        for target, value in pairs(node.targets[0], node.value)
        if isinstance(target, ast.Name) and isinstance(value, ast.Tuple)
    }
    spread = [
        arg.value for node in nodes if isinstance(node, ast.Call) for arg in node.args if type(arg) is ast.Starred
    ]
    return any(type(it) in (ast.Tuple, ast.List) or (type(it) is ast.Name and it.id in tuples) for it in spread)


def pairs(target: ast.expr, value: ast.Tuple) -> list[tuple[ast.expr, ast.expr]]:
    """What is assigned to what."""
    if isinstance(target, ast.Tuple) and len(target.elts) == len(value.elts):
        return list(zip(target.elts, value.elts, strict=True))
    return [(target, value)]
