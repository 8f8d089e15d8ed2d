"""The map of where gradients hurt, on variances that are known."""

import numpy as np

from bench.gradientmap import log_ratio, variances_of_differences
from ngpt.stack import GradientStack


def known_stack():
    layers = {name: np.zeros((9, 12, 3)) for name in ("primal", "direct", "dx", "dy")}
    layers |= {"primal_var": np.full((9, 12, 3), 2.0), "dx_var": np.full((9, 12, 3), 1.0)}
    layers["dy_var"] = np.full((9, 12, 3), 1.0)
    layers["dx_var"][:, 6:] = layers["dy_var"][:, 6:] = 32.0
    layers["direct"][0, 0] = 1
    return GradientStack.from_arrays(**layers)


def test_variances_of_differences_leave_out_lights_and_borders():
    x, y = variances_of_differences(known_stack())
    assert (x[1:, :-1] == 4).all() and (y[:-1, 1:] == 4).all()
    assert np.isnan(x[:, -1]).all() and np.isnan(y[-1]).all() and np.isnan(x[0, 0]).all() and np.isnan(y[0, 0]).all()


def test_ratio_is_that_of_the_variances():
    ratio = log_ratio(known_stack())
    assert np.allclose(ratio[2:, 1:5], np.log2(4)) and np.allclose(ratio[2:, 7:-1], np.log2(1 / 8))
