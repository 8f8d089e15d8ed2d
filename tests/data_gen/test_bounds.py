"""Scenes that users load as Mitsuba would: merged rectangles have wrong bounding boxes, and light passes walls."""

import numpy as np
import pytest

import data_gen
from ngpt.errors import NgptError

pytest.importorskip("mitsuba")

from data_gen_scenes import _two

from data_gen.scenes import bounds
from data_gen.scenes.builtin import _wall


def closed_room(mi, **more):
    """Walls on all sides, the camera between them, and a sun behind the wall on the right."""
    sides = {"floor": [0, -1, 0], "ceiling": [0, 1, 0], "back": [0, 0, -1], "front": [0, 0, 1]}
    sides |= {"left": [-1, 0, 0], "right": [1, 0, 0]}
    film = {"type": "hdrfilm", "width": 12, "height": 8, "rfilter": {"type": "box"}}
    look = mi.ScalarTransform4f().look_at([0, 0, 0.9], [0, 0, -1], [0, 1, 0])
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 3},
        "sensor": {"type": "perspective", "fov": 70, "to_world": look, "film": film},
        **{name: _wall(at, [-x for x in at], (2, 2), _two(0.5, 0.5, 0.5)) for name, at in sides.items()},
        "sun": {"type": "directional", "direction": [-1, -0.3, -0.1], "irradiance": 3.0},
        **more,
    }


def cube(mi, size):
    return {"type": "cube", "to_world": mi.ScalarTransform4f().scale(size), "bsdf": {"type": "diffuse"}}


@pytest.mark.parametrize("sampler", ["primal", "gpt", "bdpt", "a plugin"])
def test_no_light_comes_through_the_walls_of_a_scene_that_mitsuba_merged(renderer, sampler):
    described = closed_room(renderer, box=cube(renderer, 0.1))
    if sampler == "a plugin":
        described["integrator"] = {"type": "gpt", "max_depth": 3}
    scene = renderer.load_dict(described, parallel=False)
    assert np.array(scene.bbox().max).max() < 1, "Mitsuba has mended it"
    if sampler == "a plugin":
        image = np.array(renderer.render(scene, spp=2))[..., :3]
    else:
        image = data_gen.render_scene(scene, 2, sampler=sampler)[0]["primal"]
    assert image.mean() < 1e-4  # a light path may slip through where two walls meet
    assert np.allclose(scene.bbox().min, -1) and np.allclose(scene.bbox().max, 1)


def test_a_box_that_lacks_some_of_its_mesh_is_found_too(renderer):
    """Of a rectangle and a cube of one material the merged box is that of the cube."""
    far = cube(renderer, 1) | {"type": "rectangle", "to_world": renderer.ScalarTransform4f().translate([0, 0, 5])}
    scene = renderer.load_dict({"type": "scene", "a": cube(renderer, 1), "b": far}, parallel=False)
    assert len(scene.shapes()) == 1 and scene.bbox().max[2] == 1
    bounds.mend_bounds(scene)
    assert scene.bbox().max[2] == 5


def test_a_box_that_stays_wrong_is_refused_with_the_remedy(renderer, monkeypatch):
    monkeypatch.setattr(bounds, "_compute_again", lambda shape: None)
    scene = renderer.load_dict(closed_room(renderer), parallel=False)
    with pytest.raises(NgptError, match=r"its 24 vertices, .*; load the scene with optimize=False$"):
        data_gen.render_scene(scene, 2)
