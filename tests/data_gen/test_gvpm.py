"""What is particular to ``gvpm``: photons in balls and their copies, and its differences against its own images.

That it repeats its bits, says how noisy it is and stays within its memory is among the laws of all samplers; what it
does on surfaces is that of ``gpm``, new edges of light paths are those of ``gbre``.
"""

import numpy as np
import pytest
from test_gbre import LONG, assert_copies_are_light_paths, rays  # noqa: F401 - a fixture
from test_gpm import largest


def test_photons_in_one_ball_alone_go_to_the_other(rays):  # noqa: F811
    """As near to y as they were to x, and as far from x as they were from y; and back. Mirrors keep volumes."""
    from data_gen.samplers.photons.gradients.shift import image

    g, dr = rays, rays.dr
    x, y = g.o, g.u
    c = image(g.b, x, y)
    assert largest(dr.norm(c - y) - dr.norm(g.b - x)) < 1e-11
    assert largest(dr.norm(c - x) - dr.norm(g.b - y)) < 1e-11
    assert largest(image(c, y, x) - g.b) < 1e-11
    axes = [g.Vector(1, 0, 0), g.Vector(0, 1, 0), g.Vector(0, 0, 1)]
    across, along, aside = (image(g.b + axis, x, y) - c for axis in axes)
    assert largest(dr.dot(dr.cross(across, along), aside) + 1) < 1e-10


@pytest.mark.parametrize("name", ["nested", *(pytest.param(n, marks=pytest.mark.slow) for n in LONG)])
def test_copies_of_photons_are_light_paths_and_their_copies_are_the_photons(renderer, name):
    """Camera paths scatter near by, a hundredth of their length apart."""
    import drjit as dr

    from data_gen.samplers.photons.media.gvpm import InBall

    mi = renderer

    def balls(eye, p, medium, rng):
        n, length = p.shape[1], np.linalg.norm(p - eye, axis=0)

        def ball(spread):
            x = p + rng.normal(size=p.shape) * spread * length
            d, one = (x - eye) / np.linalg.norm(x - eye, axis=0), dr.ones(mi.Spectrum, n)
            return InBall(mi.Point3f(x), mi.Vector3f(d), medium, one, dr.full(mi.Bool, True, n))

        return ball(0.003), ball(0.009), mi.Float((0.01 * length) ** 2)

    assert_copies_are_light_paths(mi, name, balls)
