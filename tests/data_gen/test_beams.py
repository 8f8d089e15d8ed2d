"""Photon beams: how beams are cut into parts, and where they are nearest to rays.

That it repeats its bits, says how noisy it is and stays within its memory is among the laws of all samplers; lamps
within media and what is refused are those of ``vpm``, camera paths those of ``bre``.
"""

import media_scenes
import numpy as np
import pytest
from unbiased import load


def test_lines_are_nearest(renderer):
    """Against the least distance of many pairs of points."""
    import drjit as dr

    from data_gen.samplers.photons.media.beams import nearest

    mi, rng = renderer, np.random.default_rng(0)
    o, p = rng.normal(size=(2, 3, 200)) * 0.3
    d, e = rng.normal(size=(2, 3, 200))
    d, e = d / np.linalg.norm(d, axis=0), e / np.linalg.norm(e, axis=0)
    s, t, aside, sin = (np.array(x) for x in nearest(mi.Point3f(o), mi.Vector3f(d), mi.Point3f(p), mi.Vector3f(e)))
    known = sin > 0.1
    assert np.allclose(sin, np.sqrt(1 - (d * e).sum(axis=0) ** 2), atol=1e-4) and known.sum() > 150

    def apart(s, t):
        return np.linalg.norm(o + d * t - p - e * s, axis=0)

    assert np.allclose(apart(s, t)[known], aside[known], atol=1e-4)
    for i, j in ((1, 0), (0, 1), (1, 1), (-1, 1)):
        assert (apart(s + 0.01 * i, t + 0.01 * j) > aside - 1e-5)[known].all()
    assert dr.width(mi.Float(s)) == 200


@pytest.mark.slow
def test_beams_are_cut_the_same_in_windows(renderer, monkeypatch):
    """All parts at once, or few at a time: the same light."""
    from data_gen.render import render_stack
    from data_gen.samplers.photons.media import beams

    scene = load(renderer, media_scenes.haze, (8, 8))
    whole = render_stack(scene, 2, 0, "beams", photons=4)["primal"]
    monkeypatch.setattr(beams, "PARTS", 1)
    assert np.allclose(render_stack(scene, 2, 0, "beams", photons=4)["primal"], whole, rtol=1e-4)
