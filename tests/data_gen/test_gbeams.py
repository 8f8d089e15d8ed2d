"""What is particular to ``gbeams``: how beams turn, and its differences against those of its own images.

That it repeats its bits, says how noisy it is and stays within its memory is among the laws of all samplers; what it
does on surfaces is that of ``gpm``, its camera paths are those of ``gbre``.
"""

import numpy as np
import pytest
from test_gbre import rays  # noqa: F401 - a fixture
from test_gpm import largest


@pytest.mark.parametrize("far", [False, True])
def test_beams_turn_to_and_fro(rays, far):  # noqa: F811
    """Past the other ray at the same distance along it, on the other side; J by finite differences."""
    from data_gen.samplers.photons.gradients.shift import past
    from data_gen.samplers.photons.media.beams import nearest

    g, dr = rays, rays.dr
    a = g.b - g.Vector(0.3, 2.0, 0.2)

    def turned(a, d, o, e, u, f):
        """The copy, past (u, f), of a beam from ``a`` along ``d`` past (o, e); light from infinity is moved."""
        s, t, _, _ = nearest(o, e, a, d)
        aside = dr.dot(a + d * s - o - e * t, dr.normalize(dr.cross(e, d)))
        target = past(a, d, u + f * t, f, -aside, g.dr.mask_t(aside)(far))
        origin = target - d * s if far else a
        return origin, d if far else dr.normalize(target - a), target

    d = dr.normalize(g.b - a)
    near = nearest(g.o, g.d, a, d)
    origin, d1, target = turned(a, d, g.o, g.d, g.u, g.e)
    there = nearest(g.u, g.e, origin, d1)
    assert largest(there[1] - near[1]) < 1e-6 and largest(there[2] - near[2]) < 1e-6
    back_origin, back, _ = turned(origin, d1, g.u, g.e, g.o, g.d)
    assert largest(back - d) < 1e-6
    if far:
        moved = back_origin - a
        assert largest(moved - d * dr.dot(moved, d)) < 1e-6
    x = dr.normalize(dr.cross(d, g.Vector(0.3, 0.9, 0.1)))
    y, h = dr.cross(d, x), 1e-5

    def copied(i, j):
        if far:
            origin, way, _ = turned(a + x * i + y * j, d, g.o, g.d, g.u, g.e)
            return origin - way * dr.dot(origin, way)
        return turned(a, dr.normalize(d + x * i + y * j), g.o, g.d, g.u, g.e)[1]

    columns = [(copied(h * i, h * j) - copied(-h * i, -h * j)) / (2 * h) for i, j in ((1, 0), (0, 1))]
    measured = np.array(dr.norm(dr.cross(*columns)))
    lengths = 1 if far else dr.square(near[0] / dr.norm(target - a))
    told = np.array(there[3] / near[3] * lengths)
    assert np.quantile(np.abs(measured / told - 1), 0.95) < 1e-4 and np.std(np.log(told)) > 0.02
