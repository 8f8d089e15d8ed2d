"""The layer ``caustic`` of ``gpt``: which paths it holds, that nothing is lost by it, and what it gains.

The differences of the layer's own noise would hide an error of dx. So dx and dy are compared with the differences of
what independent renders have beside the layer; that all of it together is the image is the test of the primal. The
budget is fixed: ``n`` stacks of 32 spp against two thirds as many of 64 spp at 32x32 pixels, at a level of 1 %.
"""

import numpy as np
import pytest
from data_gen_scenes import glass, plenty
from references import references
from renders import mi
from unbiased import differences, light_of_gradients, load, render_ours

from data_gen.paths.caustic import classes, lit_late
from data_gen.paths.vertex import DELTA, NULL, SMOOTH
from data_gen.render import render_stack
from ngpt.testing import z_test


@pytest.mark.parametrize(
    ("name", "n"),
    [(glass, 12), *(pytest.param(scene, 24, marks=pytest.mark.slow) for scene in (glass, "glossy", plenty))],
)
def test_differences_are_those_of_the_rest_and_nothing_is_lost(renderer, name, n):
    scene = load(renderer, name, (32, 32))
    stacks, rest = render_ours(scene, "gpt", n, 32), render_ours(scene, "gpt", 2 * n // 3, 64, seed=100)
    primal, caustic = (np.stack([stack[layer] for stack in stacks]) for layer in ("primal", "caustic"))
    assert caustic.mean() > 1e-4
    slopes = [differences(light_of_gradients(stack)) for stack in rest]
    for axis, layer in enumerate(("dx", "dy")):
        result = z_test(np.stack([stack[layer] for stack in stacks]), np.stack([slope[axis] for slope in slopes]))
        assert result.passed, f"{layer}: {result}"
    expected = references(renderer, name, (32, 32))
    assert z_test(primal, expected).passed
    # Without the layer's light it would be seen.
    assert name is not glass or not z_test(primal - caustic, expected).passed


def test_classes(renderer):

    def walk(*vertices):
        """Whether the path that leaves vertices (kind of event, connectable) is of the layer."""
        rough, late = mi.Bool(False), mi.Bool(False)
        for kind, connectable in vertices:
            rough, late = classes(rough, late, mi.Bool(True), mi.UInt32(kind), mi.Bool(connectable))
        return bool(late[0])

    wide, mirror, gloss, hole, coat = (SMOOTH, True), (DELTA, False), (SMOOTH, False), (NULL, True), (DELTA, True)
    assert not walk(mirror, mirror, gloss, wide, wide)  # from the camera through glass, then widely
    assert walk(wide, mirror) and walk(wide, gloss) and walk(wide, coat)
    assert walk(wide, mirror, wide)  # and all that follows
    assert walk(mirror, wide, hole, mirror) and not walk(wide, hole, wide) and not walk(coat, gloss)
    true, false = mi.Bool(True), mi.Bool(False)
    assert not classes(true, false, false, mi.UInt32(DELTA), true)[1][0]  # an end is no mirror
    assert lit_late(true, false, false)[0] and lit_late(false, true, true)[0]
    assert not lit_late(true, false, true)[0] and not lit_late(false, false, false)[0]


def test_gradients_have_less_noise_for_it(renderer):
    scene = load(renderer, "glossy", (64, 64))
    without, with_layer = (
        render_stack(scene, 32, 0, "gpt", caustic=caustic, unbiased=True) for caustic in (False, True)
    )
    assert "caustic" not in without and "caustic_var" not in without
    assert with_layer["primal"].mean() == pytest.approx(without["primal"].mean(), rel=0.02)
    for name in ("dx_var", "dy_var"):
        assert with_layer[name].mean() < 0.7 * without[name].mean()
    # Nor is there one where no path can be of it.
    assert "caustic" not in render_stack(load(renderer, "diffuse", (8, 8)), 2, sampler="gpt", unbiased=True)
