"""Features where their exact values are known."""

import numpy as np
import pytest
from unbiased import load

pytest.importorskip("mitsuba")

from data_gen.render import render_stack
from data_gen.scenes.load import set_film_size


def camera(mi, turn=None, **more):
    """At (0, 0, 5), looking along -z, or turned about the origin with all that it sees of the world."""
    to_world = mi.ScalarTransform4f().look_at(origin=[0, 0, 5], target=[0, 0, 0], up=[0, 1, 0])
    return {"type": "perspective", "fov": 30, "to_world": to_world if turn is None else turn @ to_world} | more


def features_of(mi, size=(33, 33), spp=4, **objects):
    """The stack of a scene below a white sky, seen by ``camera``."""
    scene = {"type": "scene", "sensor": camera(mi), "light": {"type": "constant"}, "integrator": {"type": "path"}}
    scene = load(mi, scene | objects)
    set_film_size(scene, size)
    return render_stack(scene, spp, sampler="primal", unbiased=True)


def sphere(bsdf, **parameters):
    return {"type": "sphere", "bsdf": bsdf} | parameters


def plane(mi, z, bsdf, scale=10):
    return {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, z]).scale(scale), "bsdf": bsdf}


def diffuse(r, g, b):
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": [r, g, b]}}


def test_features_of_a_ball_are_in_camera_space_wherever_the_camera_looks(renderer):
    mi, ball = renderer, sphere(diffuse(0.5, 0.5, 0.5))
    straight = features_of(mi, ball=ball)
    normal = straight["normal"]
    assert np.allclose(normal[16, 16], [0, 0, 1], atol=0.05)  # toward the viewer
    assert normal[16, 25, 0] > 0.5 and normal[16, 7, 0] < -0.5  # right, left
    assert normal[7, 16, 1] > 0.5 and normal[25, 16, 1] < -0.5  # row 0 is on top
    assert np.allclose(np.linalg.norm(normal[16, 16]), 1, atol=1e-2)
    assert straight["depth"][16, 16, 0] == pytest.approx(4, abs=0.02)
    # What escapes has no features.
    assert not any(straight[name][0, 0].any() for name in ("albedo", "normal", "depth"))
    turned = camera(mi, mi.ScalarTransform4f().rotate([0, 1, 0], 70).rotate([1, 0, 0], 20))
    assert np.allclose(features_of(mi, ball=ball, sensor=turned)["normal"], normal, atol=1e-3)


def test_the_back_of_a_surface_faces_the_viewer_too(renderer):
    away = {"type": "twosided", "bsdf": diffuse(0.2, 0.4, 0.6)}
    wall = plane(renderer, 0, away)
    wall["to_world"] = wall["to_world"] @ renderer.ScalarTransform4f().rotate([0, 1, 0], 180)
    stack = features_of(renderer, wall=wall)
    assert np.allclose(stack["normal"], [0, 0, 1], atol=1e-5)
    assert np.allclose(stack["albedo"], [0.2, 0.4, 0.6], atol=1e-5)


def test_albedo_is_tinted_by_what_it_is_seen_through(renderer):
    mi = renderer
    red = {"type": "rgb", "value": [0.9, 0.4, 0.2]}
    # Panes reflect a small part of what falls on them; the camera looks at the sky then, which has no features.
    pane = {"type": "thindielectric", "specular_transmittance": red, "int_ior": 1.0001}
    panes = {f"pane{z}": plane(mi, z, pane) for z in (1, 2)}
    twice = features_of(mi, wall=plane(mi, -1, diffuse(0.8, 0.5, 0.4)), **panes)
    assert np.allclose(twice["albedo"], [0.8 * 0.81, 0.5 * 0.16, 0.4 * 0.04], atol=1e-4)
    assert twice["depth"][16, 16, 0] == pytest.approx(6, abs=0.01)
    # A ball of refracting glass with the camera inside: one surface, whose radiance is scaled by the index squared.
    ball = sphere({"type": "dielectric", "specular_transmittance": red, "int_ior": 1.0001}, radius=6.0)
    room = sphere({"type": "twosided", "bsdf": diffuse(0.8, 0.5, 0.4)}, radius=20.0)
    inside = features_of(mi, ball=ball, room=room, size=(9, 9))
    assert np.allclose(inside["albedo"], [0.8 * 0.9, 0.5 * 0.4, 0.4 * 0.2], atol=1e-3)


def test_mirrors_tint_albedo_and_add_up_depth(renderer):
    mi = renderer
    blue = {"type": "conductor", "material": "none", "specular_reflectance": {"type": "rgb", "value": [0.3, 0.5, 0.9]}}
    mirror = plane(mi, 0, {"type": "twosided", "bsdf": blue})
    behind = plane(mi, 8, {"type": "twosided", "bsdf": diffuse(0.5, 0.5, 0.5)})
    stack = features_of(mi, mirror=mirror, behind=behind)
    assert np.allclose(stack["albedo"], [0.15, 0.25, 0.45], atol=1e-5)
    assert stack["depth"][16, 16, 0] == pytest.approx(5 + 8, abs=0.01)
    assert np.allclose(stack["normal"], [0, 0, -1], atol=1e-5)  # of the wall itself: it is not mirrored


def tilted(mi, angle, bsdf):
    """``bsdf`` under a normal map that turns normals by ``angle`` toward the local x axis."""
    normal = np.array([np.sin(angle), 0, np.cos(angle)]) / 2 + 0.5
    image = mi.Bitmap(np.broadcast_to(normal, (4, 4, 3)).astype(np.float32))
    return {"type": "normalmap", "normalmap": {"type": "bitmap", "bitmap": image, "raw": True}, "bsdf": bsdf}


def test_normal_maps_turn_normals(renderer):
    mi = renderer
    material = tilted(mi, 0.5, {"type": "twosided", "bsdf": diffuse(0.5, 0.5, 0.5)})
    # In camera space: a wall turned by as much the other way faces the viewer again.
    turned = plane(mi, 0, material)
    turned["to_world"] = turned["to_world"] @ mi.ScalarTransform4f().rotate([0, 1, 0], np.degrees(-0.5))
    stack = features_of(mi, wall=turned)
    assert np.allclose(stack["normal"], [0, 0, 1], atol=0.01) and np.allclose(stack["albedo"], 0.5, atol=1e-4)
    # Seen in a mirror, x of the picture stays, and z turns round.
    mirror = plane(mi, 0, {"type": "twosided", "bsdf": {"type": "conductor", "material": "none"}})
    behind = plane(mi, 8, material)
    behind["to_world"] = behind["to_world"] @ mi.ScalarTransform4f().rotate([0, 1, 0], 180)
    seen = features_of(mi, mirror=mirror, behind=behind)["normal"]
    assert np.allclose(seen, [-np.sin(0.5), 0, -np.cos(0.5)], atol=0.01)


def test_bump_maps_turn_normals(renderer):
    mi = renderer
    ramp = np.tile(np.linspace(0, 1, 256, dtype=np.float32), (256, 1))[..., None]
    height = {"type": "bitmap", "bitmap": mi.Bitmap(ramp), "raw": True}
    wall = plane(mi, 0, {"type": "bumpmap", "arbitrary": height, "scale": 10.0, "bsdf": diffuse(0.5, 0.5, 0.5)})
    # The ramp rises by 10 over the 20 units of the wall.
    expected = np.array([-0.5, 0, 1]) / np.sqrt(1.25)
    assert np.allclose(features_of(mi, wall=wall)["normal"], expected, atol=0.02)


def test_holes_of_masks_are_seen_through(renderer):
    mi = renderer
    mask = {"type": "mask", "opacity": 0.25, "nested": diffuse(1, 0, 0)}
    stack = features_of(mi, leaf=plane(mi, 1, mask), wall=plane(mi, 0, diffuse(0, 1, 0)), spp=256)
    assert np.allclose(stack["albedo"].mean(axis=(0, 1)), [0.25, 0.75, 0], atol=0.01)


GLOSSY = {
    "gold": ({"type": "roughconductor", "material": "Au", "alpha": 0.1}, [0.85, 0.6, 0.2], [1, 0.9, 0.6]),
    "mirror": ({"type": "roughconductor", "material": "none", "alpha": 0.4}, 0.75, 1),
    "glass": ({"type": "roughdielectric", "alpha": 0.2}, 0.85, 1),
    "metal": ({"type": "principled", "metallic": 1.0, "roughness": 0.1}, 0.3, 1),
    "plastic": ({"type": "plastic", "diffuse_reflectance": 0.6}, 0.5, 0.7),
}


def test_albedo_is_a_reflectance_for_glossy_materials_too(renderer):
    """Upright strips side by side, one of each material and 6.2 pixels wide; the middle one is in the middle."""
    place = renderer.ScalarTransform4f().translate
    strips = {
        name: {"type": "rectangle", "to_world": place([0.5 * i - 1, 0, 0]).scale([0.25, 2, 1]), "b": bsdf}
        for i, (name, (bsdf, _, _)) in enumerate(GLOSSY.items())
    }
    seen = features_of(renderer, spp=64, **strips)["albedo"]
    for number, (name, (_, low, high)) in enumerate(GLOSSY.items()):
        middle = round(16.5 + 6.16 * (number - 2))
        albedo = seen[:, middle - 2 : middle + 2]
        assert albedo.min() >= 0 and albedo.max() <= 1, name
        assert (albedo.mean(axis=(0, 1)) >= low).all() and (albedo.mean(axis=(0, 1)) <= high).all(), name


def test_a_hall_of_mirrors_ends(renderer):
    room = {"type": "sphere", "radius": 50, "flip_normals": True, "bsdf": {"type": "conductor", "material": "none"}}
    stack = features_of(renderer, room=room, size=(8, 8))
    assert not stack["albedo"].any() and not stack["depth"].any()


AIR, BEHIND = np.array([0.9, 0.6, 0.3]), np.array([0.2, 0.5, 0.8])


def slab(mi, medium, depth=0.8):
    """A box with a medium, ``depth`` deep along the view, that fills the picture at z = 0."""
    to_world = mi.ScalarTransform4f().scale([4, 4, depth / 2])
    return {"type": "cube", "to_world": to_world, "bsdf": {"type": "null"}, "interior": medium}


def haze(sigma_t=1.5):
    return {"type": "homogeneous", "sigma_t": sigma_t, "albedo": {"type": "rgb", "value": AIR.tolist()}}


def grid(mi, density, depth=0.8):
    """A medium whose density along the view is that of the list, made of the same stuff as ``haze``."""
    cells = mi.VolumeGrid(np.float32(density)[:, None, None, None] * np.ones((1, 2, 2, 1), np.float32))
    to_world = mi.ScalarTransform4f().translate([-4, -4, -depth / 2]).scale([8, 8, depth])
    extinction = {"type": "gridvolume", "grid": cells, "to_world": to_world, "raw": True, "filter_type": "nearest"}
    albedo = {"type": "constvolume", "value": {"type": "rgb", "value": AIR.tolist()}}
    return {"type": "heterogeneous", "sigma_t": extinction, "albedo": albedo, "scale": 1.5}


def through(length):
    """The albedo of a wall behind haze of this optical depth."""
    return np.exp(-length) * BEHIND + (1 - np.exp(-length)) * AIR


def test_media_dim_the_albedo_behind_them_and_add_their_own(renderer):
    mi = renderer
    stack = features_of(mi, wall=plane(mi, -2, diffuse(*BEHIND)), slab=slab(mi, haze()), size=(9, 9))
    assert np.allclose(stack["albedo"][4, 4], through(1.5 * 0.8), atol=0.01)
    # The surfaces behind keep their own place.
    assert np.allclose(stack["normal"], [0, 0, 1], atol=1e-5)
    assert stack["depth"][4, 4, 0] == pytest.approx(7, abs=0.05)
    # Before nothing, what is left is the medium's part.
    alone = features_of(mi, slab=slab(mi, haze()), size=(9, 9))
    assert np.allclose(alone["albedo"][4, 4], (1 - np.exp(-1.5 * 0.8)) * AIR, atol=0.01)
    assert not alone["normal"].any() and not alone["depth"].any()


def test_the_density_of_a_grid_counts_along_the_ray(renderer):
    mi, density = renderer, [0.2, 1, 0.5, 0]
    wall = plane(mi, -2, diffuse(*BEHIND))
    stack = features_of(mi, wall=wall, slab=slab(mi, grid(mi, density)), size=(9, 9), spp=64)
    assert np.allclose(stack["albedo"][4, 4], through(1.5 * 0.8 * np.mean(density)), atol=0.02)


def test_the_camera_may_stand_in_a_medium(renderer):
    mi = renderer
    inside = {"air": haze(0.2) | {"id": "air"}, "sensor": camera(mi, fov=1, medium={"type": "ref", "id": "air"})}
    stack = features_of(mi, size=(5, 5), wall=plane(mi, 0, diffuse(*BEHIND)), **inside)
    assert np.allclose(stack["albedo"], through(0.2 * 5), atol=0.01)
    # Endless before nothing: the medium is all there is.
    endless = features_of(mi, size=(5, 5), **inside)
    assert np.allclose(endless["albedo"], AIR, atol=1e-3) and not endless["depth"].any()


def test_media_in_glass_are_tinted_by_the_glass(renderer):
    mi, red = renderer, np.array([0.9, 0.4, 0.2])
    tint = {"type": "rgb", "value": red.tolist()}
    ball = sphere({"type": "dielectric", "specular_transmittance": tint, "int_ior": 1.0001}, radius=1.0)
    stack = features_of(mi, ball=ball | {"interior": haze(2.0)}, wall=plane(mi, -3, diffuse(1, 1, 1)), size=(9, 9))
    passed = np.exp(-2 * 2.0)
    assert np.allclose(stack["albedo"][4, 4], red * (1 - passed) * AIR + passed * red**2, atol=0.02)
