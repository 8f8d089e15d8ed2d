"""Photon planes: where rays meet them, that what they bring has no bias, and what ``planes`` converges to.

That it repeats its bits, says how noisy it is and stays within its memory is among the laws of all samplers; what is
refused is that of ``vpm``, beams are those of ``beams``.
"""

from functools import partial

import numpy as np
import pytest
from unbiased import REFERENCES, load, render_ours

from data_gen.scenes.builtin import _camera, _diffuse, _rgb, _sphere
from ngpt.testing import z_test


def test_lines_meet_planes(renderer):
    """By the coordinates that the place has on the plane and on the line; the volume by numpy."""
    from data_gen.samplers.photons.media.planes import crossing

    mi, rng = renderer, np.random.default_rng(0)
    a, o, d, e, w = rng.normal(size=(5, 3, 200))
    d, e, w = (v / np.linalg.norm(v, axis=0) for v in (d, e, w))
    at = crossing(mi.Point3f(a), mi.Vector3f(d), mi.Vector3f(e), mi.Point3f(o), mi.Vector3f(w))
    s, t, u, volume = (np.array(x, np.float64) for x in (at.s, at.t, at.u, at.volume))
    told = np.linalg.det(np.stack([d, e, w]).transpose(2, 0, 1))
    assert np.allclose(volume, told, atol=1e-5)
    known = np.abs(told) > 0.05
    assert known.sum() > 150 and np.allclose((a + d * s + e * t)[:, known], (o + w * u)[:, known], atol=1e-3)


def black_room(max_depth=6):
    """A lamp in a medium around a denser one, and a black ball, within black walls.

    What a lamp sends into media is swept by one edge, all else by planes.
    """
    mist = {"type": "ref", "id": "air"}
    core = {"type": "homogeneous", "albedo": _rgb(0.9, 0.7, 0.8), "sigma_t": _rgb(0.6, 0.4, 0.5), "scale": 3.0}
    return {
        "type": "scene",
        "air": {
            "type": "homogeneous",
            "id": "air",
            "albedo": _rgb(0.9, 0.8, 0.7),
            "sigma_t": _rgb(0.3, 0.5, 0.7),
            "phase": {"type": "hg", "g": 0.4},
        },
        "integrator": {"type": "volpath", "max_depth": max_depth, "rr_depth": 4},
        "sensor": _camera([0, 0, 3], [0, 0, 0], 40) | {"medium": mist},
        "lamp": {"type": "point", "position": [0.5, 0.8, -0.5], "intensity": _rgb(5, 5, 5)},
        "core": _sphere([-0.3, 0.0, 0.1], 0.5, {"type": "null"}) | {"interior": core, "exterior": mist},
        "ball": _sphere([0.5, 0.3, 0.2], 0.3, _diffuse(0, 0, 0)),
        "walls": _sphere([0.0, 0.0, 0.0], 3.5, _diffuse(0, 0, 0)),
    }


def light_of_planes(renderer, monkeypatch, spp=4, batches=8, **options):
    """(light by planes alone, that of all paths but those of two edges), images of the same shape."""
    from data_gen.samplers.photons.media.beams import BEAMS

    monkeypatch.setattr(BEAMS, "near", lambda *_: iter(()))
    ours = render_ours(load(renderer, black_room, (16, 16)), "planes", batches=batches, spp=spp, photons=2, **options)
    long, short = (
        render_ours(
            load(renderer, partial(black_room, depth), (16, 16)), "primal", 16, 128, seed=REFERENCES + 100 * depth
        )
        for depth in (6, 2)
    )
    references = [a["primal"] - b["primal"] for a, b in zip(long, short, strict=True)]
    return np.stack([stack["primal"] for stack in ours]), np.stack(references)


@pytest.mark.slow
def test_light_by_planes_has_no_bias(renderer, monkeypatch):
    """Through boundaries, past what is in the way, with extinctions of each colour; some of the light paths swept."""
    ours, references = light_of_planes(renderer, monkeypatch, planes=128)
    assert references.mean() > 0.05
    result = z_test(ours, references, block=4)
    assert result.passed, result


@pytest.mark.slow
@pytest.mark.parametrize("wrong", ["shadow", "triggers", "length"])
def test_wrong_planes_are_found(renderer, monkeypatch, wrong):
    """Without what is in the way; with paths that scatter counted once, as if all did; and edges without end."""
    import drjit as dr

    from data_gen.paths import segments
    from data_gen.samplers.photons.media import planes

    if wrong == "shadow":
        whole = segments.cross

        def unseen(passes, trace, ray, medium, reach, active):
            τ, hit, *others = whole(passes, trace, ray, medium, reach, active)
            hit.valid = hit.valid & False
            return τ, hit, *others

        monkeypatch.setattr(planes.segments, "cross", unseen)
    else:
        swept = planes.swept

        def changed(*args):
            found = swept(*args)
            if wrong == "length":
                found.length = 0 * found.length + dr.inf
            else:
                found.Φ *= 1 - dr.exp(-found.σ * dr.minimum(found.length, 1e3))
            return found

        monkeypatch.setattr(planes, "swept", changed)
    ours, references = light_of_planes(renderer, monkeypatch, spp=8, batches=12, planes=256)
    assert not z_test(ours, references, block=4).passed


def test_paths_of_planes_are_no_longer_than_the_scene_says(renderer, monkeypatch):
    """A plane and the way to the camera are three edges."""
    from data_gen.render import render_stack
    from data_gen.samplers.photons.media.beams import BEAMS

    monkeypatch.setattr(BEAMS, "near", lambda *_: iter(()))
    scenes = [load(renderer, partial(black_room, depth), (8, 8)) for depth in (2, 3)]
    light = [render_stack(scene, 1, 0, "planes")["primal"].sum() for scene in scenes]
    assert light[0] == 0 < light[1]
