"""The sign and position of a gradient, and the adjoint."""

import numpy as np
import pytest

from ngpt.classical.gradients import adjoint_differences, forward_differences


def test_gradients_are_forward_differences():
    image = np.array([[1.0, 4.0, 9.0], [2.0, 0.0, 5.0]])[..., None]
    dx, dy = forward_differences(image)
    assert dx[..., 0].tolist() == [[3, 5, 0], [-2, 5, 0]]
    assert dy[..., 0].tolist() == [[1, -4, -4], [0, 0, 0]]


@pytest.mark.parametrize("shape", [(5, 7, 3), (1, 4, 1), (6, 1, 2), (1, 1, 3)])
def test_adjoint(rng, shape):
    image, dx, dy = rng.normal(size=(3, *shape))
    gx, gy = forward_differences(image)
    dx[:, -1], dy[-1] = np.nan, np.nan  # stand for no difference, and must not be looked at
    expected = np.sum(gx[:, :-1] * dx[:, :-1]) + np.sum(gy[:-1] * dy[:-1])
    assert np.sum(image * adjoint_differences(dx, dy)) == pytest.approx(expected, abs=1e-12)
