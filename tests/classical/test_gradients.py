"""The sign and position of a gradient, and the adjoint."""

import numpy as np
import pytest

from ngpt.classical.gradients import adjoint, differences, forward_differences


def test_gradients_are_forward_differences():
    image = np.array([[1.0, 4.0, 9.0], [2.0, 0.0, 5.0]])[..., None]
    dx, dy = forward_differences(image)
    assert dx[..., 0].tolist() == [[3, 5, 0], [-2, 5, 0]]
    assert dy[..., 0].tolist() == [[1, -4, -4], [0, 0, 0]]


@pytest.mark.parametrize("shape", [(3, 5, 7), (1, 1, 4), (2, 6, 1), (3, 1, 1)])
def test_adjoint(rng, shape):
    planes, dx, dy = rng.normal(size=(3, *shape))
    gx, gy = differences(planes, 0, shape[1])
    dx[..., -1], dy[..., -1, :] = 0, 0
    assert np.sum(planes * adjoint(dx, dy)) == pytest.approx(np.sum(gx * dx) + np.sum(gy * dy), abs=1e-12)
