"""Features where their exact values are known."""

import numpy as np
import pytest
from unbiased import load


def features_of(mi, size=(33, 33), spp=4, **objects):
    """Feature layers of a scene seen by a camera at (0, 0, 5) that looks along -z with 30 degrees across."""
    from data_gen.render import render_stack
    from data_gen.scenes.load import set_film_size

    camera = {
        "type": "perspective",
        "fov": 30,
        "to_world": mi.ScalarTransform4f().look_at(origin=[0, 0, 5], target=[0, 0, 0], up=[0, 1, 0]),
    }
    scene = load(
        mi,
        {"type": "scene", "sensor": camera, "light": {"type": "constant"}, "integrator": {"type": "path"}, **objects},
    )
    set_film_size(scene, size)
    return render_stack(scene, spp, sampler="primal")


def sphere(bsdf, **parameters):
    return {"type": "sphere", "bsdf": bsdf} | parameters


def plane(mi, z, bsdf, scale=10):
    return {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, z]).scale(scale), "bsdf": bsdf}


def diffuse(r, g, b):
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": [r, g, b]}}


def test_normals_are_in_camera_space(renderer):
    normal = features_of(renderer, ball=sphere(diffuse(0.5, 0.5, 0.5)))["normal"]
    assert np.allclose(normal[16, 16], [0, 0, 1], atol=0.05)  # toward the viewer
    assert normal[16, 25, 0] > 0.5 and normal[16, 7, 0] < -0.5  # right, left
    assert normal[7, 16, 1] > 0.5 and normal[25, 16, 1] < -0.5  # row 0 is on top
    assert np.allclose(np.linalg.norm(normal[16, 16]), 1, atol=1e-2)


def test_normals_do_not_depend_on_where_the_camera_looks(renderer):
    mi = renderer
    turned = mi.ScalarTransform4f().rotate([0, 1, 0], 70).rotate([1, 0, 0], 20)
    camera = mi.ScalarTransform4f().look_at(origin=[0, 0, 5], target=[0, 0, 0], up=[0, 1, 0])
    straight = features_of(mi, ball=sphere(diffuse(0.5, 0.5, 0.5)))["normal"]
    sensor = {"type": "perspective", "fov": 30, "to_world": turned @ camera}
    assert np.allclose(
        features_of(mi, ball=sphere(diffuse(0.5, 0.5, 0.5)), sensor=sensor)["normal"], straight, atol=1e-3
    )


def test_the_back_of_a_surface_faces_the_viewer_too(renderer):
    away = {"type": "twosided", "bsdf": diffuse(0.2, 0.4, 0.6)}
    wall = plane(renderer, 0, away)
    wall["to_world"] = wall["to_world"] @ renderer.ScalarTransform4f().rotate([0, 1, 0], 180)
    stack = features_of(renderer, wall=wall)
    assert np.allclose(stack["normal"], [0, 0, 1], atol=1e-5)
    assert np.allclose(stack["albedo"], [0.2, 0.4, 0.6], atol=1e-5)


def test_what_escapes_has_no_features(renderer):
    stack = features_of(renderer, ball=sphere(diffuse(0.5, 0.5, 0.5), radius=0.2))
    for name in ("albedo", "normal", "depth"):
        assert not stack[name][0, 0].any()
    assert stack["depth"][16, 16, 0] == pytest.approx(4.8, abs=0.02)


def test_mirrors_and_glass_show_what_is_behind_them(renderer):
    mi = renderer
    green = plane(mi, 8, {"type": "twosided", "bsdf": diffuse(0.1, 0.7, 0.2)})  # behind the camera
    mirror = plane(mi, 0, {"type": "twosided", "bsdf": {"type": "conductor", "material": "none"}})
    stack = features_of(mi, wall=green, mirror=mirror)
    assert np.allclose(stack["albedo"], [0.1, 0.7, 0.2], atol=1e-5)
    assert stack["depth"][16, 16, 0] == pytest.approx(5 + 8, abs=0.1)
    pane = plane(mi, 1, {"type": "thindielectric"})
    wall = plane(mi, -2, diffuse(0.3, 0.3, 0.6))
    through = features_of(mi, wall=wall, pane=pane, spp=256)
    assert np.median(through["depth"]) == pytest.approx(7, abs=1.2)


def test_albedo_is_tinted_by_what_it_is_seen_through(renderer):
    mi = renderer
    wall = plane(mi, -1, diffuse(0.8, 0.5, 0.4))
    red = {"type": "rgb", "value": [0.9, 0.4, 0.2]}
    # A pane reflects a small part of what falls on it; the camera looks at the sky then, which has no features.
    pane = plane(mi, 1, {"type": "thindielectric", "specular_transmittance": red, "int_ior": 1.0001})
    glass = features_of(mi, wall=wall, pane=pane)
    assert np.allclose(glass["albedo"], [0.8 * 0.9, 0.5 * 0.4, 0.4 * 0.2], atol=1e-4)
    twice = features_of(mi, wall=wall, pane=pane, second=pane | {"to_world": plane(mi, 2, {})["to_world"]})
    assert np.allclose(twice["albedo"], [0.8 * 0.81, 0.5 * 0.16, 0.4 * 0.04], atol=1e-4)
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
    stack = features_of(mi, wall=plane(mi, 0, material))
    assert np.allclose(stack["normal"], [np.sin(0.5), 0, np.cos(0.5)], atol=0.01)
    assert np.allclose(stack["albedo"], 0.5, atol=1e-4)
    # In camera space: a wall turned by as much the other way faces the viewer again.
    turned = plane(mi, 0, material)
    turned["to_world"] = turned["to_world"] @ mi.ScalarTransform4f().rotate([0, 1, 0], np.degrees(-0.5))
    assert np.allclose(features_of(mi, wall=turned)["normal"], [0, 0, 1], atol=0.01)
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


@pytest.mark.parametrize(
    ("bsdf", "low", "high"),
    [
        ({"type": "roughconductor", "material": "Au", "alpha": 0.1}, [0.85, 0.6, 0.2], [1, 0.9, 0.6]),
        ({"type": "roughconductor", "material": "none", "alpha": 0.4}, [0.75] * 3, [1.0] * 3),
        ({"type": "roughdielectric", "alpha": 0.2}, [0.85] * 3, [1.0] * 3),
        ({"type": "principled", "metallic": 1.0, "roughness": 0.1}, [0.3] * 3, [1.0] * 3),
        ({"type": "plastic", "diffuse_reflectance": 0.6}, [0.5] * 3, [0.7] * 3),
    ],
)
def test_albedo_is_a_reflectance_for_glossy_materials_too(renderer, bsdf, low, high):
    albedo = features_of(renderer, wall=plane(renderer, 0, bsdf), spp=64)["albedo"]
    assert albedo.min() >= 0 and albedo.max() <= 1
    assert (albedo.mean(axis=(0, 1)) >= low).all() and (albedo.mean(axis=(0, 1)) <= high).all()


def test_a_hall_of_mirrors_ends(renderer):
    room = {"type": "sphere", "radius": 50, "flip_normals": True, "bsdf": {"type": "conductor", "material": "none"}}
    stack = features_of(renderer, room=room, size=(8, 8))
    assert not stack["albedo"].any() and not stack["depth"].any()


def slab(mi, medium, depth=0.8):
    """A box with a medium, ``depth`` deep along the view, that fills the picture at z = 0."""
    return {
        "type": "cube",
        "to_world": mi.ScalarTransform4f().scale([4, 4, depth / 2]),
        "bsdf": {"type": "null"},
        "interior": medium,
    }


def haze(sigma_t=1.5, albedo=(0.9, 0.6, 0.3)):
    return {"type": "homogeneous", "sigma_t": sigma_t, "albedo": {"type": "rgb", "value": list(albedo)}}


def grid(mi, density, depth=0.8):
    """A medium whose density along the view is that of the list, made of the same stuff as ``haze``."""
    cells = np.float32(density)[:, None, None, None] * np.ones((1, 2, 2, 1), np.float32)
    to_world = mi.ScalarTransform4f().translate([-4, -4, -depth / 2]).scale([8, 8, depth])
    return {
        "type": "heterogeneous",
        "sigma_t": {
            "type": "gridvolume",
            "grid": mi.VolumeGrid(cells),
            "to_world": to_world,
            "raw": True,
            "filter_type": "nearest",
        },
        "albedo": {"type": "constvolume", "value": {"type": "rgb", "value": [0.9, 0.6, 0.3]}},
        "scale": 1.5,
    }


def test_media_dim_the_albedo_behind_them_and_add_their_own(renderer):
    mi = renderer
    wall, passed = plane(mi, -2, diffuse(0.2, 0.5, 0.8)), np.exp(-1.5 * 0.8)
    expected = passed * np.array([0.2, 0.5, 0.8]) + (1 - passed) * np.array([0.9, 0.6, 0.3])
    stack = features_of(mi, wall=wall, slab=slab(mi, haze()), size=(9, 9))
    assert np.allclose(stack["albedo"][4, 4], expected, atol=0.01)
    # The surfaces behind keep their own place.
    assert np.allclose(stack["normal"], [0, 0, 1], atol=1e-5)
    assert stack["depth"][4, 4, 0] == pytest.approx(7, abs=0.05)
    # Before nothing, what is left is the medium's part.
    alone = features_of(mi, slab=slab(mi, haze()), size=(9, 9))
    assert np.allclose(alone["albedo"][4, 4], (1 - passed) * np.array([0.9, 0.6, 0.3]), atol=0.01)
    assert not alone["normal"].any() and not alone["depth"].any()


def test_the_density_of_a_grid_counts_along_the_ray(renderer):
    mi = renderer
    wall = plane(mi, -2, diffuse(0.2, 0.5, 0.8))
    for density in ([1, 1, 1, 1], [0.2, 1, 0.5, 0]):
        passed = np.exp(-1.5 * 0.8 * np.mean(density))
        expected = passed * np.array([0.2, 0.5, 0.8]) + (1 - passed) * np.array([0.9, 0.6, 0.3])
        stack = features_of(mi, wall=wall, slab=slab(mi, grid(mi, density)), size=(9, 9), spp=64)
        assert np.allclose(stack["albedo"][4, 4], expected, atol=0.02)


def test_the_camera_may_stand_in_a_medium(renderer):
    mi = renderer
    camera = {
        "type": "perspective",
        "fov": 1,
        "to_world": mi.ScalarTransform4f().look_at(origin=[0, 0, 5], target=[0, 0, 0], up=[0, 1, 0]),
        "medium": {"type": "ref", "id": "air"},
    }
    wall = plane(mi, 0, diffuse(0.2, 0.5, 0.8))
    stack = features_of(mi, size=(5, 5), air=haze(0.2) | {"id": "air"}, sensor=camera, wall=wall)
    passed = np.exp(-0.2 * 5)
    assert np.allclose(
        stack["albedo"], passed * np.array([0.2, 0.5, 0.8]) + (1 - passed) * np.array([0.9, 0.6, 0.3]), atol=0.01
    )
    # Endless before nothing: the medium is all there is.
    endless = features_of(mi, size=(5, 5), air=haze(0.2) | {"id": "air"}, sensor=camera)
    assert np.allclose(endless["albedo"], [0.9, 0.6, 0.3], atol=1e-3) and not endless["depth"].any()


def test_media_in_glass_are_tinted_by_the_glass(renderer):
    mi = renderer
    red = {"type": "rgb", "value": [0.9, 0.4, 0.2]}
    ball = sphere({"type": "dielectric", "specular_transmittance": red, "int_ior": 1.0001}, radius=1.0)
    stack = features_of(mi, ball=ball | {"interior": haze(2.0)}, wall=plane(mi, -3, diffuse(1, 1, 1)), size=(9, 9))
    passed = np.exp(-2 * 2.0)
    expected = np.array([0.9, 0.4, 0.2]) * (1 - passed) * [0.9, 0.6, 0.3] + passed * np.array([0.9, 0.4, 0.2]) ** 2
    assert np.allclose(stack["albedo"][4, 4], expected, atol=0.02)
