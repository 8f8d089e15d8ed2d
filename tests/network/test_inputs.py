"""What networks read of a stack: the same for both runtimes, and refused by name where the stack lacks it."""

import numpy as np
import pytest
from full_stack import full_stack

from ngpt.classical.bases import BASES
from ngpt.classical.energy import keep_energy
from ngpt.errors import NgptError
from ngpt.methods import METHODS, reconstruct
from ngpt.network import inputs
from ngpt.repair import repair
from ngpt.stack import GradientStack

GRADIENTS = {"dx", "dy", "dx_var", "dy_var"}


def without(stack, *names):
    return GradientStack({name: layer for name, layer in stack.layers.items() if name not in names})


@pytest.mark.parametrize("base", BASES)
def test_a_base_is_what_the_method_of_that_name_makes(base):
    """But for the energy that wcv gives back, which a tile does not know."""
    stack = full_stack(12, 17)
    data = repair(stack)
    made = inputs.base_image(data, base)
    if base == "wcv":
        made = keep_energy(made, data.image)
    assert np.array_equal(made, reconstruct(stack, base).image)
    assert BASES[base].needs == METHODS[base].needs == inputs.needs(("primal", "base"), base)


def test_standard_errors_are_roots_and_0_where_nothing_is_known():
    stack = full_stack(9, 8)
    variance = stack["primal_var"].copy()
    variance[1, 2], variance[3, 4, 0], variance[5, 6, 1] = np.nan, -1, np.inf
    given = inputs.gather(repair(stack.replace(primal_var=variance)), ("primal_se", "primal_var"), "")
    assert np.array_equal(given["primal_var"], variance, equal_nan=True)
    known = np.isfinite(variance) & (variance >= 0)
    assert np.array_equal(given["primal_se"], np.where(known, np.sqrt(np.where(known, variance, 0)), 0))


def test_only_what_is_asked_for_is_given_in_that_order():
    assert list(inputs.gather(repair(full_stack(5, 6)), ("depth", "base", "primal"), "cv")) == [
        "depth",
        "base",
        "primal",
    ]


@pytest.mark.parametrize(
    ("absent", "names", "base", "message"),
    [
        (GRADIENTS, ("primal", "dx", "dy_se"), "", "the file need layers dx, dy_var, which the stack lacks"),
        (GRADIENTS, ("base",), "cv", "need layers dx, dy, which"),
        ({"dx_var"}, ("base",), "wcv", "need layers dx_var, dy_var, which"),
        ({"albedo"}, ("denoised",), "", "need layers albedo, which"),
        ((), ("primal", "denoised_base"), "", "need layers base, which"),
        ((), ("primal", "colour"), "", "need layers colour, which"),
    ],
)
def test_what_is_lacking_is_named(absent, names, base, message):
    with pytest.raises(NgptError, match=message):
        inputs.gather(repair(without(full_stack(6, 5), *absent)), names, base, "the file")
