"""The registry, and what happens to pixels that are not finite."""

import numpy as np
import pytest
from full_stack import full_stack

import ngpt
from ngpt.errors import NgptError
from ngpt.methods import choose, reconstruct
from ngpt.stack import GradientStack


@pytest.mark.parametrize(
    ("made_for", "expected"),
    [("ngpt-primal", "ngpt-primal"), ("wcv", "wcv"), ("unknown", "ngpt-combine"), (7, "ngpt-combine")],
)
def test_auto_takes_what_a_stack_was_rendered_for(made_for, expected):
    stack = full_stack(18, 26)
    stack.attributes["ngpt:for"] = made_for
    assert choose(stack, lambda name: True) == expected
    assert choose(stack, lambda name: name != "ngpt-primal") == (expected if expected == "wcv" else "ngpt-combine")
    assert choose(GradientStack({"primal": stack["primal"]}, stack.attributes), lambda name: True) == "oidn"


def test_direct_emission_is_added_back(noisy_stack):
    stack, _ = noisy_stack
    direct = np.zeros_like(stack["primal"])
    direct[:4, :5] = 50  # an edge that is in primal but, by contract, not in dx and dy
    with_lamp = stack.replace(primal=stack["primal"] + direct, direct=direct)
    assert np.abs(ngpt.denoise(with_lamp, "l2") - ngpt.denoise(stack, "l2") - direct).max() < 1e-4


@pytest.mark.parametrize(("method", "bad"), [("l2", np.nan), ("l1", np.nan), ("l1", np.inf), ("l2", -np.inf)])
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


def test_an_image_that_a_method_spoils_is_refused(noisy_stack):
    stack, _ = noisy_stack
    with pytest.raises(NgptError, match=r"method 'l2' gave .* non-finite pixels; the largest input value is"):
        reconstruct(stack.replace(primal=stack["primal"] * 3e37, dx=0 * stack["dx"] + 3e38), "l2")
