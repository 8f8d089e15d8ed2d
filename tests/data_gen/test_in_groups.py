"""What only instances show: Mitsuba does not list the shapes of a group, but they count like others."""

import numpy as np
import pytest
from unbiased import load

pytest.importorskip("mitsuba")

from data_gen.render import render_stack
from data_gen.scenes.facts import scene_facts, shapes_of


def scene(mi, grouped, **inside):
    """A shape before the camera, as it is or as an instance, and a lamp."""
    shape = {"type": "rectangle"} | inside
    place = mi.ScalarTransform4f()
    group = {"type": "shapegroup", "id": "group", "shape": shape}
    things = {"group": group, "copy": {"type": "instance", "group": {"type": "ref", "id": "group"}}}
    return load(
        mi,
        {
            "type": "scene",
            "integrator": {"type": "path"},
            "sensor": {"type": "perspective", "to_world": place.look_at([0, 0, 3], [0, 0, 0], [0, 1, 0])},
            "lamp": {"type": "point", "position": [0, 1, 4]},
            **(things if grouped else {"shape": shape}),
        },
        (12, 8),
    )


@pytest.mark.parametrize("grouped", [False, True])
def test_materials_and_media_are_found(renderer, grouped):
    from stress_scenes import written

    from data_gen.samplers.common import loses_light

    plain = scene(renderer, grouped)
    assert not loses_light(plain, plain.integrator()) and not scene_facts(plain).hair
    mask = scene(renderer, grouped, bsdf={"type": "mask", "opacity": 0.5, "nested": {"type": "diffuse"}})
    assert loses_light(mask, mask.integrator())
    curve = {"type": "bsplinecurve", "filename": written("c.txt", "\n".join(f"{x} 0 0 .1" for x in range(4)) + "\n")}
    assert scene_facts(scene(renderer, grouped, **curve, bsdf={"type": "hair"})).hair
    inside = {"interior": {"type": "homogeneous", "id": "mist"}, "bsdf": {"type": "null"}}
    assert scene_facts(scene(renderer, grouped, type="cube", **inside)).media == ("mist",)
    assert sum(shape.class_name() == "Rectangle" for shape in shapes_of(plain)) == 1


def test_bump_maps_turn_normals(renderer):
    from stress_scenes import bitmap

    bumps = {"type": "bumpmap", "arbitrary": bitmap(8, 8, 1, channels=1), "scale": 0.6, "bsdf": {"type": "diffuse"}}
    bumps["arbitrary"]["filter_type"] = "bilinear"
    flat, grouped = (
        render_stack(scene(renderer, grouped, bsdf=bumps), 4, 0, "primal", unbiased=True)["normal"]
        for grouped in (False, True)
    )
    assert np.abs(flat[..., 0]).max() > 0.1 and np.allclose(flat, grouped, atol=1e-3)
