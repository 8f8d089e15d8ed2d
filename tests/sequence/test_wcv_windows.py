"""``wcv`` over windows of frames: what passes from window to window, and where a shot is cut."""

import numpy as np
import pytest
from shots import part_of, wall, without

from ngpt.methods import METHODS
from ngpt.sequence.wcv_windows import HOP, LENGTH, reconstruct_shot
from ngpt.stack import GradientStack

COUNT, SIZE = LENGTH + 4, (16, 20, 3)


@pytest.fixture
def stacks(rng):
    return wall(rng, COUNT)


def results(stacks, **options):
    found = {number: result for number, _, result in reconstruct_shot(stacks, **options)}
    assert all(result.options.keys() <= METHODS[result.method].options.keys() for result in found.values())
    return {number: result.image for number, result in found.items()}


def test_windows_pass_over_into_each_other(stacks):
    """Frames of two windows: the mean of both, by how far they are from the ends of each."""
    both, first, second = results(stacks), results(stacks[:LENGTH]), results(stacks[HOP:])
    for i in range(HOP, LENGTH):
        near, far = LENGTH - i, min(i - HOP + 1, COUNT - i)
        assert np.allclose(both[i], (near * first[i] + far * second[i - HOP]) / (near + far), atol=1e-5)
    assert np.array_equal(both[0], first[0]) and np.allclose(both[COUNT - 1], second[COUNT - HOP - 1], atol=1e-6)


def test_direct_light_and_caustics_are_added_back(stacks):
    direct = np.zeros(SIZE)
    direct[4:8, 4:8] = 5
    lamp = [stack.replace(primal=stack["primal"] + direct, direct=direct) for stack in stacks[:3]]
    for i, image in results(lamp).items():
        assert np.allclose((image - direct)[4:8, 4:8].mean(), 1 + 0.1 * i, atol=0.15)
        assert np.allclose(image[10:], results(stacks[:3])[i][10:], atol=0.1)
    light = np.full(SIZE, 2.0)
    caustic = [stack.replace(primal=stack["primal"] + light, caustic=light) for stack in stacks[:3]]
    for i, image in results(caustic).items():
        assert np.allclose(image, results(stacks[:3])[i] + light, atol=1e-3)


@pytest.mark.parametrize(
    "cut",
    [
        "dt",
        "previous",
        "size",
        "file",
        pytest.param("dt_var", marks=pytest.mark.slow),
        pytest.param("motion", marks=pytest.mark.slow),
    ],
)
def test_a_cut_parts_a_shot_in_two(stacks, cut):
    second = stacks[4]
    changed = {
        "dt": lambda: without(second, "dt"),
        "dt_var": lambda: without(second, "dt_var"),
        "motion": lambda: without(second, "motion"),
        "previous": lambda: GradientStack(second.layers, {"ngpt:frame": 4, "ngpt:previousFrame": 9}),
        "size": lambda: GradientStack({n: second[n][:8] for n in second.names}, second.attributes),
        "file": lambda: None,
    }[cut]()
    found = results([*stacks[:4], changed, *stacks[5:7]])
    assert all(np.array_equal(found[i], image) for i, image in results(stacks[:4]).items())
    assert (4 in found) == (cut != "file") and {5, 6} <= found.keys()


def test_windows_of_pixels_that_move_meet_where_they_lie(rng):
    """Frames at rest; each file holds a part that moves and changes its size."""
    steep = np.linspace(1, 5, SIZE[1])[:, None] + np.zeros(SIZE)
    stacks = [stack.replace(primal=stack["primal"] + steep) for stack in wall(rng, 5, growth=0)]
    slope = np.diff(steep, axis=1, append=steep[:, -1:])
    stacks = [stack.replace(dx=stack["dx"] + slope) for stack in stacks]
    parts = [part_of(stack, 2 * i, i % 2, 10 + i % 2, 14 - i % 3) for i, stack in enumerate(stacks)]
    whole, found, alone = results(stacks), results(parts), {i: results([part])[0] for i, part in enumerate(parts)}
    for i, part in enumerate(parts):
        there = part.place.data.within(part.place.display)
        errors = [np.square(image - 1 - steep[there]).mean() for image in (found[i], alone[i], whole[i][there])]
        assert errors[0] < 0.7 * errors[1] and errors[0] < 3 * errors[2]
