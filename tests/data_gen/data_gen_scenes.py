"""Scenes of the statistical tests, each a dictionary for Mitsuba."""

import mitsuba as mi
import numpy as np

from data_gen.scenes.builtin import (
    _box,
    _camera,
    _diffuse,
    _light,
    _rgb,
    _room,
    _sphere,
    _transform,
    _wall,
    diffuse,
)


def _scene(depth, camera, rr=None, kind="path", **parts):
    """A scene of these parts under an integrator, seen by a camera (origin, target, field of view)."""
    integrator = {"type": kind, "max_depth": depth} | ({"rr_depth": rr} if rr else {})
    return {"type": "scene", "integrator": integrator, "sensor": _camera(*camera), **parts}


def _area(*radiance):
    return {"emitter": {"type": "area", "radiance": _rgb(*radiance)}}


def _scale(factor):
    return mi.ScalarTransform4f().scale(factor)


def _placed(*position, scale, bsdf):
    to_world = mi.ScalarTransform4f().translate(list(position)).scale(scale)
    return {"type": "rectangle", "to_world": to_world, "bsdf": bsdf}


def _two(*colour):
    return {"type": "twosided", "nested": _diffuse(*colour)}


ROOM = ([0, 1.25, 3.9], [0, 1.0, 0], 50)
LENS = {"type": "thinlens", "aperture_radius": 0.04, "focus_distance": 4.0}


def glass():
    """Smooth and rough glass under a lamp large enough to be found through them."""
    return _scene(
        8,
        ([0, 1.25, 3.9], [0, 1.1, 0], 50),
        3,
        **_room(1.5, _diffuse(0.5, 0.5, 0.5)),
        lamp=_light([0, 2.3, 0], [0, -1, 0], (2.6, 2.6), (2, 2, 2)),
        smooth=_sphere([-0.6, 0.7, 0], 0.7, {"type": "dielectric"}),
        rough=_sphere([0.8, 0.6, 0], 0.6, {"type": "roughdielectric", "alpha": 0.3}),
        hole=_placed(0, 1.6, 0.8, scale=0.4, bsdf={"type": "mask", "opacity": 0.5, "nested": _two(0.2, 0.6, 0.3)}),
    )


def fog():
    """A ball in a scattering medium that fills the view."""
    medium = {"type": "homogeneous", "albedo": 0.7, "sigma_t": 0.4}
    return _scene(
        8,
        ([0, 0, 4], [0, 0, 0], 40),
        3,
        "volpath",
        ball=_sphere([0, 0, 0], 0.6, _diffuse(0.7, 0.3, 0.2)),
        lamp=_light([0, 2.5, 1], [0, -1, 0], (3, 3), (4, 4, 4)),
        box={"type": "cube", "bsdf": {"type": "null"}, "interior": medium},
    )


def within_fog():
    """The same with the camera inside the medium and lamps that hide from it."""
    scene = fog()
    medium = {"type": "homogeneous", "albedo": 0.7, "sigma_t": 0.2, "id": "air"}
    scene["integrator"]["hide_emitters"] = True
    scene["sensor"]["medium"] = {"type": "ref", "id": "air"}
    scene["box"]["to_world"] = _scale(6)
    scene["box"]["interior"] = {"type": "ref", "id": "air"}
    return {"type": "scene", "air": medium, **scene}


def hidden_lamp():
    """The diffuse room with a lamp that the camera does not see."""
    scene = diffuse()
    scene["integrator"]["hide_emitters"] = True
    return scene


def furnace():
    """The inside of a ball whose wall glows and reflects half of what it gets: radiance is 1 everywhere."""
    half, glows = _diffuse(0.5, 0.5, 0.5), _area(0.5, 0.5, 0.5)
    wall = _sphere([0, 0, 0], 2, half) | {"flip_normals": True}
    return _scene(
        40, ([0.4, 0.2, 1.2], [0, 0, 0], 60), 5, wall=wall | glows, ball=_sphere([0, -0.3, 0], 0.5, half) | glows
    )


def polished(alpha):
    """A metal floor of the given roughness beside a lacquered ball, under a lamp of radiance 1."""
    return _scene(
        5,
        ([0, 0.8, 4], [0, 0.6, 0], 45),
        floor=_wall([0, 0, 0], [0, 1, 0], (6, 6), {"type": "roughconductor", "material": "Ag", "alpha": alpha}),
        ball=_sphere([0.4, 0.5, 0], 0.5, {"type": "roughplastic", "alpha": alpha}),
        lamp=_light([0, 2.4, 0], [0, -1, 0], (3, 3), (1, 1, 1)),
    )


def leaf():
    """A thin leaf in front of nothing, lit by a lamp that the camera does not see."""
    look = mi.ScalarTransform4f().look_at([0, 3, 3], [0, 0, 0], [1, 0, 0])
    bsdf = {"type": "mask", "opacity": 0.3, "nested": _two(0.8, 0.8, 0.8)}
    return _scene(
        4,
        ([0, 0, 4], [0, 0, 0], 40),
        lamp={"type": "rectangle", "to_world": look, "emitter": {"type": "area", "radiance": 10.0}},
        leaf={"type": "rectangle", "to_world": _scale(2), "bsdf": bsdf},
    )


def caustics():
    """A floor below a lamp, lit through a ball of glass and by way of a mirror ball."""
    return _scene(
        6,
        ([0.2, 1.9, 2.6], [0, 0.35, 0], 45),
        floor=_wall([0, 0, 0], [0, 1, 0], (6, 6), _diffuse(0.6, 0.5, 0.4)),
        lamp=_light([0.2, 2.6, -0.2], [0, -1, 0], (1.2, 1.2), (6, 6, 6)),
        glass=_sphere([-0.3, 0.62, 0.1], 0.45, {"type": "dielectric"}),
        mirror=_sphere([0.6, 0.4, 0.3], 0.3, {"type": "conductor", "material": "Ag"}),
    )


def _lamps(side):
    """A sky, a square lamp with sides of that length, a bulb and a point light."""
    return {
        "sky": {"type": "constant", "radiance": _rgb(0.3, 0.4, 0.5)},
        "lamp": _light([0.3, 2.3, 0], [0, -1, 0], (side, side), (3, 3, 2.5)),
        "bulb": _sphere([-1.1, 1.9, -0.6], 0.15, _diffuse(0, 0, 0)) | _area(6, 4, 2),
        "point": {"type": "point", "position": [0.8, 2.0, 1.6], "intensity": _rgb(1.5, 1.5, 1.8)},
    }


def plenty():
    """One of everything: a lens, lamps of all kinds, textures, bumps, coats, holes, and glass with a rough surface."""
    tiles = {"type": "checkerboard", "to_uv": _transform().scale([3, 3, 1])}
    waves = np.sin(np.linspace(0, 12, 32, dtype=np.float32)) * np.ones((32, 1), np.float32)
    waves = {"type": "bitmap", "bitmap": mi.Bitmap(waves[..., None]), "raw": True}
    painted = {"type": "principled", "base_color": _rgb(0.6, 0.3, 0.1), "roughness": 0.35, "clearcoat": 0.4}
    coated = {"type": "roughplastic", "diffuse_reflectance": tiles, "alpha": 0.2}
    bumpy = {"type": "bumpmap", "arbitrary": waves, "scale": 0.05, "bsdf": _diffuse(0.3, 0.5, 0.4)}
    holes = {"type": "mask", "opacity": tiles, "nested": _two(0.4, 0.6, 0.6)}
    blend = {"type": "blendbsdf", "weight": 0.4, "a": {"type": "roughconductor", "alpha": 0.02}}
    scene = _scene(
        7,
        ROOM,
        3,
        **_room(1.5, coated),
        **_lamps(1.5),
        principled=_sphere([-0.9, 0.5, -0.2], 0.5, painted),
        glass=_sphere([0.1, 0.4, 0.4], 0.4, {"type": "roughdielectric", "alpha": 0.15}),
        bumpy=_box([0.95, 0.5, -0.4], [0.6, 1.0, 0.6], 25, bumpy),
        blend=_sphere([0.8, 0.25, 0.7], 0.25, blend | {"b": _diffuse(0.5, 0.2, 0.2)}),
        holes=_wall([-0.3, 1.5, -0.6], [0.2, 0, 1], (0.9, 0.7), holes),
        pane=_placed(-0.7, 0.9, 1.0, scale=0.35, bsdf={"type": "thindielectric"}),
    )
    scene["sensor"] |= LENS
    return scene


def under_the_sky():
    """The same objects under a sky, seen in a mirror, one of them lacquered and one a bubble."""
    scene = caustics()
    del scene["lamp"]
    return scene | {
        "sky": {"type": "constant", "radiance": _rgb(0.8, 0.9, 1.0)},
        "wall": _wall([0, 0.8, -1.2], [0, 0, 1], (4, 2), {"type": "conductor", "material": "Al"}),
        "bubble": _sphere([0, 0.4, 0.9], 0.2, {"type": "thindielectric"}),
        "plastic": _sphere([-0.9, 0.25, 0.8], 0.25, {"type": "plastic", "diffuse_reflectance": _rgb(0.1, 0.3, 0.1)}),
        "post": _sphere([0.9, 0.2, -0.5], 0.2, _diffuse(0.2, 0.2, 0.6)),
    }


def courtyard():
    """Things that scatter widely, in as many ways as can be, under a sky, a bulb, a lamp and a point light.

    One wall is black in red and green, so that paths go on there which carry nothing for some or all of five.
    """
    tiles = {"type": "checkerboard", "to_uv": _transform().scale([3, 3, 1])}
    satin = {"type": "roughplastic", "diffuse_reflectance": tiles, "alpha": 0.2}
    black = {"type": "diffuse", "reflectance": tiles | {"color0": _rgb(0, 0, 0), "color1": _rgb(0, 0, 0.8)}}
    scene = _scene(
        7,
        ROOM,
        5,
        **{name: wall for name, wall in _room(1.5, satin).items() if name != "ceiling"},
        **_lamps(1.0),
        brushed=_sphere([-0.9, 0.5, -0.2], 0.5, {"type": "roughconductor", "material": "Cu", "alpha": 0.3}),
        frosted=_sphere([0.1, 0.4, 0.4], 0.4, {"type": "roughdielectric", "alpha": 0.3}),
        box=_box([0.95, 0.5, -0.4], [0.6, 1.0, 0.6], 25, _two(0.3, 0.5, 0.4)),
        panel=_wall([-0.3, 1.5, -0.6], [0.2, 0, 1], (0.9, 0.7), black),
    )
    scene["sensor"] |= LENS
    return scene


def limited(max_depth):
    def scene():
        description = courtyard()
        description["integrator"]["max_depth"] = max_depth
        return description

    return scene


def panels():
    """Four under a sky, two of them seen from behind, two of metal; before them a floor."""
    metal = {"type": "roughconductor", "material": "Cu", "alpha": 0.4}
    kinds = [(bsdf, z) for bsdf in (_diffuse(0.8, 0.7, 0.6), metal) for z in (0.7, -0.7)]
    return _scene(
        4,
        ([0, 1, 5], [0, 1, 0], 40),
        5,
        sky={"type": "constant", "radiance": _rgb(0.3, 0.4, 0.5)},
        floor=_wall([0, 0, 0], [0, 1, 0], (8, 8), _diffuse(0.5, 0.5, 0.5)),
        **{f"panel{i}": _wall([i - 1.5, 1, 0], [0, 0.7, z], (1, 2), bsdf) for i, (bsdf, z) in enumerate(kinds)},
    )


def moved(scale, shift):
    """``polished(0.2)``, camera included, scaled about the origin and then moved along x."""
    T = mi.ScalarTransform4f().translate([shift, 0, 0]) @ mi.ScalarTransform4f().scale(scale)
    scene = polished(0.2)
    for part in scene.values():
        if isinstance(part, dict) and part["type"] in ("rectangle", "sphere", "perspective"):
            part["to_world"] = T @ part.get("to_world", mi.ScalarTransform4f())
    # A camera has no size: its matrix must not scale.
    camera = {"origin": [shift, 0.8 * scale, 4 * scale], "target": [shift, 0.6 * scale, 0], "up": [0, 1, 0]}
    to_world = mi.ScalarTransform4f().look_at(**camera)
    scene["sensor"] |= {"to_world": to_world, "near_clip": 1e-2 * scale, "far_clip": 1e4 * scale}
    return scene


def lamp_alone():
    """A ball that glows, and nothing else."""
    look = mi.ScalarTransform4f().look_at(origin=[0.1, 0.2, -4], target=[0, 0, 0], up=[0, 1, 0])
    film = {"type": "hdrfilm", "width": 16, "height": 16}
    return {
        "type": "scene",
        "integrator": {"type": "path"},
        "sensor": {"type": "perspective", "fov": 30, "to_world": look, "film": film},
        "lamp": {
            "type": "sphere",
            "radius": 0.6,
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 2.0}},
        },
    }
