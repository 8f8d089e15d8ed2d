"""The registry, and what happens to pixels that are not finite."""

from dataclasses import replace

import numpy as np
import pytest
from full_stack import full_stack

import ngpt
from ngpt.classical import bases
from ngpt.errors import NgptError
from ngpt.methods import METHODS, choose, reconstruct
from ngpt.repair import repair
from ngpt.stack import GradientStack

FEATURES = ("albedo", "normal", "depth")


@pytest.mark.parametrize(
    ("layers", "with_oidn", "without"),
    [
        ((), "oidn", "nfor"),
        (("albedo",), "oidn", "nfor"),
        (("albedo", "normal"), "oidn", "nfor"),
        ((*FEATURES, "primal_var"), "oidn", "nfor"),
        (("dx", "dy"), "oidn", "l1"),
        (("dx", "dy", "primal_var", "dx_var", "dy_var"), "oidn", "wcv"),
        ((*FEATURES, "dx", "dy"), "ngpt-combine", "ngpt-fast"),
        ((*FEATURES, "dx", "dy", "primal_var", "dx_var", "dy_var"), "ngpt-combine", "ngpt-fast"),
    ],
)
def test_auto_takes_the_best_that_layers_and_machine_allow(monkeypatch, layers, with_oidn, without):
    """The input comes back only where it is asked for."""
    stack = full_stack(18, 26)
    stack = GradientStack({name: stack[name] for name in ("primal", *layers)})
    for answer, expected in (("", with_oidn), ("OIDN is not installed", without)):
        entries = {name: replace(METHODS[name], missing=lambda answer=answer: answer) for name in NEED_OIDN}
        monkeypatch.setattr("ngpt.methods.METHODS", METHODS | entries)
        assert choose(stack) == expected


def test_auto_takes_what_a_stack_was_rendered_for(monkeypatch):
    stack = full_stack(18, 26)
    for made_for, expected in (
        ("ngpt-primal", "ngpt-primal"),
        ("wcv", "wcv"),
        ("unknown", "ngpt-combine"),
        (7, "ngpt-combine"),
    ):
        stack.attributes["ngpt:for"] = made_for
        assert choose(stack, lambda name: True) == expected
    stack.attributes["ngpt:for"] = "ngpt-primal"
    assert choose(stack, lambda name: name != "ngpt-primal") == "ngpt-combine"
    lacking = GradientStack({"primal": stack["primal"]}, stack.attributes)
    assert choose(lacking, lambda name: True) == "oidn"


NEED_OIDN = ("ngpt-combine", "ngpt-primal", "oidn")


# Those that need nothing but a stack.
CLASSICAL = ["primal", *bases.CLASSICAL]


def test_direct_emission_is_added_back(noisy_stack):
    stack, _ = noisy_stack
    direct = np.zeros_like(stack["primal"])
    direct[:4, :5] = 50  # an edge that is in primal but, by contract, not in dx and dy
    with_lamp = stack.replace(primal=stack["primal"] + direct, direct=direct)
    assert np.abs(ngpt.denoise(with_lamp, "l2") - ngpt.denoise(stack, "l2") - direct).max() < 1e-4


@pytest.mark.parametrize("method", ["l2", "l1"])
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_nonfinite_pixels_are_repaired_and_counted(noisy_stack, method, bad):
    stack, clean = noisy_stack
    primal, dx, dy = (stack[name].copy() for name in ("primal", "dx", "dy"))
    primal[3, 4, 1] = bad
    primal[12:15, 18:22] = bad  # a hole whose inside has no good neighbour
    dx[9, 2], dy[10, 6, 0] = bad, bad
    dx[:, -1], dy[-1] = bad, bad  # no gradients there: must not be counted
    result = reconstruct(GradientStack.from_arrays(primal=primal, dx=dx, dy=dy), method)
    assert result.repaired == 1 + 12
    # Around the lone pixel 2 + 2 differences, around the hole 3 * 5 + 4 * 4, and the two by themselves.
    assert result.untrusted == 4 + 15 + 16 + 2
    assert np.abs(result.image - clean).max() < 0.6


def test_repair_uses_neighbours(rng):
    primal = np.ones((5, 5, 3))
    primal[2, 2] = np.nan
    primal[1:4, 1:4][~np.isnan(primal[1:4, 1:4])] = 7.0
    assert np.allclose(repair(GradientStack.from_arrays(primal=primal)).image[2, 2], 7.0)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda s: reconstruct(s, "l3"), "unknown method 'l3'; choose one of: auto, primal"),
        (lambda s: reconstruct(s, "primal", alpha=1), "method 'primal' has no option 'alpha'"),
        (lambda s: reconstruct(GradientStack.from_arrays(primal=s["primal"]), "l1"), "method 'l1' needs layers 'dx'"),
        (lambda s: reconstruct(s.replace(primal=s["primal"] * np.nan)), "no finite pixel among 408"),
        (lambda s: reconstruct(s.replace(primal=s["primal"] * 3e37, dx=0 * s["dx"] + 3e38), "l2"), "non-finite pixels"),
    ],
)
def test_errors_name_the_problem(noisy_stack, call, message):
    with pytest.raises(NgptError) as error:
        call(noisy_stack[0])
    assert message in str(error.value) and "\n" not in str(error.value)
