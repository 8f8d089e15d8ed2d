"""Images along motion vectors."""

import numpy as np
import pytest

from ngpt.sequence.warp import warped


def constant(x, y, size=(9, 11)):
    return np.broadcast_to([float(x), float(y)], (*size, 2))


@pytest.mark.parametrize("sharp", [False, True])
def test_whole_pixels_are_found_exactly(rng, sharp):
    image = rng.normal(size=(9, 11, 3)).astype(np.float32)
    value, found = warped(image, constant(2, -1), sharp)
    assert np.array_equal(value[1:, :-2], image[:-1, 2:]) and found[1:, :-2].all()
    assert not found[0].any() and not found[:, -2:].any() and not value[0].any()
    assert value.dtype == np.float32


@pytest.mark.parametrize("sharp", [False, True])
def test_ramps_are_kept(sharp):
    y, x = np.mgrid[:9, :11].astype(float)
    image = np.stack([2 * x - y, x + 3 * y], axis=-1)
    value, _ = warped(image, constant(0.3, 0.25), sharp)
    expected = image + np.array([2 * 0.3 - 0.25, 0.3 + 3 * 0.25])
    assert np.allclose(value[2:-3, 2:-3], expected[2:-3, 2:-3])


def test_a_spline_keeps_more_detail_and_never_overshoots(rng):
    image = rng.random((9, 11, 1))
    soft, sharp = (warped(image, constant(0.5, 0.5), kind)[0][:-1, :-1] for kind in (False, True))
    assert sharp.var() > 1.1 * soft.var()
    assert sharp.min() >= image.min() and sharp.max() <= image.max()


def test_nothing_is_found_outside_and_where_motion_is_not_known(rng):
    motion = np.array(constant(0, 0))
    motion[3, 4], motion[3, 5], motion[3, 6] = np.nan, np.inf, (1e30, 0)
    _, found = warped(rng.random((9, 11, 1)), motion)
    assert not found[3, 4:7].any() and found.sum() == 9 * 11 - 3
